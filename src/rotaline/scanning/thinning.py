"""Thinning of a cloud to even density, and local normals.

A rotary line scan is dense along the stripe and sparse across it; thinning by cells makes areas count instead of points.
The cells are made just large enough that neighbourhoods spread in two directions, and farther than the noise, so that local
planes mean something.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial import cKDTree

from rotaline.scanning.thinning_kernels import sum_in_and_around

NEIGHBOURS = 14
FEWEST = 150
"""Points that thinning leaves at least, if there are as many."""

MIN_SPREAD = 0.3
MAX_THICKNESS = 0.1
"""Ratios of the variances of neighbourhoods: middle to largest, smallest to middle."""

GROWTH = (1, 3, 8, 20)
LINE_LIKE = 0.15
"""A neighbourhood whose middle variance is smaller than this part of the largest is a line: it grows by these factors."""

THIN_CELL = 0.2
"""Cells with a smaller part of the mean number of points around them are left out."""

PROBES = 2000
"""Points whose neighbourhoods are looked at to judge a cell size."""

PIECE = 250_000
"""Points that are looked at together: what is worked out on the way does not grow with the cloud."""


@dataclass(frozen=True, eq=False)
class SearchCloud:
    """Evenly thinned points with unit normals (of either sign); ``spacing`` is the cell size, mm.

    ``roughness`` is the typical distance of points from the local plane, mm: noise, and the bend of the surface within a cell.
    ``thickness`` is the usual ratio of the two smaller variances of a neighbourhood: near 0 on a surface, near 0.5 in a fog.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    spacing: float
    roughness: float
    thickness: float

    def select(self, keep: Bool[np.ndarray, " n"]) -> "SearchCloud":
        """The points for which ``keep`` is true."""
        return replace(self, points=self.points[keep], normals=self.normals[keep])


def thin(points: Float[np.ndarray, "n 3"], n_target: int, finest: float = 1 / 400) -> SearchCloud:
    """Keep one point a cell, with cells as small as even neighbourhoods and ``n_target`` allow; add local normals.

    Points whose neighbours are unusually far away (strays) are left out.

    Parameters
    ----------
    points : (n, 3)   mm
    n_target : most points to keep
    finest : smallest cell, as a fraction of the extent of the cloud
    """
    kept, cell = thin_indices(points, n_target, finest)
    thinned = points[kept]
    normals, variances, reach = local_planes(thinned, NEIGHBOURS)
    company = reach <= 3.0 * float(np.median(reach))
    roughness = float(np.sqrt(np.quantile(variances[company, 0], 0.3)))
    thickness = float(np.median(variances[company, 0] / np.maximum(variances[company, 1], 1e-300)))
    return SearchCloud(thinned[company], normals[company], cell, roughness, thickness)


def local_planes(
    points: Float[np.ndarray, "n 3"], neighbours: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Unit normals of local planes (of either sign), the variances of the neighbourhoods, and the mean distance of the nearest.

    With few frames a turn, stripes are so far apart that near neighbours all lie on one, which has no normal. There the
    neighbourhood grows until it holds more than one stripe and spreads in two directions.
    """
    normals, variances, reach = np.empty_like(points), np.empty_like(points), np.empty(len(points))
    tree = cKDTree(points)
    waiting = np.arange(len(points))
    for factor in GROWTH:
        k = min(factor * neighbours, len(points))
        narrow = []
        for at in range(0, len(waiting), 20_000):
            part = waiting[at : at + 20_000]
            far, near = tree.query(points[part], k=k)
            values, axes = local_axes(points[near])
            normals[part], variances[part] = axes[:, :, 0], values
            if factor == 1:
                reach[part] = far[:, 1 : max(2, k // 2)].mean(axis=1)
            narrow.append(part[values[:, 1] < LINE_LIKE * values[:, 2]])
        waiting = np.concatenate(narrow)
        if len(waiting) == 0 or k == len(points):
            break
    return normals, variances, reach


def thin_indices(points: Float[np.ndarray, "n 3"], n_target: int, finest: float) -> tuple[Int[np.ndarray, " m"], float]:
    """Indices of the points that ``thin`` keeps (lonely strays included), and the cell size, mm."""
    size = extent_of(points)
    cell = size * finest
    best: tuple[np.ndarray, float] | None = None
    while True:
        kept = _one_per_cell(points, cell)
        if best is not None and (len(kept) < FEWEST or cell > size / 15.0):
            return best
        if len(kept) <= max(n_target, FEWEST):
            best = kept, cell
            thinned = points[kept]
            probes = thinned[:: max(1, len(thinned) // PROBES)]
            _, near = cKDTree(thinned).query(probes, k=min(NEIGHBOURS, len(thinned)))
            values, _ = local_axes(thinned[near])
            spread = float(np.median(values[:, 1] / np.maximum(values[:, 2], 1e-300)))
            thickness = float(np.median(values[:, 0] / np.maximum(values[:, 1], 1e-300)))
            if spread > MIN_SPREAD and thickness < MAX_THICKNESS:
                return best
        cell *= 1.3


def cell_means(points: Float[np.ndarray, "n 3"], kept: Int[np.ndarray, " m"], cell: float) -> Float[np.ndarray, "m 3"]:
    """Mean of all points in the cells of the kept ones, mm: less noise than single points."""
    origin = points.min(axis=0)
    cells, starts, order = _grouped(cell_keys(points, origin, cell))
    counts = np.diff(starts, append=len(points))
    place = np.searchsorted(cells, cell_keys(points[kept], origin, cell))
    return np.column_stack([(np.add.reduceat(column[order], starts) / counts)[place] for column in points.T])


def _one_per_cell(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one point in each occupied cell, the middle one in the order of the cloud.

    Cells with far fewer points than the occupied ones around them hold strays beside a surface, and are left out.
    """
    cells, starts, order = _grouped(cell_keys(points, points.min(axis=0), cell))
    counts = np.diff(starts, append=len(points))
    around, n_around = sum_around(cells, cells, counts), sum_around(cells, cells, np.ones(len(cells)))
    crowded = counts >= THIN_CELL * around / n_around
    return np.sort(order[(starts + counts // 2)[crowded]])


def _grouped(
    keys: Int[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Int[np.ndarray, " n"]]:
    """The cells in order, where each begins in the order of the points by cell, and that order (within a cell: of the cloud)."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=ordered[0] - 1))
    return ordered[starts], starts, order


def sum_around(
    cells: Int[np.ndarray, " m"], known: Int[np.ndarray, " k"], values: Shaped[np.ndarray, " k"]
) -> Float[np.ndarray, " m"]:
    """Sum of the values of the known cells over the 27 cells in and around each cell; both are sorted keys."""
    total = np.zeros(len(cells))
    sum_in_and_around(cells, known, values.astype(float), total)
    return total


def cell_keys(points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], cell: float) -> Int[np.ndarray, " n"]:
    """One integer a cell of a cubic grid; neighbours along x, y, z differ by 1, 2**20, 2**40."""
    keys = np.empty(len(points), dtype=np.int64)
    for at in range(0, len(points), PIECE):
        grid = np.floor((points[at : at + PIECE] - origin) / cell)
        grid = np.clip(grid, -(2**18), 2**19 - 1).astype(np.int64) + 2**18
        keys[at : at + PIECE] = grid[:, 0] + (grid[:, 1] << 20) + (grid[:, 2] << 40)
    return keys


def local_axes(
    neighbourhoods: Float[np.ndarray, "n k 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Principal variances (ascending) and axes (columns) of each neighbourhood (n, k, 3)."""
    centred = neighbourhoods - neighbourhoods.mean(axis=1, keepdims=True)
    scatter = np.einsum("nki,nkj->nij", centred, centred) / max(neighbourhoods.shape[1] - 3, 1)
    values, vectors = np.linalg.eigh(scatter)
    return np.maximum(values, 0.0), vectors


def extent_of(points: Float[np.ndarray, "n 3"]) -> float:
    """Size of a cloud without its outermost points, mm."""
    low, high = np.transpose([np.quantile(column, [0.01, 0.99]) for column in points.T])
    return max(float(np.linalg.norm(high - low)), 1e-12)
