"""Clouds and meshes as files: PLY and STL, in the table frame, mm."""

import re
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from rotaline.errors import SessionError
from rotaline.io.files import whole_file
from rotaline.scanning.cloud import PointCloud

_FIELDS = (
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("intensity", "f4"),
    ("angle_deg", "f4"),
    ("frame", "i4"),
    ("u_noise", "f4"),
    ("u_calibration", "f4"),
)
_PLY_NAMES = {"f4": "float", "i4": "int"}


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY: x, y, z (mm), intensity, angle_deg (right-handed about z), frame, u_noise, u_calibration.

    ``u_noise`` and ``u_calibration`` are standard uncertainties (k = 1, mm) from the stripe's noise and from the calibration; NaN
    where not known.
    """
    data = np.empty(len(cloud), dtype=[(name, "<" + kind) for name, kind in _FIELDS])
    data["x"], data["y"], data["z"] = cloud.points_table.T
    data["intensity"] = cloud.intensity
    data["angle_deg"] = np.degrees(cloud.angle_rad)
    data["frame"] = cloud.frame
    data["u_noise"] = cloud.u_mm
    data["u_calibration"] = cloud.u_calibration_mm
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment rotaline point cloud; table frame, z on the rotation axis; mm",
        "comment standard uncertainties (k = 1), mm: u_noise from the stripe, u_calibration common to many points",
        f"element vertex {len(cloud)}",
        *(f"property {_PLY_NAMES[kind]} {name}" for name, kind in _FIELDS),
        "end_header\n",
    ]
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write("\n".join(header).encode("ascii"))
        stream.write(data.tobytes())


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """The points of a cloud or the vertices of a mesh that any program wrote: PLY, OBJ, STL, XYZ.

    Returns
    -------
    (n, 3)   in the file's frame and unit (taken as mm)

    Raises
    ------
    SessionError
        If the file is missing, cannot be read, or holds no points.
    """
    if not path.is_file():
        raise SessionError(f"{path}: there is no such file. Expected a point cloud, for example a .ply.")
    try:
        if path.suffix.lower() in (".xyz", ".txt", ".asc", ".csv"):
            points = np.loadtxt(
                path, usecols=(0, 1, 2), delimiter="," if path.suffix.lower() == ".csv" else None, ndmin=2
            )
        else:
            geometry = trimesh.load(path, process=False)
            if isinstance(geometry, trimesh.Scene):
                geometry = geometry.to_geometry()
            points = np.asarray(getattr(geometry, "vertices", np.empty((0, 3))), dtype=float)
    except Exception as error:  # the readers raise whatever their parsers raise
        raise SessionError(
            f"{path}: this is not a readable point cloud ({error}). Expected PLY, OBJ, STL or XYZ."
        ) from error
    declared = _declared_vertices(path)
    if declared is not None and len(points) < declared:
        raise SessionError(
            f"{path}: the file is cut off; its header announces {declared} points, found {len(points)}. Write it again."
        )
    points = points[np.isfinite(points).all(axis=1)] if points.ndim == 2 and points.shape[1] == 3 else np.empty((0, 3))
    if len(points) == 0:
        raise SessionError(f"{path}: there are no points in this file.")
    return points


def _declared_vertices(path: Path) -> int | None:
    """The number of points in a PLY's header: its reader is content with fewer."""
    if path.suffix.lower() != ".ply":
        return None
    with path.open("rb") as stream:
        found = re.search(rb"element vertex (\d+)", stream.read(4096))
    return int(found[1]) if found else None


def write_mesh(path: Path, vertices_table: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
    """Write a mesh as binary PLY or STL, by the suffix of ``path``; mm, table frame."""
    mesh = trimesh.Trimesh(vertices_table, triangles, process=False)
    with whole_file(path) as temporary:
        mesh.export(temporary)
