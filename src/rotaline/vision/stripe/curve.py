"""The stripe as a curve: points at equal distance along it, and their directions."""

import numpy as np
from jaxtyping import Float


def resample_polyline(uv: Float[np.ndarray, "n 2"], spacing_px: float) -> Float[np.ndarray, "m 2"]:
    """Points at equal arc length along a polyline, from its first point on."""
    step = np.hypot(*np.diff(uv, axis=0).T)
    length = np.concatenate([[0.0], np.cumsum(step)])
    keep = np.concatenate([[True], step > 1e-9])
    at = np.arange(0.0, length[-1] + 1e-6, spacing_px)
    return np.column_stack([np.interp(at, length[keep], uv[keep, k]) for k in (0, 1)])


def local_lines(
    uv: Float[np.ndarray, "n 2"], half_window: int, one_sided: bool = True
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Smoothed position and unit tangent at every point of an ordered chain.

    A line is fitted to the points of a window that is centred on the point, of one that ends at it and of one that begins
    at it; the one-sided windows win where the centred one does not fit (at a corner or at a break), so that the direction
    does not bend around a corner. At the ends of the chain the windows are cut.

    Parameters
    ----------
    uv : (n, 2)   centres in order, about equally spaced, px
    half_window : int   points on either side
    one_sided : bool   False to use the centred window alone

    Returns
    -------
    smooth, tangent : (n, 2) each
    """
    n = len(uv)
    i = np.arange(n)
    windows = [(np.maximum(i - half_window, 0), np.minimum(i + half_window, n - 1))]
    # at the ends the centred window keeps its length where it can
    windows[0] = (
        np.minimum(windows[0][0], max(n - 1 - half_window, 0)),
        np.maximum(windows[0][1], min(half_window, n - 1)),
    )
    if one_sided and n > half_window:
        windows.append((np.maximum(i - half_window, 0), np.maximum(i, min(half_window, n - 1))))
        windows.append((np.minimum(i, max(n - 1 - half_window, 0)), np.minimum(i + half_window, n - 1)))
    t = i.astype(float)
    origin = uv.mean(axis=0)
    x = uv - origin
    terms = np.column_stack([np.ones(n), t, t * t, x, x * t[:, None], (x * x).sum(axis=1)])
    total = np.vstack([np.zeros(terms.shape[1]), np.cumsum(terms, axis=0)])
    best = np.full(n, np.inf)
    smooth, tangent = uv.copy(), np.zeros_like(uv)
    for rank, (low, high) in enumerate(windows):
        s = total[high + 1] - total[low]
        count, mean_t = s[:, 0], s[:, 1] / s[:, 0]
        var_t = np.maximum(s[:, 2] - count * mean_t**2, 1e-12)
        mean = s[:, 3:5] / count[:, None]
        slope = (s[:, 5:7] - mean_t[:, None] * s[:, 3:5]) / var_t[:, None]
        rest = s[:, 7] - count * (mean**2).sum(axis=1) - var_t * (slope**2).sum(axis=1)
        misfit = np.maximum(rest, 0.0) / np.maximum(count - 2, 1) + 1e-4
        misfit = misfit * (1.0 if rank == 0 else 4.0)  # one-sided only where clearly better
        better = misfit < best
        best[better] = misfit[better]
        smooth[better] = (origin + mean + slope * (t - mean_t)[:, None])[better]
        tangent[better] = slope[better]
    norm = np.hypot(tangent[:, 0], tangent[:, 1])
    tangent = np.where(norm[:, None] > 1e-9, tangent / np.maximum(norm, 1e-9)[:, None], [1.0, 0.0])
    return smooth, tangent
