"""What lies under the stripe: the grey values of the surface itself, estimated from both sides of each profile."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
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
    """Background of n profiles: a line, or a level with a blurred step.

    Attributes
    ----------
    level : (n,)   grey value at the profile's origin, without the step
    slope : (n,)   grey values a px
    step, place_px, blur_px : (n,)   height of a step, its distance from the profile's origin, its standard deviation
    slope_variance : (n,)   variance of the slope, for a pixel variance of 1
    u_edge_px : (n,)   uncertainty of the centre from an edge under the stripe; 0 where there is none
    """

    level: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, " n"]
    step: Float[np.ndarray, " n"]
    place_px: Float[np.ndarray, " n"]
    blur_px: Float[np.ndarray, " n"]
    slope_variance: Float[np.ndarray, " n"]
    u_edge_px: Float[np.ndarray, " n"]

    def at(self, offset_px: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Grey values at distances from the profiles' origins along their normals."""
        value = self.level[:, None] + self.slope[:, None] * offset_px
        k = np.flatnonzero(self.step)
        if len(k):
            value[k] += self.step[k, None] * ndtr((offset_px[k] - self.place_px[k, None]) / self.blur_px[k, None])
        return np.asarray(value)


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
    none = np.zeros(len(x))
    level = mean_p - slope * (mean_x + shift_px)
    return Background(level, slope, none, none, none + 1.0, np.where(both, 1.0 / s_xx, 0.0), none)


@dataclass(frozen=True, eq=False)
class Steps:
    """Blurred steps under some of n profiles, and the centres that a fit of stripe and step together finds.

    Attributes
    ----------
    taken : (n,)   the step stands in for the line
    level, step, place_px, blur_px, u_edge_px : (m,)   as in :class:`Background`, of the profiles where it is taken
    shift_px : (m,)   centres, of the same
    """

    taken: Bool[np.ndarray, " n"]
    level: Float[np.ndarray, " m"]
    step: Float[np.ndarray, " m"]
    place_px: Float[np.ndarray, " m"]
    blur_px: Float[np.ndarray, " m"]
    u_edge_px: Float[np.ndarray, " m"]
    shift_px: Float[np.ndarray, " m"]

    def at(self, offset_px: Float[np.ndarray, " k"], which: Int[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Grey values at distances from the origins of the profiles ``which``, counted among those where the step is taken."""
        edge = ndtr((offset_px - self.place_px[which]) / self.blur_px[which])
        return np.asarray(self.level[which] + self.step[which] * edge)


def step_background(
    profiles: Profiles,
    chains: Chains,
    shift_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    line: Background,
    noise: Float[np.ndarray, " n"],
) -> tuple[Background, Float[np.ndarray, " n"]]:
    """Replace the line by a blurred step where the two sides differ and :func:`fit_steps` finds one.

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
    own = Chains(chains.uv[index], chains.chain[index])
    here = np.zeros(len(x), dtype=bool)
    here[index] = True
    steps = fit_steps(profiles.select(here), own, shift_px[index], width_px[index], noise[index])
    taken = index[steps.taken]
    ground = {name: getattr(line, name).copy() for name in ("level", "slope", "step", "place_px", "blur_px")}
    ground["level"][taken], ground["slope"][taken], ground["step"][taken] = steps.level, 0.0, steps.step
    ground["place_px"][taken], ground["blur_px"][taken] = steps.place_px, steps.blur_px
    shift, u_edge = shift_px.copy(), line.u_edge_px.copy()
    shift[taken], u_edge[taken] = steps.shift_px, steps.u_edge_px
    slope_variance = np.where(ground["step"] != 0.0, 0.0, line.slope_variance)
    return Background(**ground, slope_variance=slope_variance, u_edge_px=u_edge), shift


def fit_steps(
    profiles: Profiles,
    chains: Chains,
    shift_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    noise: Float[np.ndarray, " n"],
) -> Steps:
    """A blurred step under each profile, where it explains the profiles better than a line does.

    A profile is fitted, linearly, by the stripe and its derivatives, a level and a step, for a grid of places and blurs of
    the step. Neighbouring profiles choose the place and the blur together; the step is taken if it beats the line by more than
    noise could.
    """
    x, w, p = profiles.offset_px - shift_px[:, None], width_px[:, None], profiles.value
    use = np.where(profiles.valid & ~profiles.clipped, 1.0, 0.0)
    g = np.exp(-0.5 * (x / w) ** 2)
    stripe = [g, g * x / w, g * (x / w) ** 2, np.ones_like(x)]
    rest_line, _ = _linear_fit([*stripe, x], p, use)
    grid = [(e, b) for b in _BLURS_PX for e in _EDGES]
    coarse = slice(None, None, _EVERY)
    few = Chains(chains.uv[coarse], chains.chain[coarse])
    rest = np.empty((len(grid), len(few)))
    for k, (e, b) in enumerate(grid):
        columns = [column[coarse] for column in stripe]
        edge = ndtr((x[coarse] - e * w[coarse]) / b)
        rest[k] = few.window_mean(_linear_fit([*columns, edge], p[coarse], use[coarse])[0], _POOL // _EVERY)
    choice = np.repeat(np.argmin(rest, axis=0), _EVERY)[: len(x)]
    place, blur = np.array(grid)[choice].T
    edge = ndtr((x - place[:, None] * w) / blur[:, None])
    best, c = _linear_fit([*stripe, edge], p, use)
    gain = chains.window_mean(rest_line - best, _POOL)
    won = (gain > 9.0 * np.maximum(noise, 0.3) ** 2) & (c[:, 0] > 1e-9)
    place, blur, w, c, x0 = place[won], blur[won], width_px[won], c[won], shift_px[won]
    return Steps(
        taken=won,
        level=c[:, 3],
        step=c[:, 4],
        place_px=place * w + x0,
        blur_px=blur,
        u_edge_px=_SHAPE * w * np.abs(c[:, 4]) / c[:, 0],
        shift_px=x0 + np.clip(c[:, 1] / c[:, 0] * w, -w, w),
    )


def _mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Mean over the mask, row by row; NaN where it is empty."""
    count = mask.sum(axis=1)
    return np.where(count > 0, (values * mask).sum(axis=1) / np.maximum(count, 1), np.nan)


def _linear_fit(columns: list[np.ndarray], p: np.ndarray, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of squared residuals and coefficients of a linear fit of every row."""
    design = np.stack(columns, axis=2) * use[:, :, None]
    normal = design.transpose(0, 2, 1) @ design
    weight = np.trace(normal, axis1=1, axis2=2)[:, None, None]  # 0 where no pixel can be used
    normal += (1e-9 * weight + 1e-12) * np.eye(len(columns))
    target = p * use
    c = np.linalg.solve(normal, (design.transpose(0, 2, 1) @ target[:, :, None]))
    rest = target - (design @ c)[:, :, 0]
    return (rest**2).sum(axis=1), c[:, :, 0]
