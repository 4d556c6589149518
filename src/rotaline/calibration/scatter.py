"""Where the scatter of the distances on an artefact comes from: within a frame, from frame to frame, over the turn.

The mean distance of each frame on each surface is split by least squares into waves with 1, 2 .. cycles a turn and a rest. The rest, less
what the points of a frame leave in their mean, is the scatter from frame to frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rotaline.calibration.joint.model import JointMount

N_WAVES = 4
_MIN_POINTS = 5
_MAX_GAP_RAD = np.pi / 4
_CHANCE = 3.0
"""Power of a wave over its mean from chance that is exceeded once in twenty times: -ln 0.05."""


@dataclass(frozen=True, eq=False)
class MountScatter:
    """Scatter of one mount by its origin, root mean squares over all its surfaces, mm.

    Attributes
    ----------
    name : of the mount
    total_mm : of all distances
    within_mm : of single points about the mean of their frame on their surface
    between_mm : of the frames about the waves over the turn; NaN for fewer than 3 frames
    waves_mm : (k,) of the waves with 1, 2 .. k cycles a turn; NaN where the frames do not cover the turn
    chance_mm : a wave that is smaller may be chance (5 %)
    """

    name: str
    total_mm: float
    within_mm: float
    between_mm: float
    waves_mm: Float[np.ndarray, " k"]
    chance_mm: float


def mount_scatter(mount: JointMount, correlation_length: float = 1.0) -> MountScatter:
    """The scatter of the distances of the points that were not left out.

    Parameters
    ----------
    mount : JointMount
    correlation_length : as many neighbours along a stripe count as one
    """
    used = mount.used & np.isfinite(mount.distances_mm)
    within = between = chance = 0.0
    waves = np.zeros(N_WAVES)
    n_within = n_between = 0
    for s in range(len(mount.surfaces)):
        chosen = used & (mount.surface == s)
        if not chosen.any():
            continue
        count, mean, rest = _frames(mount.frame[chosen], mount.distances_mm[chosen], len(mount.frame_names))
        enough = count >= _MIN_POINTS
        degrees = int((count[enough] - 1).sum())
        if degrees == 0:
            continue
        variance = float(rest[enough].sum()) / degrees
        n = int(count[enough].sum())
        within, n_within = within + n * variance, n_within + n
        left_in_mean = float(np.mean(np.minimum(correlation_length / count[enough], 1.0))) * variance
        split = _split(mount.angles_rad[enough], mean[enough])
        if split is not None:
            power, rest_variance, chance_power = split
            between += n * max(0.0, rest_variance - left_in_mean)
            waves, chance, n_between = waves + n * power, chance + n * chance_power, n_between + n
    return MountScatter(
        mount.name,
        _root(float(np.sum(mount.distances_mm[used] ** 2)), int(used.sum())),
        _root(within, n_within),
        _root(between, n_between),
        np.array([_root(float(w), n_between) for w in waves]),
        _root(chance, n_between),
    )


def _frames(
    frame: Int[np.ndarray, " n"], distances_mm: Float[np.ndarray, " n"], n_frames: int
) -> tuple[Int[np.ndarray, " f"], Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
    """Of each frame: points, their mean, and the sum of squares about it."""
    count = np.bincount(frame, minlength=n_frames)
    at_least_one = np.maximum(count, 1)
    mean = np.bincount(frame, distances_mm, minlength=n_frames) / at_least_one
    rest = np.bincount(frame, (distances_mm - mean[frame]) ** 2, minlength=n_frames)
    return count, mean, rest


def _split(
    angles_rad: Float[np.ndarray, " f"], means_mm: Float[np.ndarray, " f"]
) -> tuple[Float[np.ndarray, " k"], float, float] | None:
    """Mean squares of the waves, of the rest, and of a wave that chance reaches once in twenty times; None below 3 frames."""
    n = len(angles_rad)
    if n < 3:
        return None
    turn = np.sort(np.mod(angles_rad, 2.0 * np.pi))
    gaps = np.diff(np.append(turn, turn[0] + 2.0 * np.pi))
    k = np.arange(1, N_WAVES + 1) if n > 3 * N_WAVES and gaps.max() < _MAX_GAP_RAD else np.arange(0)
    phase = angles_rad[:, None] * k
    design = np.hstack([np.ones((n, 1)), np.cos(phase), np.sin(phase)])
    found, *_ = np.linalg.lstsq(design, means_mm, rcond=None)
    rest = float(np.sum((means_mm - design @ found) ** 2)) / (n - design.shape[1])
    power = np.full(N_WAVES, np.nan)
    power[: len(k)] = (found[1 : 1 + len(k)] ** 2 + found[1 + len(k) :] ** 2) / 2.0
    return power, rest, _CHANCE * 2.0 * rest / n


def _root(total: float, n: int) -> float:
    return float(np.sqrt(total / n)) if n else float("nan")
