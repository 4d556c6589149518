"""What a rendered session holds: its captures frame by frame, as values.

A plan is complete before anything is rendered: the same plan and rig always give the same session.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Artifact
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.shapes import Rod, Shape
from rotaline.simulation.poses import axis_pose, camera_poses, laser_poses
from rotaline.simulation.rig import Rig
from rotaline.vision.targets.model import Target

IMAGE_FORMATS = ("png", "jpg", "bmp", "tiff")


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame: what stands where, and how it is lit.

    ``on_table`` turns with the table, ``held`` stands still (``base`` frame). ``angle_deg`` is what the read-out says; None: the
    table plays no part. ``ambient_e_per_ms`` is the light of the room, see :class:`rotaline.simulation.rig.Light`.
    """

    laser: bool
    exposure_ms: float
    ambient_e_per_ms: float
    angle_deg: float | None = None
    pose: str = ""
    on_table: tuple[Placed, ...] = ()
    held: tuple[Placed, ...] = ()


@dataclass(frozen=True, eq=False)
class CapturePlan:
    """A folder of frames."""

    folder: str
    role: str
    target: str | None
    shots: tuple[Shot, ...]


@dataclass(frozen=True)
class MeasurementPlan:
    """An entry of ``[[measurements]]``; ``reference`` in mm; ``check``: it judges the calibration."""

    capture: str
    feature: str
    reference: Mapping[str, float] = field(default_factory=dict)
    check: bool = False


@dataclass(frozen=True, eq=False)
class SessionPlan:
    """A whole session; ``seed`` fixes the noise of every frame."""

    targets: Mapping[str, Target | Artifact]
    captures: tuple[CapturePlan, ...]
    measurements: tuple[MeasurementPlan, ...] = ()
    image_format: str = "png"
    seed: int = 1

    def __post_init__(self) -> None:
        """Refuse formats that are not written."""
        if self.image_format not in IMAGE_FORMATS:
            raise ValueError(f"image_format must be one of {', '.join(IMAGE_FORMATS)}, not {self.image_format!r}.")

    @property
    def n_frames(self) -> int:
        """Images in all captures."""
        return sum(len(capture.shots) for capture in self.captures)


def mount(
    x_mm: float, y_mm: float, turn_deg: float = 0.0, tilt_deg: float = 0.0, tilt_towards_deg: float = 0.0
) -> RigidTransform:
    """``table_from_part`` of a part that stands off centre, turned about its own axis and tilted towards a direction."""
    towards = np.radians(tilt_towards_deg)
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([-np.sin(towards), np.cos(towards), 0.0]))
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)])
    return RigidTransform.from_components([x_mm, y_mm, 0.0], tilt * turn)


def laser_off(rig: Rig, **what: Any) -> Shot:
    """A frame in the light of the room."""
    return Shot(False, rig.light.exposure_off_ms, rig.light.ambient_e_per_ms, **what)


def laser_on(rig: Rig, ambient_fraction: float | None = None, **what: Any) -> Shot:
    """A frame with the laser; ``ambient_fraction`` of the room's light is left, None: as the rig says."""
    fraction = rig.light.ambient_on_fraction if ambient_fraction is None else ambient_fraction
    return Shot(True, rig.light.exposure_on_ms, rig.light.ambient_e_per_ms * fraction, **what)


def table_disc(rig: Rig) -> Placed:
    """The turntable's dark top, z = 0."""
    return Placed(Rod(2 * rig.table_radius_mm, 8.0, -8.0, Material(0.35)), RigidTransform.identity())


def _plate(board: Target | Plate) -> Plate:
    return board if isinstance(board, Plate) else Plate(board)


def camera_capture(
    rig: Rig, board: Target | Plate, name: str, n_views: int, seed: int, folder: str = "camera"
) -> CapturePlan:
    """Views of a target in the corners and the middle of the image, see :func:`rotaline.simulation.poses.camera_poses`.

    Parameters
    ----------
    rig : Rig
    board : the target on a plate with errors, or a target alone: on a plate without any
    name : of the target in the session
    n_views : number of frames
    seed : of the poses
    folder : of the capture

    Raises
    ------
    RigError
        If there are not so many poses in view.
    """
    plate, base_from_camera = _plate(board), rig.camera_from_base.inv()
    what = f"Capture {folder}, target {name}"
    poses = camera_poses(rig, plate, n_views, np.random.default_rng([seed, 1]), what)
    shots = tuple(laser_off(rig, held=(Placed(plate, base_from_camera * pose),)) for pose in poses)
    return CapturePlan(folder, "camera", name, shots)


def laser_capture(
    rig: Rig,
    board: Target | Plate,
    name: str,
    n_poses: int,
    seed: int,
    *,
    ambient_fraction: float | None = None,
    folder: str = "laser",
) -> CapturePlan:
    """Poses of a target in the laser sheet, each with the laser off and on; an ``ambient_fraction`` of 0.3 keeps it visible.

    See :func:`camera_capture` for the parameters, and :func:`rotaline.simulation.poses.laser_poses`.

    Raises
    ------
    RigError
        If there are not so many poses in view and in the sheet.
    """
    plate, base_from_camera = _plate(board), rig.camera_from_base.inv()
    what = f"Capture {folder}, target {name}"
    poses = laser_poses(rig, plate, n_poses, np.random.default_rng([seed, 2]), what)
    shots = []
    for i, pose in enumerate(poses):
        held = (Placed(plate, base_from_camera * pose),)
        shots += [
            laser_off(rig, pose=str(i), held=held),
            laser_on(rig, ambient_fraction, pose=str(i), held=held),
        ]
    return CapturePlan(folder, "laser-plane", name, tuple(shots))


def axis_capture(
    rig: Rig, board: Target | Plate, name: str, angles_deg: tuple[float, ...], folder: str = "axis"
) -> CapturePlan:
    """A target that stands on the table and leans back, in view at all angles; see :func:`rotaline.simulation.poses.axis_pose`.

    Raises
    ------
    RigError
        If it is not in view at all angles, wherever it stands.
    """
    plate = _plate(board)
    placed = Placed(plate, axis_pose(rig, plate, angles_deg, f"Capture {folder}, target {name}"))
    shots = tuple(laser_off(rig, angle_deg=angle, on_table=(placed, table_disc(rig))) for angle in angles_deg)
    return CapturePlan(folder, "axis", name, shots)


def scan_capture(
    rig: Rig,
    shape: Shape,
    table_from_part: RigidTransform,
    angles_deg: tuple[float, ...],
    *,
    folder: str,
    role: str = "scan",
    target: str | None = None,
) -> CapturePlan:
    """A part on the table, laser on, one frame an angle."""
    parts = (Placed(shape, table_from_part), table_disc(rig))
    shots = tuple(laser_on(rig, angle_deg=angle, on_table=parts) for angle in angles_deg)
    return CapturePlan(folder, role, target, shots)


def full_turn(n_frames: int) -> tuple[float, ...]:
    """Equal steps over a full turn, deg."""
    return tuple(360.0 * i / n_frames for i in range(n_frames))
