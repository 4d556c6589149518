"""The unknowns of the joint estimate: their values, their places in the vector of parameters, and how a step changes them.

Poses move by small rotations and shifts about a point near what is seen of them, so that turn and shift hardly correlate. The camera sees the table
through ``camera_from_base``; its origin lies on the axis, at the middle of what stands on the table, not on the table top.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.joint.surfaces import mid_height, sizes_of, with_sizes
from rotaline.calibration.model import AngleError
from rotaline.calibration.reprojection import get_parameters, set_parameters
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, Plane, unit
from rotaline.vision.camera import CameraModel

POSE_MOTIONS = {6: (0, 1, 2, 3, 4, 5), 5: (0, 1, 3, 4, 5), 4: (0, 1, 3, 4), 3: (3, 4, 5)}
"""Which motions (turn about x, y, z; shift along x, y, z) a slot of so many parameters holds."""


def n_mount_parameters(artifact: Artifact) -> int:
    """Without what moves an artefact onto itself: turns of a sphere, a cylinder's turn about its axis, and its shift along it if its ends are unknown."""
    if isinstance(artifact, KnownSphere):
        return 3
    return 4 if isinstance(artifact, KnownCylinder) and artifact.height is None else 5


@dataclass(frozen=True, eq=False)
class Rigid:
    """A pose as plain arrays: ``rotation @ x + translation``, mm."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    @staticmethod
    def of(transform: RigidTransform) -> "Rigid":
        """The same pose."""
        return Rigid(transform.rotation.as_matrix(), np.asarray(transform.translation))

    def as_transform(self) -> RigidTransform:
        """The same pose."""
        return RigidTransform.from_components(self.translation, Rotation.from_matrix(self.rotation))

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in the outer frame."""
        return points @ self.rotation.T + self.translation

    def apply_inverse(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in the inner frame."""
        return (points - self.translation) @ self.rotation

    def moved(self, step: Float[np.ndarray, "6"], pivot: Float[np.ndarray, "3"]) -> "Rigid":
        """Turned about ``pivot`` (outer frame) by ``step[:3]`` (rad), then shifted by ``step[3:]`` (mm)."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return Rigid(turn @ self.rotation, turn @ (self.translation - pivot) + pivot + step[3:])


@dataclass(frozen=True)
class Layout:
    """Which parameters are estimated and where they stand in the vector: ``slots`` name groups of neighbours."""

    slots: tuple[tuple[str, int], ...]

    def __post_init__(self) -> None:
        """Places, once."""
        places, at = {}, 0
        for name, size in self.slots:
            places[name] = slice(at, at + size)
            at += size
        object.__setattr__(self, "_places", places)
        object.__setattr__(self, "size", at)

    _places: dict[str, slice] = field(init=False, repr=False, compare=False)
    size: int = field(init=False, compare=False)

    def __contains__(self, name: str) -> bool:
        """Whether a group is estimated."""
        return name in self._places

    def of(self, name: str) -> slice:
        """Where a group stands."""
        return self._places[name]

    def with_slot(self, name: str, size: int) -> "Layout":
        """One more group, at the end."""
        return Layout((*self.slots, (name, size)))


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns.

    Attributes
    ----------
    camera : CameraModel
    plates : camera_from_board of each view of a target that is held
    plane, plane_pivot : the laser plane and the point in it about which it turns (camera frame, mm)
    curvature : (3,)   see :class:`rotaline.geometry.primitives.SheetCurvature`, about ``plane_pivot``
    camera_from_base : Rigid or None
    turn_sense : +1 or -1
    angle_error, run_out, wobble : errors of the table once per turn; run-out (mm) and wobble (rad) turn against the table
    boards : table_from_board of each target on the table
    mounts : table_from_part
    artifacts : with their sizes as estimated
    bends : (3,) of each target, mm
    pitch_errors : of each target, true over stated pitch minus 1
    line_variance : square of the standard deviation of the laser line, mm^2
    stripe_blur_px : standard deviation of the image of a line without width
    """

    camera: CameraModel
    plates: tuple[Rigid, ...]
    plane: Plane | None
    plane_pivot: Float[np.ndarray, "3"]
    curvature: Float[np.ndarray, "3"]
    camera_from_base: Rigid | None
    turn_sense: int
    angle_error: AngleError
    run_out: Float[np.ndarray, "2"]
    wobble: Float[np.ndarray, "2"]
    boards: tuple[Rigid, ...]
    mounts: tuple[Rigid, ...]
    artifacts: tuple[Artifact, ...]
    bends: tuple[Float[np.ndarray, "3"], ...]
    pitch_errors: tuple[float, ...]
    line_variance: float = 0.0
    stripe_blur_px: float = 0.0

    def mount_pivot(self, mount: int) -> Float[np.ndarray, "3"]:
        """The point of the table frame about which a mount's pose is counted."""
        return self.mounts[mount].apply(np.array([[0.0, 0.0, mid_height(self.artifacts[mount])]]))[0]

    def after(
        self,
        layout: Layout,
        step: Float[np.ndarray, " p"],
        camera_names: Sequence[str],
        plate_steps: Mapping[int, tuple[Float[np.ndarray, "6"], Float[np.ndarray, "3"]]],
        board_pivots: Sequence[Float[np.ndarray, "3"]],
        groups: Sequence[int],
    ) -> "State":
        """The state after a step.

        Parameters
        ----------
        layout, step : the vector
        camera_names : parameters in the slot "camera"
        plate_steps : motion and pivot (camera frame) of the plates that moved
        board_pivots : of each board, in the board frame
        groups : which artefact (slot "sizes:<g>") each mount holds
        """

        def part(name: str, size: int) -> Float[np.ndarray, " k"]:
            return step[layout.of(name)] if name in layout else np.zeros(size)

        camera = set_parameters(
            self.camera, camera_names, get_parameters(self.camera, camera_names) + part("camera", len(camera_names))
        )
        plane, pivot = self.plane, self.plane_pivot
        if plane is not None:
            e1, e2 = across(plane.normal)
            turn1, turn2, offset = part("plane", 3)
            raw = plane.normal + turn1 * e1 + turn2 * e2
            height = float(plane.normal @ pivot + plane.offset) + offset
            normal = unit(raw)
            plane = Plane(normal, height / float(np.linalg.norm(raw)) - float(normal @ pivot))
        base = self.camera_from_base
        if base is not None:
            tx, ty, sx, sy = part("axis", 4)
            turn = Rotation.from_rotvec([tx, ty, 0.0]).as_matrix()
            base = Rigid(base.rotation @ turn, base.rotation @ np.array([sx, sy, 0.0]) + base.translation)
        cos, sin = part("angle", 2)
        mounts, artifacts = [], []
        for k, (pose, artifact) in enumerate(zip(self.mounts, self.artifacts, strict=True)):
            move = np.zeros(6)
            slot = f"mount:{k}"
            moves = POSE_MOTIONS[n_mount_parameters(artifact)]
            move[list(moves)] = part(slot, len(moves))
            mounts.append(pose.moved(move, self.mount_pivot(k)))
            sizes = sizes_of(artifact)
            artifacts.append(with_sizes(artifact, sizes + part(f"sizes:{groups[k]}", len(sizes))))
        return replace(
            self,
            camera=camera,
            plates=tuple(
                pose.moved(*plate_steps[k]) if k in plate_steps else pose for k, pose in enumerate(self.plates)
            ),
            plane=plane,
            curvature=self.curvature + part("curvature", 3),
            camera_from_base=base,
            angle_error=AngleError(self.angle_error.cos_rad + float(cos), self.angle_error.sin_rad + float(sin)),
            run_out=self.run_out + part("run-out", 2),
            wobble=self.wobble + part("wobble", 2),
            line_variance=self.line_variance + float(part("line", 1)[0]),
            boards=tuple(
                pose.moved(part(f"board:{k}", 6), pose.apply(board_pivots[k][None])[0])
                for k, pose in enumerate(self.boards)
            ),
            mounts=tuple(mounts),
            artifacts=tuple(artifacts),
            bends=tuple(b + part(f"bend:{k}", 3) for k, b in enumerate(self.bends)),
            pitch_errors=tuple(e + float(part(f"pitch:{k}", 1)[0]) for k, e in enumerate(self.pitch_errors)),
        )


def turn_z(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def base_motion(state: State, turned_rad: float) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """``base_from_table`` at a turned angle with the once-per-turn errors of the table: rotation and shift (mm)."""
    turn = turn_z(turned_rad)
    if not (state.run_out.any() or state.wobble.any()):
        return turn, np.zeros(3)
    against = turn_z(-turned_rad)[:2, :2]
    tilt = Rotation.from_rotvec([*(against @ state.wobble), 0.0]).as_matrix()
    return tilt @ turn, np.array([*(against @ state.run_out), 0.0])


def turned_rad(state: State, read_rad: float) -> float:
    """How far the table has turned, right-handed about base z."""
    return state.turn_sense * float(state.angle_error.turned_rad(np.array([read_rad]))[0])


def table_motions(
    state: State, read_rad: float, layout: Layout, pose_slot: str, pivot_table: Float[np.ndarray, "3"]
) -> dict[str, Float[np.ndarray, "6 _"]]:
    """How the global parameters move what stands on the table in one frame: (turn about x, y, z; shift) of the base frame."""
    angle = turned_rad(state, read_rad)
    against = turn_z(-angle)[:2, :2]
    motions: dict[str, Float[np.ndarray, "6 _"]] = {}
    motions["axis"] = np.eye(6)[:, [0, 1, 3, 4]]
    about_z = np.zeros((6, 2))
    about_z[2] = state.turn_sense * np.array([np.cos(read_rad), np.sin(read_rad)])
    motions["angle"] = about_z
    motions["run-out"] = np.vstack([np.zeros((3, 2)), against, np.zeros((1, 2))])
    motions["wobble"] = np.vstack([against, np.zeros((4, 2))])
    turn, _ = base_motion(state, angle)
    pose = np.zeros((6, 6))
    pose[:3, :3] = turn
    pose[3:, 3:] = turn
    pose[3:, :3] = turn @ np.array(
        [
            [0.0, -pivot_table[2], pivot_table[1]],
            [pivot_table[2], 0.0, -pivot_table[0]],
            [-pivot_table[1], pivot_table[0], 0.0],
        ]
    )
    size = layout.of(pose_slot).stop - layout.of(pose_slot).start
    motions[pose_slot] = pose[:, list(POSE_MOTIONS[size])]
    return motions


def once_per_turn(state: State, slot: str) -> Float[np.ndarray, "2"]:
    """The present values of an error of the table once per turn: "angle", "run-out" or "wobble"."""
    if slot == "angle":
        return np.array([state.angle_error.cos_rad, state.angle_error.sin_rad])
    return state.run_out if slot == "run-out" else state.wobble
