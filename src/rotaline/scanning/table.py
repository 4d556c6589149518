"""The height of the table top, from clouds that show it beside the part."""

import numpy as np
from jaxtyping import Float, Int

_BIN_MM = 0.2
_BELOW = 0.01
"""Share of the points that may lie below the table: reflections, the table's rim."""


def find_table_height(points_table: Float[np.ndarray, "n 3"], frame: Int[np.ndarray, " n"]) -> float | None:
    """z of the table top: the lowest level that many frames show.

    The table is flat, perpendicular to the axis and below everything else; its points pile up at one z, at several
    distances from the axis and in most frames.

    Parameters
    ----------
    points_table : (n, 3)   mm, z along the axis, upwards
    frame : (n,)   frame of each point

    Returns
    -------
    z in mm, or None where no such level is seen
    """
    if len(points_table) < 100:
        return None
    z = points_table[:, 2]
    low, high = np.quantile(z, [0.001, 0.999])
    if high - low < _BIN_MM:
        return None
    edges = np.arange(low - 2 * _BIN_MM, high + 2 * _BIN_MM, _BIN_MM)
    counts, _ = np.histogram(z, edges)
    smooth = np.convolve(counts, np.ones(3), mode="same")
    n_frames = len(np.unique(frame))
    radius = np.hypot(points_table[:, 0], points_table[:, 1])
    below = np.cumsum(counts) - counts
    for k in np.flatnonzero((smooth >= 0.5 * smooth.max()) | (smooth >= 0.05 * len(z))):
        level = 0.5 * (edges[k] + edges[k + 1])
        near = np.abs(z - level) < 3 * _BIN_MM
        spread = np.subtract(*np.quantile(radius[near], [0.9, 0.1]))
        seen = len(np.unique(frame[near])) / n_frames
        if seen < 0.5 or spread < 0.1 * np.quantile(radius, 0.9):
            continue
        if below[max(0, k - 3)] > max(20, 0.1 * len(z)):
            return None
        for _ in range(5):
            level = float(np.median(z[np.abs(z - level) < 2 * _BIN_MM]))
        return level
    return None
