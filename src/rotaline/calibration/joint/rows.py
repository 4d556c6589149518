"""Residuals in px and their derivatives, frame by frame, each frame pressed into a small triangle.

In every frame the columns are: its own motion (six: a target that is held moves in the camera frame; what stands on the table moves in the base
frame), then what the frame shares with others. How axis, angle errors and the poses of boards and mounts move the table are combinations of the six
(:func:`rotaline.calibration.joint.state.table_motions`), so they need no rows of their own. Orthogonal factorisation keeps of a thousand rows some
thirty that say the same [1]_: memory and time of what follows do not grow with the number of points.

A stripe point's residual is its distance from where it should lie (mm) over the change of that distance per px along the stripe's normal.

References
----------
.. [1] Björck, Numerical Methods for Least Squares Problems, 1996, section 6.3 (observations block by block)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from rotaline.calibration.joint.data import JointData, MountFrame, PlateFrame, StripeLine, TableFrame, TargetPoints
from rotaline.calibration.joint.line_width import crossing
from rotaline.calibration.joint.rays import RayBundle
from rotaline.calibration.joint.state import Rigid, State, base_motion, turned_rad
from rotaline.calibration.joint.surfaces import NONE, assign, by_sizes, curvature_of, has_axis
from rotaline.calibration.reprojection import projection_jacobians
from rotaline.calibration.stripe_shift import STRIP_VARIANCE_PX2, WINDOW_SHARE
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import KnownSphere
from rotaline.vision.targets.model import bend_basis

EDGE_WIDTHS = 3.0
"""Distance that points keep from the edges of an artefact, in standard deviations of the stripe's profile."""
_LEAST_SENSITIVITY = 0.15
"""Points that move off their surface less than this times as fast as usual (per px) are left out: the laser grazes there."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of one frame with their derivatives, not weighted.

    Attributes
    ----------
    residuals : (n,)   px; of target points u and v in turn
    local : (n, l)   by the frame's own motion, and by what else is its own
    common : by groups of parameters that frames share
    group : (n,)   of noise
    u : (n,)   relative standard uncertainty of a residual
    point : (n,)   number of the point: both coordinates of a target point share it
    piece : (n,)   points of a stripe with the same number follow each other without a gap
    mm_per_px : (n,)   distance (mm) per px of the residual; NaN for target points
    place : of target points: (n, 2) derivative by an offset of the point in x and y of its board, else None
    """

    residuals: Float[np.ndarray, " n"]
    local: Float[np.ndarray, "n l"]
    common: dict[str, Float[np.ndarray, "_ _"]]
    group: Int[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    piece: Int[np.ndarray, " n"]
    mm_per_px: Float[np.ndarray, " n"]
    place: Float[np.ndarray, "m 2 2"] | None


@dataclass(frozen=True, eq=False)
class MountPoints:
    """Where the points of a mount's frame lie; the rows hold those with a surface (``chosen``), in order.

    ``distances_mm`` are free of the shift that the line's width makes. ``steepness``: ``a`` of :func:`rotaline.calibration.joint.line_width.crossing`.
    """

    chosen: Int[np.ndarray, " k"]
    surface: Int[np.ndarray, " k"]
    points_part: Float[np.ndarray, "k 3"]
    distances_mm: Float[np.ndarray, " k"]
    width_px: Float[np.ndarray, " k"]
    steepness: Float[np.ndarray, " k"]

    def part(self, points: slice, chosen: Int[np.ndarray, " j"]) -> "MountPoints":
        """Some of the points, with their numbers in another frame."""
        return MountPoints(
            chosen,
            self.surface[points],
            self.points_part[points],
            self.distances_mm[points],
            self.width_px[points],
            self.steepness[points],
        )


def plate_rows(state: State, frame: PlateFrame, pose: Rigid, data: JointData, names: Sequence[str]) -> Rows:
    """Rows of a target that is held: its points, then the stripe on it.

    The local columns are the motion of the plate about the mean of its points in the camera frame (6), and what its surface is off the plane of
    its points, in the middle and at its edges (3, mm).
    """
    points = frame.points
    camera_points, place_rotation = _placed(state, points, pose)
    target_rows = _target_rows(state, points, camera_points, place_rotation, names)
    pivot = camera_points.mean(axis=0)
    if frame.stripe is None or state.plane is None or len(frame.stripe.uv) == 0:
        return target_rows
    return _joined(target_rows, _plate_stripe_rows(state, frame.stripe, points.target, pose, pivot, data, names))


def plate_pivot(state: State, frame: PlateFrame, pose: Rigid) -> Float[np.ndarray, "3"]:
    """The point (camera frame, mm) about which a plate turns."""
    return _placed(state, frame.points, pose)[0].mean(axis=0)


def table_rows(state: State, frame: TableFrame, names: Sequence[str]) -> Rows:
    """Rows of a target on the table; the local columns are a motion of the base frame (turn about x, y, z in rad, shift in mm)."""
    base = state.camera_from_base
    assert base is not None
    board = state.boards[frame.board]
    turn, shift = base_motion(state, turned_rad(state, frame.angle_rad))
    to_base = Rigid(turn @ board.rotation, turn @ board.translation + shift)
    pose = Rigid(base.rotation @ to_base.rotation, base.apply(to_base.translation[None])[0])
    camera_points, place_rotation = _placed(state, frame.points, pose)
    rows = _target_rows(state, frame.points, camera_points, place_rotation, names)
    by_base_point = (
        rows.local[:, 3:6] @ base.rotation
    )  # a shift of the points in the camera frame, seen from the base frame
    base_points = np.repeat(base.apply_inverse(camera_points), 2, axis=0)
    local = np.hstack([np.cross(base_points, by_base_point), by_base_point])
    return Rows(
        rows.residuals, local, rows.common, rows.group, rows.u, rows.point, rows.piece, rows.mm_per_px, rows.place
    )


def mount_rows(
    state: State, frames: Sequence[MountFrame], data: JointData, names: Sequence[str], band_mm: float
) -> list[tuple[Rows, MountPoints]]:
    """Rows of frames of one mount of an artefact; the local columns are a motion of the base frame, as in :func:`table_rows`."""
    plane, base = state.plane, state.camera_from_base
    assert plane is not None
    assert base is not None
    mount = frames[0].mount
    artifact, pose = state.artifacts[mount], state.mounts[mount]
    counts = [len(f.stripe.uv) for f in frames]
    number = np.repeat(np.arange(len(frames)), counts)
    uv, normal_px, width = (
        np.concatenate([getattr(f.stripe, name) for f in frames]) for name in ("uv", "normal", "width_px")
    )
    bundle = RayBundle.of(state.camera, uv)
    rays = bundle.directions
    depth, gradient = _meet_sheet(state, rays)
    points_camera = rays * depth[:, None]
    points_base = base.apply_inverse(points_camera)
    motions = [base_motion(state, turned_rad(state, f.angle_rad)) for f in frames]
    turns, shifts = np.array([m[0] for m in motions]), np.array([m[1] for m in motions])
    points_table = np.einsum("nij,ni->nj", turns[number], points_base - shifts[number])
    points_part = pose.apply_inverse(points_table)

    slope = np.einsum("ni,ni->n", rays, gradient)
    tangent = np.stack([-normal_px[:, 1], normal_px[:, 0]], axis=1)
    along_xy = np.einsum("nij,nj->ni", bundle.by_pixel, tangent) * depth[:, None]
    along = np.column_stack([along_xy, np.zeros(len(uv))])
    along -= rays * (np.einsum("ni,ni->n", along, gradient) / slope)[:, None]
    margin = EDGE_WIDTHS * width * np.linalg.norm(along, axis=1)
    found = assign(artifact, points_part, margin, band_mm)

    normal_base = np.einsum("nij,nj->ni", turns[number], found.normal @ pose.rotation.T)
    normal_camera = normal_base @ base.rotation.T
    lever = np.einsum("ni,ni->n", normal_camera, rays) / slope
    by_xy = depth[:, None] * (normal_camera[:, :2] - lever[:, None] * gradient[:, :2])
    per_px = bundle.per_pixel(by_xy, normal_px)
    usable = (found.surface != NONE) & np.isfinite(per_px) & np.isfinite(found.distance)
    typical = float(np.median(np.abs(per_px[usable]))) if usable.any() else 0.0
    usable &= np.abs(per_px) > _LEAST_SENSITIVITY * typical

    group = data.artifact_groups[mount]
    by_px = np.einsum("nij,nj->ni", bundle.by_pixel, normal_px)
    length = np.linalg.norm(gradient, axis=1)
    curvature = curvature_of(artifact, points_part, found.surface)
    axis_base = np.einsum("nij,j->ni", turns, pose.rotation[:, 2]) if has_axis(artifact) else np.zeros((len(frames), 3))
    straight = (axis_base @ base.rotation.T)[number]
    steepness, bend = crossing(rays, by_px, depth, normal_camera, curvature, straight, gradient / length[:, None])
    share = state.line_variance / steepness**2
    share = 1.0 - WINDOW_SHARE * share / np.maximum(share + state.stripe_blur_px**2, 1e-12)
    by_variance = -1.5 * bend / steepness**3 * share
    shift = state.line_variance * by_variance
    if isinstance(artifact, KnownSphere):  # the stripe is curved in the image
        by_px = np.einsum("nij,nj->ni", bundle.by_pixel, tangent)
        _, curved = crossing(rays, by_px, depth, normal_camera, curvature, straight, gradient / length[:, None])
        shift = shift - curved / (2.0 * steepness) * (state.stripe_blur_px**2 + STRIP_VARIANCE_PX2)
    chosen = np.flatnonzero(usable)
    per_px = per_px[chosen]
    scale = (1.0 / per_px)[:, None]
    surface, by_variance = found.surface[chosen], by_variance[chosen]
    g = normal_base[chosen]
    local = np.hstack([-np.cross(points_base[chosen], g), -g]) * scale
    on_sheet, bent_sheet = _sheet_columns(state, points_camera[chosen])
    by_sheet = -lever[chosen, None] * scale
    common = {
        "camera": bundle.select(usable).camera_columns(by_xy[chosen], names) * scale,
        "plane": by_sheet * on_sheet,
        "curvature": by_sheet * bent_sheet,
        f"sizes:{group}": by_sizes(artifact, surface) * scale,
        "line": -by_variance[:, None],
    }
    residuals = found.distance[chosen] * scale[:, 0] - shift[chosen]
    points = MountPoints(chosen, surface, points_part[chosen], residuals * per_px, width[chosen], steepness[chosen])
    starts = np.cumsum([0, *counts[:-1]])
    ends = np.searchsorted(number[chosen], np.arange(len(frames) + 1))
    out = []
    for frame, start, (first, last) in zip(frames, starts, pairwise(ends), strict=True):
        part = slice(first, last)
        inside = chosen[part] - start
        rows = Rows(
            residuals[part],
            local[part],
            {name: columns[part] for name, columns in common.items()},
            np.full(len(inside), frame.stripe.group),
            frame.stripe.u_px[inside],
            np.arange(len(inside)),
            _pieces(inside, frame.stripe.piece[inside], surface[part]),
            per_px[part],
            None,
        )
        out.append((rows, points.part(part, inside)))
    return out


def _pieces(
    index: Int[np.ndarray, " k"], piece: Int[np.ndarray, " k"], surface: Int[np.ndarray, " k"]
) -> Int[np.ndarray, " k"]:
    """Runs of neighbours on one surface."""
    new = (np.diff(index, prepend=index[:1]) > 1) | (np.diff(piece, prepend=piece[:1]) != 0)
    return np.cumsum(new | (np.diff(surface, prepend=surface[:1]) != 0))


def _placed(
    state: State, points: TargetPoints, pose: Rigid
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3 3"]]:
    """Points of a target in the camera frame, with pitch and bend as estimated, and the rotation of its frame."""
    xy = points.places * (1.0 + state.pitch_errors[points.target])
    height = points.basis @ state.bends[points.target]
    return pose.apply(np.column_stack([xy, height])), pose.rotation


def _target_rows(
    state: State,
    points: TargetPoints,
    camera_points: Float[np.ndarray, "n 3"],
    rotation: Float[np.ndarray, "3 3"],
    names: Sequence[str],
) -> Rows:
    uv, by_camera, by_pose = projection_jacobians(state.camera, camera_points, names)
    n = len(uv)
    by_point = by_pose[:, :, 3:]
    by_place = by_point @ rotation  # along x, y, z of the board
    common = {
        "camera": -by_camera.reshape(2 * n, -1),
        f"pitch:{points.target}": -np.einsum("nij,nj->ni", by_place[:, :, :2], points.places).reshape(-1, 1),
        f"bend:{points.target}": -(by_place[:, :, 2:3] * points.basis[:, None, :]).reshape(-1, 3),
    }
    return Rows(
        (points.uv - uv).ravel(),
        -by_pose.reshape(2 * n, 6),
        common,
        np.full(2 * n, points.group),
        np.full(2 * n, points.u),
        np.repeat(np.arange(n), 2),
        np.arange(2 * n),
        np.full(2 * n, np.nan),
        -by_place[:, :, :2],
    )


def _plate_stripe_rows(
    state: State,
    stripe: StripeLine,
    target: int,
    pose: Rigid,
    pivot: Float[np.ndarray, "3"],
    data: JointData,
    names: Sequence[str],
) -> Rows:
    bundle = RayBundle.of(state.camera, stripe.uv)
    rays = bundle.directions
    described = data.targets[target]
    bend = state.bends[target]
    n = len(rays)
    facing = np.broadcast_to(pose.rotation[:, 2], (n, 3))
    depth = (pose.rotation[:, 2] @ pose.translation) / np.einsum("ni,ni->n", rays, facing)
    xy = pose.apply_inverse(rays * depth[:, None])[:, :2]
    basis = bend_basis(described.grid_size, described.pitch, xy)
    if bend.any():
        for _ in range(2):
            tilt = np.stack(
                [
                    (bend_basis(described.grid_size, described.pitch, xy + step) - basis) @ bend / 0.1
                    for step in (np.array([0.1, 0.0]), np.array([0.0, 0.1]))
                ],
                axis=1,
            )
            facing = np.column_stack([-tilt, np.ones(n)]) @ pose.rotation.T
            point = pose.apply_inverse(rays * depth[:, None])
            off = point[:, 2] - basis @ bend
            depth = depth - off / np.einsum("ni,ni->n", rays, facing)
            xy = pose.apply_inverse(rays * depth[:, None])[:, :2]
            basis = bend_basis(described.grid_size, described.pitch, xy)
    points = rays * depth[:, None]
    distance, gradient = _sheet_distance(state, points)
    lever = np.einsum("ni,ni->n", rays, gradient) / np.einsum("ni,ni->n", rays, facing)
    by_xy = depth[:, None] * (gradient[:, :2] - lever[:, None] * facing[:, :2])
    scale = 1.0 / bundle.per_pixel(by_xy, stripe.normal)
    grid = np.array([described.grid_size[0] - 1, described.grid_size[1] - 1]) * described.pitch
    relative = 2.0 * (xy - grid / 2) / np.linalg.norm(grid)
    sheet = _sheet_columns(state, points)
    by_height = (lever * scale)[:, None]
    local = np.hstack(
        [
            by_height * np.hstack([np.cross(points - pivot, facing), facing]),
            by_height * np.column_stack([np.ones(n), relative]),
        ]
    )
    common = {
        "camera": bundle.camera_columns(by_xy, names) * scale[:, None],
        "plane": sheet[0] * scale[:, None],
        "curvature": sheet[1] * scale[:, None],
        f"bend:{target}": by_height * basis,
    }
    return Rows(
        distance * scale,
        local,
        common,
        np.full(n, stripe.group),
        stripe.u_px,
        np.arange(n),
        stripe.piece,
        1.0 / scale,
        None,
    )


def _joined(target: Rows, stripe: Rows) -> Rows:
    """Rows of a target and of the stripe on it."""
    n, m = len(target.residuals), len(stripe.residuals)
    common = {}
    for name in {**target.common, **stripe.common}:
        k = (target.common if name in target.common else stripe.common)[name].shape[1]
        common[name] = np.vstack([target.common.get(name, np.zeros((n, k))), stripe.common.get(name, np.zeros((m, k)))])
    first_point = int(target.point[-1]) + 1 if n else 0
    return Rows(
        np.concatenate([target.residuals, stripe.residuals]),
        np.vstack([np.hstack([target.local, np.zeros((n, 3))]), stripe.local]),
        common,
        np.concatenate([target.group, stripe.group]),
        np.concatenate([target.u, stripe.u]),
        np.concatenate([target.point, stripe.point + first_point]),
        np.concatenate([target.piece, stripe.piece]),
        np.concatenate([target.mm_per_px, stripe.mm_per_px]),
        target.place,
    )


def _sheet_distance(
    state: State, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " _"], Float[np.ndarray, "n 3"]]:
    """Value and gradient of the function that is 0 on the sheet of light (mm)."""
    plane = state.plane
    assert plane is not None
    distance = points @ plane.normal + plane.offset
    gradient = np.broadcast_to(plane.normal, points.shape)
    if state.curvature.any():
        axes = np.stack(across(plane.normal))
        u, v = ((points - state.plane_pivot) @ axes.T).T
        a, b, c = state.curvature
        distance = distance + (a * u * u + 2 * b * u * v + c * v * v) / 2
        gradient = gradient + np.column_stack([a * u + b * v, b * u + c * v]) @ axes
    return distance, gradient


def _meet_sheet(
    state: State, rays: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " _"], Float[np.ndarray, "n 3"]]:
    """Depth at which rays meet the sheet (NaN behind the camera), and its gradient there."""
    plane = state.plane
    assert plane is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -plane.offset / (rays @ plane.normal)
    depth = np.where(depth > 0, depth, np.nan)
    for _ in range(3 if state.curvature.any() else 0):
        distance, gradient = _sheet_distance(state, rays * depth[:, None])
        depth = depth - distance / np.einsum("ni,ni->n", rays, gradient)
    return depth, _sheet_distance(state, rays * depth[:, None])[1]


def _sheet_columns(
    state: State, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Derivative of the sheet's function by turns and offset of the plane, and by its curvature."""
    plane = state.plane
    assert plane is not None
    u, v = ((points - state.plane_pivot) @ np.stack(across(plane.normal)).T).T
    return np.column_stack([u, v, np.ones(len(u))]), np.column_stack([u * u / 2, u * v, v * v / 2])
