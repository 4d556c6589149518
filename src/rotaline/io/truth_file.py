"""``<session>.truth.json``: what is true of a rendered session, beside it; written by ``rotaline simulate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rotaline.errors import GeometryError, SessionError
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.io.files import read_json
from rotaline.vision.camera import CameraModel


@dataclass(frozen=True, eq=False)
class Truth:
    """True values of a session, as far as a calibration and measurements can be held against them.

    ``sizes`` holds for each capture the true sizes of the first part on the table, mm, with the names that measurements have.
    The point of ``rotation_axis_camera`` lies on the table top.
    """

    camera: CameraModel
    laser_plane_camera: Plane
    rotation_axis_camera: Line
    turn_sense: int
    sizes: dict[str, dict[str, float]]


def read_truth(path: Path) -> Truth:
    """Read the truth of a rendered session.

    Raises
    ------
    SessionError
        If the file is missing or not like one: file, field, expected.
    """
    data = read_json(path, "truth of the session")
    try:
        camera, plane, axis = data["camera"], data["laser_plane_camera"], data["rotation_axis_camera"]
        return Truth(
            camera=CameraModel(
                (int(camera["image_size"][0]), int(camera["image_size"][1])),
                *(float(camera[name]) for name in ("fx", "fy", "cx", "cy")),
                **{name: float(value) for name, value in camera["distortion"].items()},
            ),
            laser_plane_camera=Plane(_vector(plane["normal"]), float(plane["offset"])),
            rotation_axis_camera=Line(_vector(axis["point"]), unit(_vector(axis["direction"]))),
            turn_sense=int(data["turn_sense"]),
            sizes={
                str(capture): {str(k): float(v) for k, v in parts[0]["sizes"].items()}
                for capture, parts in data["parts"].items()
                if parts
            },
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, GeometryError) as error:
        raise SessionError(
            f"{path}: this is not the truth of a rendered session ({type(error).__name__}: {error}). "
            "Expected the .truth.json that `rotaline simulate` writes beside the session."
        ) from error


def _vector(values: Any) -> np.ndarray:
    vector = np.array(values, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise ValueError(f"found {values!r}, expected three numbers")
    return vector
