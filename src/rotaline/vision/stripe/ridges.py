"""Where the stripe is, to about a pixel: chains of pixels on ridges that fall off to both sides.

The image is looked at in three sizes (full, half, quarter), each smoothed by a Gaussian of one pixel. A pixel is a candidate
of a *steep* chain if it is the highest of its row within three pixels and stands above both pixels three to its left and
right; of a *flat* chain if the same holds in its column. Candidates of neighbouring rows (columns) are linked where each is
the other's nearest. A stripe of any direction is steep or flat (near 45 deg it is both); the chains compete for the pixels
they cover, the one with the largest sum of prominence first, so that no part of the stripe is found twice. The sum of
prominence also settles the size: it is largest where the smoothing suits the stripe's width. A row of short pieces is one long
chain in a smaller image; it stands back where the pieces themselves are clearly stronger together.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_REACH = 3  # px of the level: a ridge must fall off over this distance
_LEVELS = 3
_MAX_CHAINS = 400
_SHORTEST = 4  # points of a chain


@dataclass(frozen=True, eq=False)
class Ridge:
    """A chain of points near the middle of a stripe, one for each row (steep) or column (flat) of its level.

    Attributes
    ----------
    uv : (n, 2)   px of the full image, in order
    prominence : (n,)   height above the higher of the two sides, in the image's grey values
    steep : bool   the chain has one point a row; otherwise one a column
    scale_px : float   standard deviation of the smoothing at which the chain was found
    """

    uv: Float[np.ndarray, "n 2"]
    prominence: Float[np.ndarray, " n"]
    steep: bool
    scale_px: float

    @property
    def strength(self) -> float:
        """Sum of prominence along the ridge, grey values x px."""
        return float(self.prominence.sum()) * self.scale_px


def find_ridges(score: Float32[np.ndarray, "h w"], threshold: float, contrast_floor: float) -> list[Ridge]:
    """Find the ridges of an image.

    Parameters
    ----------
    score : (h, w)   the image in which the stripe is bright
    threshold : float   least prominence as a multiple of the prominence of the image's noise
    contrast_floor : float   least prominence in grey values

    Returns
    -------
    list of Ridge   strongest first; no two cover the same pixels
    """
    found = []
    level_image = score
    for level in range(_LEVELS):
        if level:
            if min(level_image.shape) < 16:
                break
            level_image = cv2.resize(
                level_image, (level_image.shape[1] // 2, level_image.shape[0] // 2), interpolation=cv2.INTER_AREA
            )
        smooth = cv2.GaussianBlur(level_image, (0, 0), 1.0)
        if min(smooth.shape) <= 2 * _REACH:
            break
        for steep in (True, False):
            found += _level_chains(smooth, steep, 2**level, threshold, contrast_floor)
    return _compete(found, score.shape)


def _level_chains(
    smooth: Float32[np.ndarray, "h w"],
    steep: bool,
    factor: int,
    threshold: float,
    contrast_floor: float,
) -> list[Ridge]:
    """Chains of one level and one kind."""
    rows, columns, prominence = _candidates(smooth, steep, threshold, contrast_floor)
    if len(rows) == 0:
        return []
    lines, places = (rows, columns) if steep else (columns, rows)
    chain = _link(lines, places, smooth.shape[1] if steep else smooth.shape[0])
    order = np.lexsort((lines, chain))
    chain, rows, columns, prominence = chain[order], rows[order], columns[order], prominence[order]
    starts = np.flatnonzero(np.diff(chain, prepend=-1))
    lengths = np.diff(np.append(starts, len(chain)))
    offset = (factor - 1) / 2.0  # the centre of the first pixel of the level
    uv = np.column_stack([columns, rows]) * float(factor) + offset
    return [
        Ridge(uv[s : s + n], prominence[s : s + n], steep, float(factor))
        for s, n in zip(starts, lengths, strict=True)
        if n >= _SHORTEST
    ]


def _candidates(
    smooth: Float32[np.ndarray, "h w"], steep: bool, threshold: float, contrast_floor: float
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Rows, columns and prominence of the pixels that are the highest of their row (steep) or column within the reach."""
    r = _REACH
    if steep:
        low, middle, high = smooth[:, : -2 * r], smooth[:, r:-r], smooth[:, 2 * r :]
    else:
        low, middle, high = smooth[: -2 * r], smooth[r:-r], smooth[2 * r :]
    drop = np.maximum(low, high)
    np.subtract(middle, drop, out=drop)
    sample = drop[::5, ::5] if drop.size > 65536 else drop
    # the drop below the higher side has a negative mean; its upper tail tells the noise
    centre = np.median(sample)
    noise = 1.4826 * float(np.median(np.abs(sample - centre)))
    limit = max(contrast_floor, threshold * max(noise, 0.08))
    rows, columns = np.divmod(np.flatnonzero(drop > limit), drop.shape[1])
    prominence = drop[rows, columns].astype(float)
    if steep:
        columns = columns + r
    else:
        rows = rows + r
    value = smooth[rows, columns]
    highest = np.ones(len(rows), dtype=bool)
    for k in range(1, r + 1):
        before = smooth[rows, columns - k] if steep else smooth[rows - k, columns]
        after = smooth[rows, columns + k] if steep else smooth[rows + k, columns]
        highest &= (value > before) & (value >= after)
    return rows[highest], columns[highest], prominence[highest]


def _link(lines: Int[np.ndarray, " n"], places: Int[np.ndarray, " n"], size: int) -> Int[np.ndarray, " n"]:
    """Chain number of each candidate: candidates on neighbouring lines are linked where each is the other's nearest.

    Up to two lines may be missing between two linked candidates.
    """
    n = len(lines)
    stride = size + 8
    order = np.argsort(lines * stride + places)
    key = (lines * stride + places)[order]
    successor = np.full(n, -1)
    predecessor = np.full(n, -1)
    for gap, tolerance in ((1, 2), (2, 3), (3, 4)):
        forward = _nearest(key, key + gap * stride, tolerance)
        backward = _nearest(key, key - gap * stride, tolerance)
        i = np.arange(n)
        mutual = (forward >= 0) & (successor < 0)
        mutual[mutual] &= (backward[forward[mutual]] == i[mutual]) & (predecessor[forward[mutual]] < 0)
        successor[mutual] = forward[mutual]
        predecessor[forward[mutual]] = i[mutual]
    linked = successor >= 0
    graph = coo_array((np.ones(linked.sum()), (np.flatnonzero(linked), successor[linked])), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    chain = np.empty(n, dtype=np.int64)
    chain[order] = label
    return chain


def _nearest(key: Int[np.ndarray, " n"], wanted: Int[np.ndarray, " n"], tolerance: int) -> Int[np.ndarray, " n"]:
    """Index of the key nearest to each wanted key, -1 where none lies within the tolerance."""
    right = np.searchsorted(key, wanted).clip(0, len(key) - 1)
    left = (right - 1).clip(0)
    best = np.where(np.abs(key[left] - wanted) <= np.abs(key[right] - wanted), left, right)
    return np.where(np.abs(key[best] - wanted) <= tolerance, best, -1)


def _compete(ridges: list[Ridge], shape: tuple[int, ...]) -> list[Ridge]:
    """Give every pixel to one chain only, the chain with the larger sum of prominence first."""
    taken = np.zeros(shape, dtype=np.uint8)
    ridges = sorted(ridges, key=lambda ridge: -ridge.strength)[:_MAX_CHAINS]
    kept = []
    for ridge in _coarse_back(ridges, shape):
        free = taken[_pixels(ridge, shape)] == 0
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8)))
        half = _half_width(ridge)
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if stop - start < _SHORTEST:
                continue
            part = Ridge(ridge.uv[start:stop], ridge.prominence[start:stop], ridge.steep, ridge.scale_px)
            kept.append(part)
            taken[_band(part, half, shape)] = 1
    return kept


def _coarse_back(ridges: list[Ridge], shape: tuple[int, ...]) -> list[Ridge]:
    """The ridges, those last that cover finer ones which are clearly stronger together.

    The finer ones are counted once for each row (column) of the coarse one.
    """
    finest = np.zeros(shape, dtype=np.float32)
    back: list[Ridge] = []
    for scale in sorted({ridge.scale_px for ridge in ridges}):
        level = [ridge for ridge in ridges if ridge.scale_px == scale]
        if scale > 1.0:
            back += [r for r in level if finest[_band(r, _half_width(r), shape)].sum() > np.sqrt(scale) * r.strength]
        for ridge in level:
            place = _pixels(ridge, shape)
            finest[place] = np.maximum(finest[place], ridge.prominence * ridge.scale_px)
    late = {id(ridge) for ridge in back}
    return [ridge for ridge in ridges if id(ridge) not in late] + [ridge for ridge in ridges if id(ridge) in late]


def _pixels(ridge: Ridge, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels at the ridge's points."""
    columns, rows = np.rint(ridge.uv).astype(int).T
    return rows.clip(0, shape[0] - 1), columns.clip(0, shape[1] - 1)


def _half_width(ridge: Ridge) -> int:
    """Pixels on either side that a ridge covers."""
    return round(2.5 * ridge.scale_px + 2)


def _band(ridge: Ridge, half: int, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels within ``half`` of the ridge, across it, a row of the result for each; no further than its ends."""
    axis = 1 if ridge.steep else 0
    line = np.arange(np.ceil(ridge.uv[0, axis]), np.floor(ridge.uv[-1, axis]) + 1)
    place = np.rint(np.interp(line, ridge.uv[:, axis], ridge.uv[:, 1 - axis])).astype(int)
    across = (place[:, None] + np.arange(-half, half + 1)).clip(0, shape[axis] - 1)
    line = line.astype(int).clip(0, shape[1 - axis] - 1)[:, None]
    return (line, across) if ridge.steep else (across, line)
