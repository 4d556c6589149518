"""The observations of a session as the joint estimate needs them: frame by frame, each in a group that shares a scale of noise.

A frame counts once: a view in role camera that is also the target of a stripe, or stands on the table, has its place there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.calibration.joint.model import GroupKind, JointStart
from rotaline.calibration.model import CameraCalibration, TargetView
from rotaline.calibration.observations import SessionObservations
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import Target, TargetDetection, bend_basis

_U_RANGE = (0.5, 3.0)
"""By how much the stated uncertainty of a detection may differ from the usual one of its capture."""


@dataclass(frozen=True, eq=False)
class TargetPoints:
    """Points of a target in one image.

    ``numbers`` are those of the target's points; ``places`` (mm) where they should be; ``basis`` their heights for unit bends; ``u`` (px, relative)
    the standard uncertainty of a coordinate, 1 for the usual one.
    """

    target: int
    group: int
    numbers: Int[np.ndarray, " n"]
    places: Float[np.ndarray, "n 2"]
    basis: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    u: float

    def renumbered(self, numbers: Int[np.ndarray, " n"], target: Target) -> "TargetPoints":
        """The same images of other points of the target."""
        places = target.points_board()[numbers, :2]
        basis = bend_basis(target.grid_size, target.pitch, places)
        return replace(self, numbers=numbers, places=places, basis=basis)


@dataclass(frozen=True, eq=False)
class StripeLine:
    """Points of a stripe: centre, unit normal, stated uncertainty along it, width (standard deviation of the profile).

    ``piece`` numbers runs of points that follow each other without a gap.
    """

    group: int
    uv: Float[np.ndarray, "m 2"]
    normal: Float[np.ndarray, "m 2"]
    u_px: Float[np.ndarray, " m"]
    width_px: Float[np.ndarray, " m"]
    piece: Int[np.ndarray, " m"]

    @staticmethod
    def of(group: int, stripe: StripePoints, chosen: Bool[np.ndarray, " n"] | None = None) -> "StripeLine":
        """The chosen points that have an uncertainty."""
        keep = np.isfinite(stripe.u_normal_px) & (stripe.u_normal_px > 0) & np.isfinite(stripe.width_px)
        index = np.flatnonzero(keep if chosen is None else keep & chosen)
        s = stripe.select(np.isin(np.arange(len(stripe)), index))
        gap = (np.diff(index, prepend=index[:1]) > 1) | (np.diff(s.segment, prepend=s.segment[:1]) != 0)
        return StripeLine(group, s.uv, s.normal, s.u_normal_px, s.width_px, np.cumsum(gap))

    def thinned(self, step: int) -> "StripeLine":
        """Every n-th point."""
        if step == 1:
            return self
        return StripeLine(
            self.group,
            self.uv[::step],
            self.normal[::step],
            self.u_px[::step],
            self.width_px[::step],
            self.piece[::step],
        )


@dataclass(frozen=True, eq=False)
class PlateFrame:
    """A target that is held, and the stripe on it if there is one."""

    name: str
    points: TargetPoints
    stripe: StripeLine | None
    stripe_name: str = ""


@dataclass(frozen=True, eq=False)
class TableFrame:
    """A target on the table."""

    name: str
    angle_rad: float
    board: int
    points: TargetPoints
    u_angle_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class MountFrame:
    """The stripe on an artefact."""

    name: str
    angle_rad: float
    mount: int
    number: int
    stripe: StripeLine
    u_angle_rad: float = 0.0


@dataclass(frozen=True)
class GroupInfo:
    """Observations that share a scale of noise."""

    kind: GroupKind
    name: str


@dataclass(frozen=True, eq=False)
class JointData:
    """All observations of the estimate.

    ``artifact_groups[k]``: which sizes the artefact of mount k has; mounts of the same artefact share them.
    """

    targets: tuple[Target, ...]
    plates: tuple[PlateFrame, ...]
    tables: tuple[TableFrame, ...]
    mount_frames: tuple[MountFrame, ...]
    groups: tuple[GroupInfo, ...]
    mount_names: tuple[str, ...]
    artifact_groups: tuple[int, ...]
    n_boards: int

    @property
    def angle_excess_rad(self) -> Float[np.ndarray, " f"]:
        """By how much the angle of each frame on the table (first targets, then mounts) is less certain than the best that is stated.

        ``sqrt(u^2 - min(u)^2)``; 0 where nothing is stated. So a figure that is the same for all frames, which the maker of a table may have
        been generous or modest with, plays no part: the data tell it better.
        """
        frames: list[TableFrame | MountFrame] = [*self.tables, *self.mount_frames]
        u = np.array([f.u_angle_rad for f in frames])
        stated = u > 0
        least = u[stated].min() if stated.any() else 0.0
        return np.sqrt(np.where(stated, u**2 - least**2, 0.0))


def gather(observations: SessionObservations, start: JointStart) -> JointData:
    """What takes part: views that the stages used, stripes on plates clear of the print, stripes on mounts that have a start."""
    groups: list[GroupInfo] = []
    targets: list[Target] = []

    def group(kind: GroupKind, name: str) -> int:
        info = GroupInfo(kind, name)
        if info not in groups:
            groups.append(info)
        return groups.index(info)

    def points(kind: GroupKind, name: str, detection: TargetDetection, u_usual: float) -> TargetPoints:
        target = _as_stated(start.camera, detection.target)
        if target not in targets:
            targets.append(target)
        places = target.points_board()[detection.point_ids, :2]
        u = float(np.clip(detection.u_px / u_usual, *_U_RANGE)) if u_usual > 0 else 1.0
        return TargetPoints(
            targets.index(target),
            group(kind, name.rpartition("/")[0] or name),
            detection.point_ids,
            places,
            bend_basis(target.grid_size, target.pitch, places),
            detection.uv,
            u,
        )

    used_camera = {v.name for v in start.camera.views if v.used}
    used_axis = {f.name for f in start.axis.frames if f.used} if start.axis is not None else set()
    on_table = [
        v for v in observations.table_views if v.name in used_axis and v.angle_rad is not None and start.axis_camera
    ]
    table_names = {v.name for v in on_table}
    placed = {v.name: v for v in start.laser_plane.views if v.used} if start.laser_plane is not None else {}
    with_stripe = [v for v in observations.plate_views if v.name in placed]
    plate_names = {v.detection_name or v.name for v in with_stripe}

    usual = _usual_u([*observations.camera_views, *on_table], [v.detection for v in with_stripe])
    plates: list[PlateFrame] = []
    for view in observations.camera_views:
        if view.name in used_camera and view.name not in table_names and view.name not in plate_names:
            plates.append(
                PlateFrame(view.name, points("target", view.name, view.detection, usual(view.detection)), None)
            )
    for stripe_view in with_stripe:
        name = stripe_view.detection_name or stripe_view.name
        mine = _rows_in(stripe_view.stripe, placed[stripe_view.name].uv)
        line = StripeLine.of(group("plate-stripe", stripe_view.name.rpartition("/")[0]), stripe_view.stripe, mine)
        detection = stripe_view.detection
        plates.append(PlateFrame(name, points("target", name, detection, usual(detection)), line, stripe_view.name))
    boards: list[Target] = []
    tables: list[TableFrame] = []
    for view in on_table:
        target = _as_stated(start.camera, view.detection.target)
        if target not in boards:
            boards.append(target)
        assert view.angle_rad is not None
        mine_points = points("table-target", view.name, view.detection, usual(view.detection))
        tables.append(TableFrame(view.name, view.angle_rad, boards.index(target), mine_points, view.u_angle_rad))

    started = {m.name: k for k, m in enumerate(start.mounts)}
    mounts = sorted((m for m in observations.mounts if m.name in started), key=lambda m: started[m.name])
    kinds: list[object] = []
    mount_frames: list[MountFrame] = []
    artifact_groups = []
    for k, mount in enumerate(mounts):
        if mount.artifact not in kinds:
            kinds.append(mount.artifact)
        artifact_groups.append(kinds.index(mount.artifact))
        number = group("artifact", mount.name)
        for f, stripe in enumerate(mount.stripes):
            if len(stripe) and np.isfinite(mount.angles_rad[f]):
                line = StripeLine.of(number, stripe)
                u_angle = 0.0 if mount.u_angles_rad is None else float(mount.u_angles_rad[f])
                mount_frames.append(MountFrame(mount.frame_names[f], float(mount.angles_rad[f]), k, f, line, u_angle))
    return JointData(
        tuple(targets),
        tuple(plates),
        tuple(tables),
        tuple(mount_frames),
        tuple(groups),
        tuple(m.name for m in mounts),
        tuple(artifact_groups),
        len(boards),
    )


def _as_stated(camera: CameraCalibration, target: Target) -> Target:
    """The target as the session states it, without what was found about its shape."""
    return camera.targets_as_stated[camera.targets.index(target)] if target in camera.targets else target


def _usual_u(views: Sequence[TargetView], detections: Sequence[TargetDetection]) -> Callable[[TargetDetection], float]:
    """The median of the stated uncertainties of all detections of a target."""
    everything = [*(v.detection for v in views), *detections]

    def usual(detection: TargetDetection) -> float:
        mine = [d.u_px for d in everything if d.target == detection.target and np.isfinite(d.u_px)]
        return float(np.median(mine)) if mine else 0.0

    return usual


def _rows_in(stripe: StripePoints, uv: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " n"]:
    """Which points of a stripe are among some of its points."""
    chosen = {(float(u), float(v)) for u, v in uv}
    return np.array([(float(u), float(v)) in chosen for u, v in stripe.uv], dtype=bool)
