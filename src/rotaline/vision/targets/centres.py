"""Sub-pixel centres by point symmetry.

The image of a checkerboard corner and the image of a dot both look the same after half a turn about their centre: straight
edges stay straight in perspective, and a circle becomes an ellipse. Blur, gamma and clipping do not change that. So the
centre is where the image agrees best with its own half-turned copy; no model of the edge or of the blur is needed, and
nothing is lost: the estimate uses every grey value in the window with its full weight.

With P(d) the image at the offset d from the present centre, S = (P(d) + P(-d)) / 2 and A = (P(d) - P(-d)) / 2, a centre that is
wrong by e shows itself as ``A = -grad S . e``. Uneven light adds ``h . d`` and ``(g . d) (S - mean S)``. The six unknowns e, h, g
are found by weighted linear least squares, the centre moves by e, and again.

The window is laid into the image with a bent map (second order), so that perspective and lens distortion, which make the image
of a dot's centre differ from the centre of the dot's image, are undone before the comparison: a dot comes out at the image
of its centre.

The image is looked up with a cubic B-spline as smoothing kernel (sigma 0.58 px): interpolation without it would pull centres
towards the pixel grid.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.vision.targets.centre_kernels import normal_equations, read_windows

_ROUNDING = 1e-6  # windows are often just as large as allowed: rounding must not decide how they are sampled


@dataclass(frozen=True, eq=False)
class Centres:
    """Refined centres.

    Attributes
    ----------
    uv : (n, 2)   px; NaN where the window left the image or the search did not converge
    asymmetry : (n,)   RMS of what symmetry and uneven light do not explain, relative to the contrast
    contrast : (n,)   standard deviation of the symmetric part, grey values; its sign is that of the agreement with the template
    agreement : (n,)   correlation with the template, -1 to 1: bright towards u + v (corner) or a bright disc (dot)
    filled : (n,)   dots: area of the disc in units of the window (its half sides are 1); NaN for corners
    """

    uv: Float[np.ndarray, "n 2"]
    asymmetry: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    agreement: Float[np.ndarray, " n"]
    filled: Float[np.ndarray, " n"]


def refine_centres(
    image: np.ndarray,
    uv: Float[np.ndarray, "n 2"],
    half_sides: Float[np.ndarray, "n 2 2"],
    bend: Float[np.ndarray, "n 2 2 2"] | None,
    kind: Literal["corner", "dot"],
    dot_radius: float = 0.6,
    edge_reach_px: float = 4.5,
    max_steps: int = 10,
) -> Centres:
    """Refine the centres of corners or dots by point symmetry.

    Parameters
    ----------
    image : (h, w)   grey values, any depth
    uv : (n, 2)   px, good to about a third of the blur or of the window
    half_sides : (n, 2, 2)   the window: ``half_sides[i, :, 0]`` and ``[i, :, 1]`` run from its centre to the middle of its sides, px,
        along the edges of the corner, or conjugate half diameters of the dot's ellipse
    bend : (n, 2, 2, 2) or None   second derivatives of the map from window to image, px; None for an affine map
    kind : "corner" or "dot"
    dot_radius : float   radius of the dot in units of the window
    edge_reach_px : float   corners: only what lies this near to the edges through the corner is looked at
    max_steps : int   steps of the search; a centre that still moves after them is given up

    Returns
    -------
    Centres
    """
    n = len(uv)
    if n == 0:
        none = np.zeros(0)
        return Centres(np.zeros((0, 2)), none, none, none, none)
    height, width = image.shape
    lengths = np.linalg.norm(half_sides, axis=1)
    steps = int(np.clip(np.ceil(np.percentile(lengths.max(axis=1), 90) / 0.9 - _ROUNDING), 4, 24))
    axis = np.arange(-steps, steps + 1) / steps
    alpha, beta = np.meshgrid(axis, axis)
    if kind == "corner":  # only what lies near the edges can tell where they are
        near_edge = np.minimum(np.abs(alpha), np.abs(beta)) <= edge_reach_px / float(np.median(lengths)) + _ROUNDING
        window = (1 - alpha**2) * (1 - beta**2) * near_edge
        template = np.sign(alpha * beta)
    else:
        radius = np.hypot(alpha, beta)
        window = np.clip((1.0 - radius) / (1.0 - dot_radius) * 2.0, 0.0, 1.0)
        template = np.where(radius < dot_radius, 1.0, -1.0)
    grid = _Window.lay(alpha, beta, window, template)
    half_sides = np.ascontiguousarray(half_sides, dtype=float)
    bend = np.zeros((n, 2, 2, 2)) if bend is None else np.ascontiguousarray(bend, dtype=float)
    image = np.ascontiguousarray(image, dtype=np.float32)
    allowed = lengths.min(axis=1) * 0.5  # a centre that moves farther is given up

    centre = uv.astype(float).copy()
    alive = _inside(centre, half_sides, width, height)
    active = alive.copy()
    asymmetry, contrast, agreement, filled = (np.full(n, np.nan) for _ in range(4))
    for _ in range(max_steps):
        index = np.flatnonzero(active)
        if not len(index):
            break
        patch = np.empty((len(index), len(grid.offsets)))
        read_windows(image, centre[index], half_sides[index], bend[index], grid.offsets, patch)
        solved = _solve(patch, grid)
        shift = np.einsum("nab,nb->na", half_sides[index], solved.shift)
        centre[index] += shift
        contrast[index], asymmetry[index] = solved.contrast, solved.asymmetry
        agreement[index] = solved.agreement
        if kind == "dot":
            filled[index] = _filled_area(solved.symmetric, grid, dot_radius)
        moved = np.linalg.norm(shift, axis=1)
        lost = ~(np.linalg.norm(centre[index] - uv[index], axis=1) <= allowed[index])
        lost |= ~_inside(centre[index], half_sides[index], width, height)
        alive[index[lost]] = False
        active[index] = ~lost & (moved > 0.002)
    alive &= ~active
    centre[~alive] = np.nan
    return Centres(centre, asymmetry, contrast, agreement, filled)


def _inside(
    centre: Float[np.ndarray, "n 2"], half_sides: Float[np.ndarray, "n 2 2"], width: int, height: int
) -> Bool[np.ndarray, " n"]:
    """Whether the window lies in the image."""
    reach = np.abs(half_sides).sum(axis=2)
    low, high = centre - reach, centre + reach
    return np.asarray(np.all(low >= 0, axis=1) & (high[:, 0] <= width - 1) & (high[:, 1] <= height - 1))


@dataclass(frozen=True, eq=False)
class _Window:
    """Where a window is sampled: all points that are needed (p), and those that count (q).

    Points come in the order of a grid that is symmetric about 0, so that the reversed order holds the opposite points.
    """

    offsets: Float[np.ndarray, "p 2"]
    counting: Int[np.ndarray, " q"]
    next_alpha: Int[np.ndarray, "2 q"]
    next_beta: Int[np.ndarray, "2 q"]
    step: float
    weight: Float[np.ndarray, " q"]
    template: Float[np.ndarray, " q"]

    @staticmethod
    def lay(
        alpha: Float[np.ndarray, "s s"],
        beta: Float[np.ndarray, "s s"],
        window: Float[np.ndarray, "s s"],
        template: Float[np.ndarray, "s s"],
    ) -> "_Window":
        """Take the points where ``window`` is positive, and their neighbours."""
        counts = window > 0
        counts[0] = counts[-1] = False
        counts[:, 0] = counts[:, -1] = False
        needed = counts.copy()
        for axis in (0, 1):
            needed |= np.roll(counts, 1, axis) | np.roll(counts, -1, axis)
        number = np.cumsum(needed.ravel()).reshape(needed.shape) - 1
        i, j = np.nonzero(counts)
        weight = window[counts] / window[counts].sum()
        return _Window(
            np.stack([alpha[needed], beta[needed]], axis=1),
            number[i, j],
            np.stack([number[i, j - 1], number[i, j + 1]]),
            np.stack([number[i - 1, j], number[i + 1, j]]),
            float(alpha[0, 1] - alpha[0, 0]),
            weight,
            template[counts],
        )


@dataclass(frozen=True, eq=False)
class _Solved:
    """One step of the search: shift in units of the window, symmetric part at the counting points; see :class:`Centres`."""

    shift: Float[np.ndarray, "n 2"]
    symmetric: Float[np.ndarray, "n q"]
    contrast: Float[np.ndarray, " n"]
    asymmetry: Float[np.ndarray, " n"]
    agreement: Float[np.ndarray, " n"]


def _solve(patch: Float[np.ndarray, "n p"], window: _Window) -> _Solved:
    """Least squares for the shift and the uneven light (see the module's text)."""
    n, w = len(patch), window.weight
    expected = window.template - window.template @ w
    symmetric, normal, right, figures = np.empty((n, len(w))), np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 3))
    normal_equations(
        patch,
        window.offsets,
        window.counting,
        window.next_alpha,
        window.next_beta,
        window.step,
        w,
        expected,
        symmetric,
        normal,
        right,
        figures,
    )
    contrast, square, product = figures.T
    solution = np.linalg.solve(normal + 1e-9 * np.eye(6), right[..., None])[..., 0]
    rest = np.maximum(square - np.sum(solution * right, axis=1), 0.0)
    agreement = product / (contrast * np.sqrt(expected**2 @ w) + 1e-12)
    return _Solved(solution[:, :2], symmetric, contrast, np.sqrt(rest), agreement)


def _filled_area(symmetric: Float[np.ndarray, "n q"], window: _Window, dot_radius: float) -> Float[np.ndarray, " n"]:
    """Area of the disc, as the sum of its coverage between the level of its core and that of its surroundings."""
    radius = np.linalg.norm(window.offsets[window.counting], axis=1)
    core = np.median(symmetric[:, radius < 0.5 * dot_radius], axis=1)
    around = np.median(symmetric[:, radius > dot_radius + 0.7 * (1 - dot_radius)], axis=1)
    with np.errstate(all="ignore"):
        covered = (symmetric - around[:, None]).sum(axis=1) / (core - around)
    return np.asarray(np.where(np.isfinite(covered), covered, 0.0) * window.step**2)
