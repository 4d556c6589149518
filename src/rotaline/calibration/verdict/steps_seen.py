"""What the stripes on a stepped cylinder show of its shape, without believing its stated sizes.

Pieces of stripe that keep their height along the rotation axis lie on discs, the others on sides; the heights of the discs are the
levels of the staircase. Only the direction of the axis is needed for this, not its place, nor the angles of the turntable: so the
pieces are known before anything that may be wrong is used.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rotaline.calibration.observations import MountObservation
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import Line, Plane
from rotaline.vision.camera import CameraModel

TOP, SMALL_SIDE, STEP, LARGE_SIDE, TABLE = range(5)

_FLAT, _STEEP = 0.25, 0.5
"""How much of a step along the stripe goes along the axis, on a disc at most and on a side at least."""
_REACH = 0.02
"""Half the length of stripe on which its direction is seen, in units of the height of all that is seen."""
_MARGIN = 0.04
"""Distance from the levels where points count, in the same unit: near edges the stripe is bent."""
_FEW = 0.3
"""A level is seen in at least this part of the frames."""
_BINS = 240
_POINTS_PER_BIN = 8


@dataclass(frozen=True, eq=False)
class SeenSteps:
    """The points of one mount on the pieces of the staircase, in small groups whose mean counts as one observation.

    Attributes
    ----------
    name : of the mount
    angles_rad : (f,)   as read
    rays_camera : (n, 3)   viewing rays
    frame, piece, group : (n,)   of each point; pieces are numbered from the top, groups over all points of the mount
    height_mm : small and large step; NaN for the large one where no table top is seen
    """

    name: str
    angles_rad: Float[np.ndarray, " f"]
    rays_camera: Float[np.ndarray, "n 3"]
    frame: Int[np.ndarray, " n"]
    piece: Int[np.ndarray, " n"]
    group: Int[np.ndarray, " n"]
    height_mm: tuple[float, float]


def see_steps(camera: CameraModel, plane_camera: Plane, axis_camera: Line, mount: MountObservation) -> SeenSteps | None:
    """The staircase of a mount; None where top disc, step and both sides are not seen.

    Parameters
    ----------
    camera : CameraModel
    plane_camera : Plane   of the laser
    axis_camera : Line   whose direction counts
    mount : of a stepped cylinder, whose stated sizes play no part
    """
    rays, heights, slopes, frames = [], [], [], []
    whole = _extent(camera, plane_camera, axis_camera, mount)
    if not whole > 0:
        return None
    for f, stripe in enumerate(mount.stripes):
        if len(stripe) < 5:
            continue
        own = camera.rays(stripe.uv)
        points = intersect_rays_with_plane(own, plane_camera)
        height, slope = points @ axis_camera.direction, _slope(points, stripe.segment, axis_camera, _REACH * whole)
        good = np.isfinite(slope)
        rays.append(own[good])
        heights.append(height[good])
        slopes.append(slope[good])
        frames.append(np.full(int(good.sum()), f))
    if not rays:
        return None
    ray, z, slope, frame = (np.concatenate(a) for a in (rays, heights, slopes, frames))
    levels = _levels(z[slope < _FLAT], frame[slope < _FLAT], whole)
    if len(levels) < 2:
        return None
    piece = _pieces(z, slope, levels, whole)
    if any(np.count_nonzero(piece == k) < 20 for k in (TOP, SMALL_SIDE, STEP, LARGE_SIDE)):
        return None
    keep = piece >= 0
    ray, z, frame, piece = ray[keep], z[keep], frame[keep], piece[keep]
    some, group = _groups(z, frame, piece)
    height = (levels[0] - levels[1], levels[1] - levels[2] if len(levels) > 2 else float("nan"))
    return SeenSteps(mount.name, mount.angles_rad, ray[some], frame[some], piece[some], group, height)


def _extent(camera: CameraModel, plane: Plane, axis: Line, mount: MountObservation) -> float:
    """Height of all that is seen, without the last hundredths, mm."""
    uv = np.concatenate([np.empty((0, 2)), *(s.uv for s in mount.stripes)])
    if len(uv) < 20:
        return float("nan")
    height = intersect_rays_with_plane(camera.rays(uv), plane) @ axis.direction
    low, high = np.nanpercentile(height, [1, 99])
    return float(high - low)


def _slope(
    points: Float[np.ndarray, "n 3"], segment: Int[np.ndarray, " n"], axis: Line, reach_mm: float
) -> Float[np.ndarray, " n"]:
    """Part of the way along the stripe that goes along the axis, 0 to 1; NaN near the ends of a piece of stripe."""
    slope = np.full(len(points), np.nan)
    for s in np.unique(segment):
        mine = np.flatnonzero(segment == s)
        if len(mine) < 3:
            continue
        spacing = float(np.nanmedian(np.linalg.norm(np.diff(points[mine], axis=0), axis=1)))
        k = max(1, round(reach_mm / max(spacing, 1e-9)))
        if len(mine) <= 2 * k:
            continue
        way = points[mine[2 * k :]] - points[mine[: -2 * k]]
        slope[mine[k:-k]] = np.abs(way @ axis.direction) / np.maximum(np.linalg.norm(way, axis=1), 1e-12)
    return slope


def _levels(height: Float[np.ndarray, " n"], frame: Int[np.ndarray, " n"], whole: float) -> list[float]:
    """Heights that points on discs share in many frames, from above; at most the three highest."""
    if len(height) < 30:
        return []
    width = whole / _BINS
    at = ((height - height.min()) / width).astype(int)
    n_frames = len(np.unique(frame))
    counts = np.convolve(np.bincount(at), np.ones(5), mode="same")
    levels: list[float] = []
    while counts.max() >= 3:
        k = int(np.argmax(counts))
        near = np.abs(at - k) <= 3
        if len(np.unique(frame[near])) >= _FEW * n_frames:
            levels.append(float(np.median(height[near])))
        counts[max(k - 16, 0) : k + 17] = 0
    return sorted(levels, reverse=True)[:3]


def _pieces(
    z: Float[np.ndarray, " n"], slope: Float[np.ndarray, " n"], levels: list[float], whole: float
) -> Int[np.ndarray, " n"]:
    piece = np.full(len(z), -1)
    flat, steep, margin = slope < _FLAT, slope > _STEEP, _MARGIN * whole
    bottom = levels[2] if len(levels) > 2 else -np.inf
    for k, level in ((TOP, levels[0]), (STEP, levels[1]), (TABLE, bottom)):
        piece[flat & (np.abs(z - level) < 0.3 * margin)] = k
    piece[steep & (z < levels[0] - margin) & (z > levels[1] + margin)] = SMALL_SIDE
    piece[steep & (z < levels[1] - margin) & (z > bottom + margin)] = LARGE_SIDE
    return piece


def _groups(
    z: Float[np.ndarray, " n"], frame: Int[np.ndarray, " n"], piece: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Some points of each frame and piece, and the group of each; sides have an upper and a lower group."""
    chosen, groups, n = [], [], 0
    for f in np.unique(frame):
        for k in range(TABLE + 1):
            mine = np.flatnonzero((frame == f) & (piece == k))
            if len(mine) < 3:
                continue
            halves = [mine]
            if k in (SMALL_SIDE, LARGE_SIDE) and len(mine) >= 6:
                upper = z[mine] > np.median(z[mine])
                halves = [mine[upper], mine[~upper]]
            for half in halves:
                some = half[np.unique(np.linspace(0, len(half) - 1, min(len(half), _POINTS_PER_BIN)).astype(int))]
                chosen.append(some)
                groups.append(np.full(len(some), n))
                n += 1
    return np.concatenate(chosen), np.concatenate(groups)
