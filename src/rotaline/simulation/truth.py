"""What is true of a rendered session: for the file beside it, and as a fingerprint that tells one session from another."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.mechanics import base_from_table
from rotaline.simulation.plan import CapturePlan, SessionPlan
from rotaline.simulation.rig import Rig

_LARGEST_LIST = 64
"""Larger arrays, such as those of a mesh, are stated by their digest."""


def truth_path(session: Path) -> Path:
    """Where the truth of a rendered session stands: beside it, never inside."""
    return session.with_name(session.name + ".truth.json")


def true_poses(rig: Rig, plan: SessionPlan) -> dict[str, tuple[RigidTransform, ...]]:
    """``base_from_table`` in each frame of each capture, with the errors of the turntable."""
    return {c.folder: _true_poses_of(rig, c, (plan.seed, i)) for i, c in enumerate(plan.captures)}


def _true_poses_of(rig: Rig, capture: CapturePlan, seed: tuple[int, ...]) -> tuple[RigidTransform, ...]:
    """The poses in one capture.

    Frames that follow one another at the same angle, such as laser off and on, belong to one stop of the table.
    """
    poses: list[RigidTransform] = []
    stop = -1
    for i, shot in enumerate(capture.shots):
        if shot.angle_deg is None:
            poses.append(RigidTransform.identity())
        elif i > 0 and shot.angle_deg == capture.shots[i - 1].angle_deg:
            poses.append(poses[-1])
        else:
            stop += 1
            rng = np.random.default_rng([*seed, stop])
            poses.append(base_from_table(rig.turn_sense, rig.mechanics, shot.angle_deg, rng))
    return tuple(poses)


def truth(rig: Rig, plan: SessionPlan) -> dict[str, Any]:
    """All that is true of a session, ready for JSON; lengths in mm unless the name says otherwise.

    Returns
    -------
    ``camera``, ``laser_plane_camera``, ``rotation_axis_camera``, ``turn_sense`` with the names and frames of ``calibration.json``;
    ``camera_from_base``; ``laser``, ``optics``, ``sensor``, ``light``, ``mechanics`` as in :mod:`rotaline.simulation.rig`;
    ``parts``: what stands on the table in each capture, the part or plate first, with its sizes and ``table_from_part``;
    ``plates``: what is held in view; ``frames``: of each capture, what the read-out says, where the table truly is
    (``base_from_table``), where the held plate is (``base_from_board``)
    """
    poses = true_poses(rig, plan)
    camera, axis, plane = rig.camera, rig.rotation_axis_camera, rig.laser_plane_camera
    return {
        "camera": {
            "image_size": list(camera.image_size),
            **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
            "distortion": {name: getattr(camera, name) for name in ("k1", "k2", "p1", "p2", "k3")},
        },
        "laser_plane_camera": {"normal": plane.normal.tolist(), "offset": plane.offset},
        "rotation_axis_camera": {"point": axis.point.tolist(), "direction": axis.direction.tolist()},
        "turn_sense": rig.turn_sense,
        "camera_from_base": rig.camera_from_base.as_matrix().tolist(),
        "table_radius_mm": rig.table_radius_mm,
        **{name: plain_value(getattr(rig, name)) for name in ("laser", "optics", "sensor", "light", "mechanics")},
        "parts": {c.folder: [_placed(p) for p in c.shots[0].on_table] for c in plan.captures if c.shots[0].on_table},
        "plates": {c.folder: plain_value(c.shots[0].held[0].shape) for c in plan.captures if c.shots[0].held},
        "frames": {c.folder: _frames(rig, c, poses[c.folder], plan.image_format) for c in plan.captures},
        "seed": plan.seed,
    }


def _placed(placed: Placed) -> dict[str, Any]:
    shape = placed.shape
    return {
        "shape": type(shape).__name__,
        "sizes": shape.sizes(),
        "table_from_part": placed.frame_from_part.as_matrix().tolist(),
        "stated": plain_value(shape),
    }


def _frames(
    rig: Rig, capture: CapturePlan, poses: tuple[RigidTransform, ...], image_format: str
) -> list[dict[str, Any]]:
    frames = []
    for i, (shot, pose) in enumerate(zip(capture.shots, poses, strict=True)):
        frame: dict[str, Any] = {"image": image_name(i, image_format), "exposure_ms": shot.exposure_ms}
        if shot.angle_deg is not None:
            turned_rad = (rig.base_from_table(shot.angle_deg).inv() * pose).rotation.as_rotvec()[2]
            frame["angle_deg"] = shot.angle_deg
            frame["true_angle_deg"] = shot.angle_deg + rig.turn_sense * float(np.degrees(turned_rad))
            frame["run_out_um"] = (np.asarray(pose.translation)[:2] * 1e3).tolist()
            frame["base_from_table"] = pose.as_matrix().tolist()
        for placed in shot.held:
            frame["base_from_board"] = placed.frame_from_part.as_matrix().tolist()
        frames.append(frame)
    return frames


def image_name(index: int, image_format: str) -> str:
    """File of a frame within its capture."""
    return f"{index:04d}.{image_format}"


def fingerprint(rig: Rig, plan: SessionPlan) -> str:
    """Equal for two rigs and plans if, and only if, this program renders the same session from both."""
    shapes: dict[int, Any] = {}
    stated = [plain_value(rig, shapes), plain_value(plan, shapes), _source_key()]
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


@cache
def _source_key() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def plain_value(value: Any, seen: dict[int, Any] | None = None) -> Any:
    """A value of this layer as JSON holds it: dataclasses as dictionaries of what they were made from.

    ``seen`` keeps the texts of shapes, by identity: the same part stands in many frames.
    """
    if isinstance(value, RigidTransform):
        return value.as_matrix().tolist()
    if isinstance(value, np.ndarray):
        if value.size <= _LARGEST_LIST:
            return value.tolist()
        return {"shape": list(value.shape), "sha256": hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        if seen is not None and id(value) in seen:
            return seen[id(value)]
        fields = [f.name for f in dataclasses.fields(value) if f.init]
        plain = {"kind": type(value).__name__, **{name: plain_value(getattr(value, name), seen) for name in fields}}
        if seen is not None:
            seen[id(value)] = plain
        return plain
    if isinstance(value, Mapping):
        return {str(key): plain_value(entry, seen) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [plain_value(entry, seen) for entry in value]
    return value
