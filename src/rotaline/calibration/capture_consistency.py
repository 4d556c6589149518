"""Whether the captures of a session show one and the same camera.

Captures may have been taken with another zoom, focus or sensor mode; a camera fitted to all of them is then wrong for each.
Every capture gets a camera of its own (one linear step from the common fit), and the gain is compared with what a camera
for every single view would gain: model errors, such as a target whose points are off, make both large, and only a change of
the camera makes the first stand out. What is judged is the focal length, which such a change moves and model errors hardly do.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

from rotaline.calibration.reprojection import BundleFit

MIN_VIEWS_OF_CAPTURE = 4
_CHANCE = 1e-6
_CLEAR = 4.0
_MATTERS = 0.01
"""Relative change of the focal length, several times what printed targets with points off by 0.4 % of the pitch pretend."""


@dataclass(frozen=True)
class CaptureConflict:
    """Two captures that need different cameras: their names, and mean focal lengths (px) to a standard uncertainty."""

    names: tuple[str, str]
    focal_lengths_px: tuple[float, float]
    u_difference_px: float


def capture_of(view_name: str) -> str:
    """The folder of a view that is called ``folder/image``."""
    return view_name.rpartition("/")[0]


def find_conflict(fit: BundleFit, captures: Sequence[str]) -> CaptureConflict | None:
    """The two captures whose focal lengths contradict each other most; None if no two clearly do.

    Parameters
    ----------
    fit : BundleFit   of all views, without expectations of what lenses look like; its first two parameters are fx, fy
    captures : the capture of each view of ``fit``; those with fewer than four views are not judged
    """
    counts = Counter(captures)
    names = [name for name, n in counts.items() if n >= MIN_VIEWS_OF_CAPTURE]
    if len(names) < 2:
        return None
    judged = [k for k, name in enumerate(captures) if name in names]
    blocks, gradients = fit.blocks[judged], fit.gradients[judged]
    n_bend = len(fit.bend)
    p = blocks.shape[1] - n_bend
    of_capture = [names.index(captures[k]) for k in judged]
    common, _, _ = _solve_groups(blocks, gradients, [0] * len(judged), n_bend)
    by_capture, step, cov = _solve_groups(blocks, gradients, of_capture, n_bend)
    by_view, _, _ = _solve_groups(blocks, gradients, list(range(len(judged))), n_bend)
    n_between, n_within = p * (len(names) - 1), p * (len(judged) - len(names))
    within = (by_view - by_capture) / n_within
    if not special.fdtrc(n_between, n_within, (by_capture - common) / n_between / max(within, 1e-30)) < _CHANCE:
        return None
    worst: tuple[float, CaptureConflict] | None = None
    for a in range(len(names)):
        for b in range(a):
            contrast = np.zeros(len(step))
            contrast[[a * p, a * p + 1]], contrast[[b * p, b * p + 1]] = 0.5, -0.5
            difference = float(contrast @ step)
            u = float(np.sqrt(within * contrast @ cov @ contrast))
            focal = (fit.camera.fx + fit.camera.fy) / 2
            score = abs(difference) / max(u, 1e-12)
            if score > _CLEAR and abs(difference) > _MATTERS * focal and (worst is None or score > worst[0]):
                lengths = (focal + float(step[b * p : b * p + 2].mean()), focal + float(step[a * p : a * p + 2].mean()))
                worst = (score, CaptureConflict((names[b], names[a]), lengths, u))
    return worst[1] if worst else None


def describe_conflict(conflict: CaptureConflict, left_out: str | None) -> str:
    """What a conflict means and what became of it, in words; ``left_out`` is the capture that was not used, if any."""
    (first, second), (f_first, f_second) = conflict.names, conflict.focal_lengths_px
    mean = (f_first + f_second) / 2
    text = (
        f"The captures {first} and {second} show different cameras: focal length {f_first:.0f} px and {f_second:.0f} px, "
        f"{100 * abs(f_second - f_first) / mean:.1f} % apart, known to {100 * conflict.u_difference_px / mean:.1f} %. Lens, zoom, focus, "
        "sensor mode or resolution changed between them. "
    )
    if left_out is None:
        text += "All views were used, so the camera is a compromise. "
    else:
        text += (
            f"The views of {left_out} were left out, as the stripes were taken with the other camera; board poses from "
            f"{left_out} are off by as much. "
        )
    return text + "Take all captures with one setting of the camera, with the focus fixed."


def _solve_groups(
    blocks: Float[np.ndarray, "v q q"], gradients: Float[np.ndarray, "v q"], group: Sequence[int], n_bend: int
) -> tuple[float, Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Camera parameters for each group of views, one bend for all: gain in the sum of squares, step, inverse of the normal matrix."""
    p = blocks.shape[1] - n_bend
    n_cameras = (max(group) + 1) * p
    normal, right = np.zeros((n_cameras + n_bend, n_cameras + n_bend)), np.zeros(n_cameras + n_bend)
    for block, gradient, g in zip(blocks, gradients, group, strict=True):
        columns = np.r_[g * p : (g + 1) * p, n_cameras : n_cameras + n_bend]
        normal[np.ix_(columns, columns)] += block
        right[columns] += gradient
    scale = np.sqrt(np.diag(normal))
    scale = np.where(scale > 0, scale, 1.0)
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    step = inverse @ right
    return float(right @ step), step, inverse
