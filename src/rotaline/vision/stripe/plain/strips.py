"""The pixels of an image in strips along the normals of points."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from rotaline.vision.stripe.profiles import Profiles

_STRIP_PX = 1.0  # along the stripe; there the weight of a pixel has fallen to 0
_TIE = 1e-6  # px; so that rounding errors do not decide which pixels are taken


def pixel_strips(
    image: Float32[np.ndarray, "h w"],
    clipped: Bool[np.ndarray, "h w"] | None,
    uv: Float[np.ndarray, "n 2"],
    normal: Float[np.ndarray, "n 2"],
    half_length_px: Float[np.ndarray, " n"],
) -> Profiles:
    """The pixels within a pixel of the normals of the points, to ``half_length_px`` on both sides.

    Their weight falls off along the stripe from 1 to 0 in a straight line. So points at a spacing of one pixel share every
    pixel of the stripe between them, the two nearest to it in parts that make up 1.
    """
    n = len(uv)
    reach = int(np.ceil(half_length_px.max(initial=1.0)))
    m = 3 * (2 * reach + 1)
    offset, value, weight = (np.zeros((n, m)) for _ in range(3))
    valid, hit = (np.zeros((n, m), dtype=bool) for _ in range(2))
    across = np.abs(normal[:, 0]) >= np.abs(normal[:, 1])
    steps = np.arange(-reach, reach + 1)
    for group, axis in ((across, 0), (~across, 1)):
        if not group.any():
            continue
        at, along = uv[group, axis, None], uv[group, 1 - axis, None]
        n_at, n_along = normal[group, axis, None], normal[group, 1 - axis, None]
        line = np.floor(at + (0.5 - _TIE)) + steps
        nearest = np.rint(along + (line - at) * (n_along / n_at))
        # the three pixels of a line (row or column) that can lie within the strip
        x = np.repeat(line - at, 3, axis=1)
        y = (nearest[:, :, None] + np.array([-1.0, 0.0, 1.0])).reshape(len(at), m) - along
        d = x * n_at + y * n_along
        share = 1.0 - np.abs(y * n_at - x * n_along) / _STRIP_PX
        column, row = (x + at, y + along) if axis == 0 else (y + along, x + at)
        inside = (share > _TIE) & (np.abs(d) <= half_length_px[group, None] + _TIE)
        inside &= (column >= 0) & (column <= image.shape[1] - 1) & (row >= 0) & (row <= image.shape[0] - 1)
        column, row = (np.where(inside, np.rint(c), 0.0).astype(np.intp) for c in (column, row))
        index = row * image.shape[1] + column
        offset[group], valid[group] = d, inside
        value[group] = np.where(inside, image.ravel()[index], 0.0)
        weight[group] = np.where(inside, share, 0.0)
        if clipped is not None:
            hit[group] = inside & clipped.ravel()[index]
    return Profiles(offset, value, weight, np.ones((n, m)), valid, hit)
