"""Thinning of a cloud to even density, and local normals.

A rotary line scan is dense along the stripe and sparse across it; thinning by cells makes areas count instead of points.
The cells are made just large enough that neighbourhoods spread in two directions, and farther than the noise, so that local
planes mean something.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

NEIGHBOURS = 14
PROBES = 2000
"""Points whose neighbourhoods are looked at to judge a cell size."""


@dataclass(frozen=True, eq=False)
class SearchCloud:
    """Evenly thinned points with unit normals (of either sign); ``spacing`` is the cell size, mm.

    ``roughness`` is the typical distance of points from the local plane, mm: noise, and the bend of the surface within a cell.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    spacing: float
    roughness: float

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
    k = min(NEIGHBOURS, len(thinned))
    far, near = cKDTree(thinned).query(thinned, k=k)
    values, vectors = local_axes(thinned[near])
    mean_gap = far[:, 1 : max(2, k // 2)].mean(axis=1)
    company = mean_gap <= 3.0 * float(np.median(mean_gap))
    roughness = float(np.sqrt(np.quantile(values[company, 0], 0.3)))
    return SearchCloud(thinned[company], vectors[company, :, 0], cell, roughness)


def thin_indices(points: Float[np.ndarray, "n 3"], n_target: int, finest: float) -> tuple[Int[np.ndarray, " m"], float]:
    """Indices of the points that ``thin`` keeps (strays included), and the cell size, mm."""
    size = extent_of(points)
    cell = size * finest
    while True:
        kept = _one_per_cell(points, cell)
        if len(kept) <= n_target or len(kept) < 300:
            thinned = points[kept]
            probes = thinned[:: max(1, len(thinned) // PROBES)]
            _, near = cKDTree(thinned).query(probes, k=min(NEIGHBOURS, len(thinned)))
            values, _ = local_axes(thinned[near])
            spread = float(np.median(values[:, 1] / np.maximum(values[:, 2], 1e-300)))
            flat = float(np.median(values[:, 0] / np.maximum(values[:, 1], 1e-300))) < 0.1
            if (spread > 0.3 and flat) or len(kept) < 600 or cell > size / 15.0:
                return kept, cell
        cell *= 1.3


def cell_means(points: Float[np.ndarray, "n 3"], kept: Int[np.ndarray, " m"], cell: float) -> Float[np.ndarray, "m 3"]:
    """Mean of all points in the cells of the kept ones, mm: less noise than single points."""
    keys = cell_keys(points, points.min(axis=0), cell)
    cells, place, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.column_stack([np.bincount(place, weights=column, minlength=len(cells)) for column in points.T])
    return (sums / counts[:, None])[place[kept]]


def _one_per_cell(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one point in each occupied cell: the middle one in the order of the cloud."""
    keys = cell_keys(points, points.min(axis=0), cell)
    _, counts = np.unique(keys, return_counts=True)
    order = np.argsort(keys, kind="stable")
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return np.sort(order[starts + counts // 2])


def cell_keys(points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], cell: float) -> Int[np.ndarray, " n"]:
    """One integer a cell of a cubic grid; neighbours along x, y, z differ by 1, 2**20, 2**40."""
    grid = np.clip(np.floor((points - origin) / cell), -(2**18), 2**19 - 1).astype(np.int64) + 2**18
    return grid[:, 0] + (grid[:, 1] << 20) + (grid[:, 2] << 40)


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
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    return max(float(np.linalg.norm(high - low)), 1e-12)
