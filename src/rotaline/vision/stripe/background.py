"""What lies under the stripe: the grey values of the surface itself, estimated from both sides of each profile."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.profiles import Profiles

SIDE = 3.0  # the sides begin this many widths from the centre
_BLURS_PX = (0.5, 1.0, 2.0)
_EDGES = np.linspace(-3.6, 3.6, 19)  # widths
_POOL, _EVERY = 60, 2  # points
_SHAPE = 0.06  # part of a width, times step over stripe height: what is left open by the unknown shape of an edge


@dataclass(frozen=True, eq=False)
class Background:
    """Background of n profiles.

    Attributes
    ----------
    value : (n, m)   under every sample
    slope_variance : (n,)   variance of its slope at the centre, for a pixel variance of 1
    u_edge_px : (n,)   uncertainty of the centre from an edge under the stripe; 0 where there is none
    """

    value: Float[np.ndarray, "n m"]
    slope_variance: Float[np.ndarray, " n"]
    u_edge_px: Float[np.ndarray, " n"]


def side_background(
    profiles: Profiles, shift_px: Float[np.ndarray, " n"], width_px: Float[np.ndarray, " n"]
) -> Background:
    """A line through the samples beyond :data:`SIDE` widths on both sides; a level where one side is not seen."""
    x = profiles.offset_px - shift_px[:, None]
    p = profiles.value
    o = (profiles.valid & ~profiles.clipped & (np.abs(x) > SIDE * width_px[:, None])).astype(float)
    both = ((o * (x < 0)).sum(axis=1) >= 2) & ((o * (x > 0)).sum(axis=1) >= 2)
    count = np.maximum(o.sum(axis=1), 1.0)
    mean_x, mean_p = (o * x).sum(axis=1) / count, (o * p).sum(axis=1) / count
    dx = (x - mean_x[:, None]) * o
    s_xx = np.maximum((dx * dx).sum(axis=1), 1e-9)
    slope = np.where(both, (dx * p).sum(axis=1) / s_xx, 0.0)
    value = mean_p[:, None] + slope[:, None] * (x - mean_x[:, None])
    return Background(value, np.where(both, 1.0 / s_xx, 0.0), np.zeros(len(x)))


def step_background(
    profiles: Profiles,
    chains: Chains,
    shift_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    line: Background,
    noise: Float[np.ndarray, " n"],
) -> tuple[Background, Float[np.ndarray, " n"]]:
    """Replace the line by a blurred step where the two sides differ and the step explains the profiles better.

    A profile is fitted, linearly, by the stripe and its derivatives, a level and a step, for a grid of places and blurs of
    the step. Neighbouring profiles choose the place and the blur together; the step stays if it beats the line by more than
    noise could.

    Returns
    -------
    background : Background
    shift_px : (n,)   the centres, moved by what the fit found where the step was taken
    """
    x = profiles.offset_px - shift_px[:, None]
    sides = profiles.valid & (np.abs(x) > SIDE * width_px[:, None])
    left, right = (_mean(profiles.value, sides & (x < 0)), _mean(profiles.value, sides & (x > 0)))
    differ = np.abs(left - right) > 4.0 * np.maximum(noise, 0.3)
    index = np.flatnonzero(chains.window_mean(differ.astype(float), 8) > 0.5)
    if len(index) == 0:
        return line, shift_px
    x, w, p = x[index], width_px[index, None], profiles.value[index]
    use = np.where(profiles.valid[index] & ~profiles.clipped[index], 1.0, 0.0)
    g = np.exp(-0.5 * (x / w) ** 2)
    stripe = [g, g * x / w, g * (x / w) ** 2, np.ones_like(x)]
    own = Chains(chains.uv[index], chains.chain[index])
    rest_line, _ = _linear_fit([*stripe, x], p, use)
    grid = [(e, b) for b in _BLURS_PX for e in _EDGES]
    coarse = slice(None, None, _EVERY)
    few = Chains(own.uv[coarse], own.chain[coarse])
    rest = np.empty((len(grid), len(few)))
    for k, (e, b) in enumerate(grid):
        columns = [column[coarse] for column in stripe]
        edge = ndtr((x[coarse] - e * w[coarse]) / b)
        rest[k] = few.window_mean(_linear_fit([*columns, edge], p[coarse], use[coarse])[0], _POOL // _EVERY)
    choice = np.repeat(np.argmin(rest, axis=0), _EVERY)[: len(index)]
    place, blur = np.array(grid)[choice].T
    edge = ndtr((x - place[:, None] * w) / blur[:, None])
    best, c = _linear_fit([*stripe, edge], p, use)
    gain = own.window_mean(rest_line - best, _POOL)
    won = (gain > 9.0 * np.maximum(noise[index], 0.3) ** 2) & (c[:, 0] > 0)
    u_edge, value, shift = line.u_edge_px.copy(), line.value.copy(), shift_px.copy()
    value[index[won]] = (c[:, 3, None] + c[:, 4, None] * edge)[won]
    move = c[:, 1] / np.maximum(c[:, 0], 1e-9) * w[:, 0]
    shift[index[won]] += np.clip(move, -w[:, 0], w[:, 0])[won]
    u_edge[index[won]] = (_SHAPE * w[:, 0] * np.abs(c[:, 4]) / np.maximum(c[:, 0], 1e-9))[won]
    return Background(value, np.where(u_edge > 0, 0.0, line.slope_variance), u_edge), shift


def _mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Mean over the mask, row by row; NaN where it is empty."""
    count = mask.sum(axis=1)
    return np.where(count > 0, (values * mask).sum(axis=1) / np.maximum(count, 1), np.nan)


def _linear_fit(columns: list[np.ndarray], p: np.ndarray, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of squared residuals and coefficients of a linear fit of every row."""
    design = np.stack(columns, axis=2) * use[:, :, None]
    normal = design.transpose(0, 2, 1) @ design
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(len(columns))
    target = p * use
    c = np.linalg.solve(normal, (design.transpose(0, 2, 1) @ target[:, :, None]))
    rest = target - (design @ c)[:, :, 0]
    return (rest**2).sum(axis=1), c[:, :, 0]
