"""Grey values across the stripe: samples along its normals, or the pixels themselves in strips along its normals.

A profile is sampled where its normal crosses the columns of the image (rows, where the normal is steeper than 45 deg), by
four-pixel interpolation along that column. Samples of one profile therefore share no pixel: their noise is independent, and
its size is known (``gain``). Interpolation is good enough to find a stripe and to see what lies beside it. It cannot follow a
stripe that is thinner than about a pixel: what it makes of it depends on where the pixels lie. So the centre is measured
on the pixels, each with its true distance from the line, which needs no interpolation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

_MOST_SMOOTHING = 0.5  # share of the B-spline at 45 deg
_TIE = 1e-6  # px; so that rounding errors do not decide which samples are taken


@dataclass(frozen=True, eq=False)
class Profiles:
    """Profiles of n points, m samples each, or strips of m pixels each.

    Attributes
    ----------
    offset_px : (n, m)   signed distance from the point along its normal
    value : (n, m)   grey value; 0 where not valid
    weight : (n, m)   1 for samples; for the pixels of a strip the less, the further they lie along the stripe
    gain : (n, m)   variance of the sample for a pixel variance of 1; 1 for pixels
    valid : (n, m)   the sample lies in the image and within the half length, and has a weight
    clipped : (n, m)   a pixel that takes part is at the top of the range
    """

    offset_px: Float[np.ndarray, "n m"]
    value: Float[np.ndarray, "n m"]
    weight: Float[np.ndarray, "n m"]
    gain: Float[np.ndarray, "n m"]
    valid: Bool[np.ndarray, "n m"]
    clipped: Bool[np.ndarray, "n m"]

    def select(self, keep: Bool[np.ndarray, " n"]) -> "Profiles":
        """The profiles for which ``keep`` is true."""
        return Profiles(
            self.offset_px[keep],
            self.value[keep],
            self.weight[keep],
            self.gain[keep],
            self.valid[keep],
            self.clipped[keep],
        )


def sample_profiles(
    image: Float32[np.ndarray, "h w"],
    clipped: Bool[np.ndarray, "h w"] | None,
    uv: Float[np.ndarray, "n 2"],
    normal: Float[np.ndarray, "n 2"],
    half_length_px: Float[np.ndarray, " n"],
) -> Profiles:
    """Sample the image along the normals of the points, to ``half_length_px`` on both sides."""
    n = len(uv)
    reach = int(np.ceil(half_length_px.max(initial=1.0)))
    m = 2 * reach + 1
    offset, value, gain = (np.zeros((n, m)) for _ in range(3))
    valid, hit = (np.zeros((n, m), dtype=bool) for _ in range(2))
    across = np.abs(normal[:, 0]) >= np.abs(normal[:, 1])
    for group, axis in ((across, 0), (~across, 1)):
        if group.any():
            offset[group], value[group], gain[group], valid[group], hit[group] = _sample(
                image, clipped, uv[group], normal[group], half_length_px[group], reach, axis
            )
    return Profiles(offset, value, np.ones((n, m)), gain, valid, hit)


def _sample(
    image: np.ndarray,
    clipped: np.ndarray | None,
    uv: np.ndarray,
    normal: np.ndarray,
    half_length_px: np.ndarray,
    reach: int,
    axis: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Profiles whose normals lie within 45 deg of image axis ``axis`` (0: along a row, 1: along a column)."""
    line = np.floor(uv[:, axis] + (0.5 - _TIE))[:, None] + np.arange(-reach, reach + 1)
    offset = (line - uv[:, axis, None]) / normal[:, axis, None]
    place = uv[:, 1 - axis, None] + offset * normal[:, 1 - axis, None]
    size_line, size_place = image.shape[1 - axis], image.shape[axis]
    valid = (np.abs(offset) <= half_length_px[:, None] + _TIE) & (line >= 0) & (line <= size_line - 1)
    valid &= (place >= 0) & (place <= size_place - 1)
    low = np.floor(place)
    f = place - low
    stride_line, stride_place = (1, image.shape[1]) if axis == 0 else (image.shape[1], 1)
    base = (line.clip(0, size_line - 1) * stride_line).astype(np.intp)
    low = low.astype(np.intp)
    flat = image.ravel()
    value = np.zeros_like(f)
    gain = np.zeros_like(f)
    hit = np.zeros(f.shape, dtype=bool)
    blend = _MOST_SMOOTHING * (2.0 * normal[:, 0] * normal[:, 1])[:, None] ** 2
    for k, weight in zip((-1, 0, 1, 2), _weights(f, blend), strict=True):
        index: Int[np.ndarray, "n m"] = base + (low + k).clip(0, size_place - 1) * stride_place
        value += weight * flat[index]
        gain += weight * weight
        if clipped is not None and k in (0, 1):
            hit |= clipped.ravel()[index] & (weight > 0.05)
    value[~valid] = 0.0
    return offset, value, gain, valid, hit & valid


def _weights(f: np.ndarray, blend: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weights of four pixels at the fraction ``f`` between the second and the third.

    Keys' cubic convolution (a = -1/2), blended with the cubic B-spline. Neither shifts or skews what it samples, whatever
    the fraction; the B-spline averages over more pixels, which makes up for the wider spacing of oblique profiles.
    """
    f2 = f * f
    f3 = f2 * f
    g = 1.0 - f
    keys = (-0.5 * f3 + f2 - 0.5 * f, 1.5 * f3 - 2.5 * f2 + 1.0, -1.5 * f3 + 2.0 * f2 + 0.5 * f, 0.5 * f3 - 0.5 * f2)
    spline = (g**3 / 6.0, (3.0 * f3 - 6.0 * f2 + 4.0) / 6.0, (-3.0 * f3 + 3.0 * f2 + 3.0 * f + 1.0) / 6.0, f3 / 6.0)
    k0, k1, k2, k3 = (a + blend * (b - a) for a, b in zip(keys, spline, strict=True))
    return k0, k1, k2, k3
