"""By how much a stripe has moved between two images of the same thing.

Each point of the first stripe is compared with the place where the normal at it meets the second stripe: that of the point next to it, continued
along its own direction. So a stripe that is compared with itself has not moved, whatever its shape; and what is along the stripe, where it tells nothing,
plays no part.

The shift is the mean over the points that have a counterpart. Its uncertainty comes from their scatter about that mean; neighbours err alike (noise that
profiles share, speckle), so that n points count as ``n / length`` by the autocorrelation of the differences.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from rotaline.geometry.correlation import correlation_length
from rotaline.vision.stripe.model import StripePoints

REACH_PX = 20.0
"""A stripe that has moved further is not found again."""
_ALONG_PX = 1.0
"""A counterpart is no further along the stripe."""
_LEAST_COSINE = 0.9
_OUTLIER = 5.0
_LEAST_POINTS = 20
_ROUNDS = 2


@dataclass(frozen=True)
class StripeShift:
    """How a second stripe differs from a first one; NaN where too few points of the first have a counterpart.

    Attributes
    ----------
    shift_px : mean along the normals, which are turned to the right in the image (downwards where the stripe is level)
    u_px : its standard uncertainty
    scatter_px : standard deviation of the shift of a single point
    n_points : points that were compared
    share : of the points of the first stripe that were compared
    brightness, u_brightness : height of the second stripe over that of the first (geometric mean, saturated points left out), and its
        standard uncertainty; without the per cent by which a measured height depends on where the stripe lies between pixels
    width : median of the width of the second stripe over that of the first
    """

    shift_px: float
    u_px: float
    scatter_px: float
    n_points: int
    share: float
    brightness: float
    u_brightness: float
    width: float


def stripe_shift(first: StripePoints, second: StripePoints) -> StripeShift:
    """By how much ``second`` lies beside ``first``."""
    nan = float("nan")
    if len(first) == 0 or len(second) == 0:
        return StripeShift(nan, nan, nan, 0, 0.0, nan, nan, nan)
    normal = _to_one_side(first.normal)
    tree = cKDTree(second.uv)
    rough = 0.0
    for _ in range(_ROUNDS):
        shift, partner, matched = _against(first.uv, normal, second, tree, rough)
        if np.count_nonzero(matched) < _LEAST_POINTS:
            break
        rough = float(np.median(shift[matched]))
    n_matched = int(np.count_nonzero(matched))
    if n_matched < _LEAST_POINTS:
        return StripeShift(nan, nan, nan, n_matched, n_matched / len(first), nan, nan, nan)
    spread = 1.4826 * float(np.median(np.abs(shift[matched] - rough)))
    kept = matched & (np.abs(shift - rough) <= _OUTLIER * spread)
    n = int(np.count_nonzero(kept))
    mean, u = _mean(shift, first, kept)
    light = np.log(second.intensity[partner] / first.intensity)
    change, u_change = _mean(light, first, kept & ~first.saturated & ~second.saturated[partner])
    return StripeShift(
        shift_px=mean,
        u_px=u,
        scatter_px=float(np.std(shift[kept], ddof=1)),
        n_points=n,
        share=n / len(first),
        brightness=float(np.exp(change)),
        u_brightness=float(np.exp(change)) * u_change,
        width=float(np.median(second.width_px[partner[kept]] / first.width_px[kept])),
    )


def _against(
    uv: Float[np.ndarray, "n 2"], normal: Float[np.ndarray, "n 2"], second: StripePoints, tree: cKDTree, rough: float
) -> tuple[Float[np.ndarray, " n"], np.ndarray, Bool[np.ndarray, " n"]]:
    """How far along each normal the second stripe is met, the point that told it, and whether there is one."""
    _, partner = tree.query(uv + rough * normal)
    way, other = second.uv[partner] - uv, second.normal[partner]
    cosine = np.sum(normal * other, axis=1)
    steep = np.abs(cosine) >= _LEAST_COSINE
    shift = np.sum(way * other, axis=1) / np.where(steep, cosine, 1.0)
    along = np.abs(way[:, 1] * normal[:, 0] - way[:, 0] * normal[:, 1])
    return shift, partner, steep & (along <= _ALONG_PX) & (np.abs(shift) <= REACH_PX)


def _to_one_side(normal: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The normals, all turned to the side of their common direction."""
    common = np.linalg.eigh(normal.T @ normal)[1][:, 1]
    common = common * np.sign(common[np.argmax(np.abs(common))])
    return np.where((normal @ common < 0)[:, None], -normal, normal)


def _mean(values: Float[np.ndarray, " n"], stripe: StripePoints, kept: Bool[np.ndarray, " n"]) -> tuple[float, float]:
    """Mean of the values at the points that are kept, and its standard uncertainty; NaN for fewer than two."""
    n = int(np.count_nonzero(kept))
    if n < 2:
        return float("nan"), float("nan")
    mean = float(np.mean(values[kept]))
    length = correlation_length(np.where(kept, values - mean, 0.0), stripe.segment, kept)
    return mean, float(np.std(values[kept], ddof=1) * np.sqrt(length / n))
