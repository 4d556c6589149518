"""What views, poses and mounts show that took no part: the estimate without one of them, held against it.

Leaving a frame out changes the few global parameters; since the problem is all but linear near its solution, the rows of the other frames, already
pressed together, give the change without another iteration.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.iterate import Iterated
from rotaline.calibration.joint.linear import FrameResiduals, Setting, prior_rows
from rotaline.calibration.joint.noise import KEPT
from rotaline.calibration.joint.solve import global_factor, solve_factor
from rotaline.calibration.joint.state import Layout


@dataclass(frozen=True, eq=False)
class HeldOut:
    """RMS of the residuals of what was left out: of each frame's target points and stripe (px), of each mount's distances (mm)."""

    targets_px: dict[int, float]
    stripes_px: dict[int, float]
    mounts_mm: tuple[float, ...]

    def of(self, frame: int, stripe: bool) -> float:
        """Of one frame; NaN where it was not tried."""
        return (self.stripes_px if stripe else self.targets_px).get(frame, float("nan"))


def held_out(setting: Setting, found: Iterated) -> HeldOut:
    """Leave out each view of a held target, and each mount, in turn."""
    data = setting.data
    prior = prior_rows(setting, found.layout, found.state)
    rests = found.eliminated.rests
    n_plates, n_tables = len(data.plates), len(data.tables)
    tables = global_factor(rests[n_plates : n_plates + n_tables] or (np.zeros((0, found.layout.size + 1)),), prior)
    mounts = []
    first = n_plates + n_tables
    for k in range(len(data.mount_names)):
        mine = [rests[first + i] for i, f in enumerate(data.mount_frames) if f.mount == k]
        mounts.append(global_factor(mine, np.zeros((0, found.layout.size + 1))))
    plates = list(rests[:n_plates])
    targets_px: dict[int, float] = {}
    stripes_px: dict[int, float] = {}
    if n_plates >= 4:
        for k in range(n_plates):
            others = solve_factor(global_factor([*plates[:k], *plates[k + 1 :], *mounts], tables))
            target, stripe = _plate_without(found, k, others)
            targets_px[k] = target
            if stripe is not None:
                stripes_px[k] = stripe
    mounts_mm = []
    for k in range(len(mounts)):
        others_known = n_tables > 0 or len(mounts) > 1
        value = float("nan")
        if others_known:
            step = solve_factor(global_factor([*plates, *mounts[:k], *mounts[k + 1 :]], tables))
            value = _mount_without(setting, found, k, mounts[k], step)
        mounts_mm.append(value)
    return HeldOut(targets_px, stripes_px, tuple(mounts_mm))


def _globals(found: Iterated, k: int) -> Float[np.ndarray, "n p"]:
    """Derivatives of all residuals of a frame by the global parameters."""
    return _all_columns(found.frames[k], found.triangles[k].motions, found.layout)


def _all_columns(frame: FrameResiduals, motions: dict[str, np.ndarray], layout: Layout) -> Float[np.ndarray, "n p"]:
    rows = frame.rows
    out = np.zeros((len(rows.residuals), layout.size))
    for name, columns in rows.common.items():
        if name in layout:
            out[:, layout.of(name)] += columns
    for name, motion in motions.items():
        if name in layout:
            out[:, layout.of(name)] += rows.local[:, :6] @ motion
    return out


def _plate_without(found: Iterated, k: int, step: Float[np.ndarray, " p"]) -> tuple[float, float | None]:
    """RMS over the target points (length of the residual) and over the stripe, the pose fitted to the target points only."""
    frame = found.frames[k]
    rows = frame.rows
    assert rows.place is not None
    n = 2 * len(rows.place)
    # what the plate is off its points was found with the stripe, and may hide how far the stripe is off
    errors_of_points = np.where(np.arange(len(frame.raw)) < n, frame.cleaned - frame.raw, 0.0)
    shifted = frame.raw + errors_of_points + _globals(found, k) @ step
    kept = frame.weight > KEPT
    points = kept & (np.arange(len(shifted)) < n)
    if np.count_nonzero(points) <= 6:
        return float("nan"), None
    pose = -np.linalg.lstsq(rows.local[points, :6], shifted[points], rcond=None)[0]
    left = shifted + rows.local[:, :6] @ pose
    target = float(np.sqrt(2.0 * np.mean(left[points] ** 2)))
    stripe_points = kept & (np.arange(len(shifted)) >= n)
    if not stripe_points.any():
        return target, None
    return target, float(np.sqrt(np.mean(left[stripe_points] ** 2)))


def _mount_without(
    setting: Setting, found: Iterated, k: int, own: Float[np.ndarray, "c c"], step: Float[np.ndarray, " p"]
) -> float:
    """RMS of the distances, mm, with the mount's pose fitted to its points and all else from the other frames."""
    layout = found.layout
    place = layout.of(f"mount:{k}")
    step = step.copy()
    step[place] = 0.0
    rhs = own[:, -1] + own[:, :-1] @ step
    step[place] = -np.linalg.lstsq(own[:, place], rhs, rcond=None)[0]
    first = len(setting.data.plates) + len(setting.data.tables)
    squares, n = 0.0, 0
    for i, frame in enumerate(setting.data.mount_frames):
        residuals = found.frames[first + i]
        if frame.mount != k or residuals.mount is None or not len(residuals.raw):
            continue
        left = residuals.raw + _globals(found, first + i) @ step
        kept = residuals.weight > KEPT
        squares += float(np.sum((left * residuals.rows.mm_per_px)[kept] ** 2))
        n += int(np.count_nonzero(kept))
    return float(np.sqrt(squares / n)) if n else float("nan")
