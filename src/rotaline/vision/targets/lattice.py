"""From scattered candidate points to a lattice: which candidates are neighbours in one grid, and where the grid stands in it.

A lattice starts from a candidate with two pairs of opposite neighbours and grows from point to point: each step is predicted
from the steps next to it, so perspective and distortion may bend the grid. Then a window of the expected number of columns and
rows is laid over the integer coordinates. What was nearly found is kept for the error message.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError
from rotaline.vision.targets.grid_map import fit_grid_map_robust

_NEIGHBOURS = 20
_STEP_TOLERANCE = 0.3  # of a step; the next point must stand this close to its prediction
_ROUGH = 0.08  # of a step; points that scatter more about a smooth map are no grid
_MAX_PLACEMENTS = 6
_MINIMUM = 8  # points of a lattice worth looking at


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points that may belong to a grid.

    Attributes
    ----------
    uv : (n, 2)   px
    phase : (n,)   corners: direction of the bright sector, rad modulo pi; it turns by pi/2 from corner to corner. Else NaN
    size : (n,)   dots: area, px^2; similar in neighbours. Else NaN
    """

    uv: Float[np.ndarray, "n 2"]
    phase: Float[np.ndarray, " n"]
    size: Float[np.ndarray, " n"]

    def matches(self, i: int, others: Int[np.ndarray, " k"], odd: bool) -> Bool[np.ndarray, " k"]:
        """Whether the others may stand an odd (even) number of steps from point i."""
        if np.isfinite(self.phase[i]):
            turn = np.cos(2 * (self.phase[others] - self.phase[i]))
            return np.asarray(turn < -0.5) if odd else np.asarray(turn > 0.5)
        ratio = self.size[others] / self.size[i]
        return np.asarray((ratio > 0.45) & (ratio < 2.2))


@dataclass(frozen=True, eq=False)
class Lattice:
    """Candidates with integer coordinates.

    Attributes
    ----------
    ids : (n,)   index of the candidate
    cells : (n, 2)   integer coordinates; steps in the first and the second turn right-handed in the image (u to v)
    """

    ids: Int[np.ndarray, " n"]
    cells: Int[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class Placement:
    """A grid laid over a lattice: lattice cell = origin + column * column_step + row * row_step."""

    origin: Int[np.ndarray, "2"]
    column_step: Int[np.ndarray, "2"]
    row_step: Int[np.ndarray, "2"]

    def grid_of(self, cells: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
        """Column and row of lattice cells (outside the grid too)."""
        steps = np.stack([self.column_step, self.row_step], axis=1)
        return np.round((cells - self.origin) @ np.linalg.inv(steps).T).astype(int)


def grow_lattices(candidates: Candidates, least: int = _MINIMUM, max_seeds: int = 400) -> Iterator[Lattice]:
    """Lattices of at least so many points among the candidates, each from a fresh seed, in the order of the candidates."""
    n = len(candidates.uv)
    if n < _MINIMUM:
        return
    tree = cKDTree(candidates.uv)
    k = min(_NEIGHBOURS + 1, n)
    near = tree.query(candidates.uv, k=k)[1][:, 1:]
    used = np.zeros(n, dtype=bool)
    tried = 0
    for seed in range(n):
        if used[seed] or tried >= max_seeds:
            continue
        tried += 1
        star = _opposite_pairs(candidates, seed, near[seed])
        if star is None:
            continue
        assigned = _grow(candidates, seed, star, near)
        if len(assigned) < least:
            continue
        used[list(assigned.values())] = True
        grown = Lattice(np.array(list(assigned.values())), np.array(list(assigned.keys())))
        lattice = _fill(candidates, _reduced(grown, candidates), tree)
        if lattice is not None:
            used[lattice.ids] = True
            yield lattice


def _opposite_pairs(
    candidates: Candidates, seed: int, near: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """The two shortest steps from a point for which neighbours stand on both sides; turned right-handed."""
    near = near[candidates.matches(seed, near, odd=True)]
    if len(near) < 4:
        return None
    steps = candidates.uv[near] - candidates.uv[seed]
    lengths = np.linalg.norm(steps, axis=1)
    mismatch = np.linalg.norm(steps[:, None, :] + steps[None, :, :], axis=2)
    opposite = mismatch.argmin(axis=1)
    good = mismatch[np.arange(len(near)), opposite] < _STEP_TOLERANCE * lengths
    mean_steps = (steps - steps[opposite]) / 2
    first: np.ndarray | None = None
    for i in np.argsort(lengths):
        if not good[i]:
            continue
        if first is None:
            first = mean_steps[i]
            continue
        second = mean_steps[i] - _multiple(mean_steps[i], first, bool(np.isfinite(candidates.phase[seed]))) * first
        cross = first[0] * second[1] - first[1] * second[0]
        if abs(cross) > 0.25 * np.linalg.norm(first) * np.linalg.norm(second):
            second = _halved(first, second if cross > 0 else -second, steps)
            return first, second
    return None


def _halved(
    first: Float[np.ndarray, "2"], second: Float[np.ndarray, "2"], steps: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "2"]:
    """A shorter second step, if a neighbour stands half way: beside a gap every other row may have been taken."""
    for half in (second / 2, (second + first) / 2, (second - first) / 2):
        distance = np.linalg.norm(np.concatenate([steps - half, steps + half]), axis=1)
        if distance.min() < 0.2 * min(np.linalg.norm(half), np.linalg.norm(first)):
            return half
    return second


def _multiple(long: Float[np.ndarray, "2"], short: Float[np.ndarray, "2"], alternating: bool) -> int:
    """How often a step can be taken off another to make it shorter; an even number where points alternate."""
    square = float(short @ short)
    ratio = float(long @ short) / square if square > 0 else 0.0
    return 2 * round(ratio / 2) if alternating else round(ratio)


def _grow(
    candidates: Candidates,
    seed: int,
    star: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]],
    near: Int[np.ndarray, "n k"],
) -> dict[tuple[int, int], int]:
    """Grow from the seed; each point inherits the steps that led to it."""
    uv = candidates.uv
    assigned = {(0, 0): seed}
    taken = {seed}
    queue = deque([((0, 0), star[0], star[1])])
    while queue:
        cell, a, b = queue.popleft()
        here = assigned[cell]
        around = near[here]
        around = around[candidates.matches(here, around, odd=True)]
        if not len(around):
            continue
        offsets = uv[around] - uv[here]
        shorter = min(np.hypot(*a), np.hypot(*b))
        for di, dj in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            step = di * a + dj * b
            distance = np.hypot(offsets[:, 0] - step[0], offsets[:, 1] - step[1])
            best = int(distance.argmin())
            if distance[best] < min(_STEP_TOLERANCE * np.hypot(*step), 0.5 * shorter):
                target = (cell[0] + di, cell[1] + dj)
                candidate = int(around[best])
                if target in assigned or candidate in taken:
                    continue
                assigned[target] = candidate
                taken.add(candidate)
                new_a = di * offsets[best] if di else a
                new_b = dj * offsets[best] if dj else b
                queue.append((target, new_a, new_b))
    return assigned


def _fill(candidates: Candidates, lattice: Lattice, tree: cKDTree) -> Lattice | None:
    """Drop points that do not follow a smooth map, then look for missing ones in gaps and around, until nothing changes.

    None if the points do not follow any: neighbours by chance.
    """
    cells, ids = lattice.cells, lattice.ids
    for _ in range(12):
        try:
            step = _median_step(cells, candidates.uv[ids])
            core = _surrounded(cells)
            grid_map, kept, rms = fit_grid_map_robust(
                cells[core].astype(float), candidates.uv[ids[core]], 0.12 * step, max_degree=3 if len(ids) >= 60 else 2
            )
            if not core.all():
                with np.errstate(all="ignore"):
                    distance = np.linalg.norm(grid_map.apply(cells.astype(float)) - candidates.uv[ids], axis=1)
                kept = distance < 0.15 * step
        except GeometryError:
            return None
        if not rms < _ROUGH * step:
            return None
        cells, ids = cells[kept], ids[kept]
        assigned = {(int(c[0]), int(c[1])): int(i) for c, i in zip(cells, ids, strict=True)}
        low, high = cells.min(axis=0) - 3, cells.max(axis=0) + 3
        if np.prod(high - low + 1) > 20000:
            break
        grid = np.stack(np.meshgrid(*[np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]), axis=-1)
        free = np.array([c for c in grid.reshape(-1, 2).tolist() if tuple(c) not in assigned]).reshape(-1, 2)
        free = free[_beside(free, cells)]
        if not len(free):
            break
        predicted = grid_map.apply(free.astype(float))
        local = np.sqrt(np.abs(np.linalg.det(grid_map.jacobian(free.astype(float)))))
        finite = np.all(np.isfinite(predicted), axis=1)
        free, predicted, local = free[finite], predicted[finite], local[finite]
        distance, index = tree.query(predicted)
        taken = set(assigned.values())
        reference = int(ids[0])
        added = False
        for cell, d, i, size in zip(free.tolist(), distance, index, local, strict=True):
            odd = bool((cell[0] + cell[1] - cells[0].sum()) % 2)
            if d < 0.2 * size and int(i) not in taken and _matches_far(candidates, reference, int(i), odd):
                assigned[cell[0], cell[1]] = int(i)
                taken.add(int(i))
                added = True
        cells, ids = np.array(list(assigned.keys())), np.array(list(assigned.values()))
        if not added:
            break
    return Lattice(ids, cells)


def _reduced(lattice: Lattice, candidates: Candidates) -> Lattice:
    """The same points with the shortest steps that reach them all (corners: steps that change the phase)."""
    alternating = bool(np.isfinite(candidates.phase[lattice.ids[0]]))
    cells = lattice.cells - lattice.cells.mean(axis=0)
    steps = np.linalg.lstsq(cells, candidates.uv[lattice.ids] - candidates.uv[lattice.ids].mean(axis=0), rcond=None)[0]
    change = np.eye(2, dtype=int)  # rows: new steps in terms of the old ones
    for _ in range(20):
        long, short = (1, 0) if steps[1] @ steps[1] >= steps[0] @ steps[0] else (0, 1)
        times = _multiple(steps[long], steps[short], alternating)
        if times == 0:
            break
        steps[long] -= times * steps[short]
        change[long] -= times * change[short]
    return Lattice(lattice.ids, np.round(lattice.cells @ np.linalg.inv(change)).astype(int))


def _matches_far(candidates: Candidates, reference: int, other: int, odd: bool) -> bool:
    """Looser than ``matches``: perspective changes phase and size over the grid."""
    if np.isfinite(candidates.phase[reference]):
        turn = float(np.cos(2 * (candidates.phase[other] - candidates.phase[reference])))
        return turn < 0 if odd else turn > 0
    return bool(0.1 < candidates.size[other] / candidates.size[reference] < 10)


def _surrounded(cells: Int[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Cells with at least three of their four neighbours, where a wrong point is unlikely; all, if these are few."""
    count = cKDTree(cells).query_ball_point(cells, 1.01, return_length=True)
    core = np.asarray(count >= 4)
    return core if core.sum() >= max(12, 0.3 * len(cells)) else np.ones(len(cells), dtype=bool)


def _beside(free: Int[np.ndarray, "m 2"], cells: Int[np.ndarray, "n 2"]) -> Bool[np.ndarray, " m"]:
    """Free cells with an assigned one within three steps."""
    if not len(free):
        return np.zeros(0, dtype=bool)
    return np.asarray(cKDTree(cells).query(free, p=np.inf)[0] <= 3)


def _median_step(cells: Int[np.ndarray, "n 2"], uv: Float[np.ndarray, "n 2"]) -> float:
    """Typical distance of neighbours, px."""
    pairs = cKDTree(cells).query_pairs(1.01, output_type="ndarray")
    if not len(pairs):
        raise GeometryError("No two neighbours in the lattice.")
    return float(np.median(np.linalg.norm(uv[pairs[:, 0]] - uv[pairs[:, 1]], axis=1)))


def _shears(odd_too: bool) -> list[Int[np.ndarray, "2 2"]]:
    """Changes between steps along the grid lines and along diagonals of the grid."""
    shears = [np.eye(2, dtype=int)]
    for k in (1, -1, 2, -2) if odd_too else (2, -2):
        shears += [np.array([[1, k], [0, 1]]), np.array([[1, 0], [k, 1]])]
    return shears


def place_grid(
    lattice: Lattice, grid_size: tuple[int, int], alternating: bool
) -> tuple[list[Placement], tuple[int, int]]:
    """Places where a grid of the expected size may lie on the lattice.

    Both ways round are tried, and lattices whose steps run along diagonals of the grid; where points are ``alternating``
    (corners), these are steps of two rows aside. Which place is right shows when the missing points are looked for.

    Returns
    -------
    placements : list of Placement   the most likely first; empty if the size is another one
    found : (columns, rows)   size of the well-occupied part of the lattice
    """
    proposals: list[tuple[float, int, Placement]] = []
    seen, most = (0, 0), 0
    enough = len(lattice) >= 0.5 * grid_size[0] * grid_size[1]
    for order, matrix in enumerate(_shears(odd_too=not alternating) if enough else [np.eye(2, dtype=int)]):
        cells = lattice.cells @ matrix.T
        low = cells.min(axis=0)
        shape = cells.max(axis=0) - low + 1
        if shape.max() > 400:
            continue
        occupied = np.zeros(shape, dtype=bool)
        occupied[tuple((cells - low).T)] = True
        core, gain = _core(occupied)
        if gain > most:
            seen, most = core, gain
        inverse = np.round(np.linalg.inv(matrix)).astype(int)
        for turned in (False, True) if grid_size[0] != grid_size[1] else (False,):
            size = grid_size[::-1] if turned else grid_size
            for score, corner in _windows(occupied, size):
                first = np.array(corner) + low
                if turned:  # columns run along the second lattice axis, rows against the first: right-handed
                    first = first + np.array([size[0] - 1, 0])
                    steps = np.array([0, 1]), np.array([-1, 0])
                else:
                    steps = np.array([1, 0]), np.array([0, 1])
                placement = Placement(inverse @ first, inverse @ steps[0], inverse @ steps[1])
                proposals.append((-score, order, placement))
    proposals.sort(key=lambda p: p[:2])
    elsewhere = most >= 0.9 * len(lattice) and sorted(seen) != sorted(grid_size)  # a clean grid of another size
    return [placement for _, _, placement in proposals[: 2 if elsewhere else _MAX_PLACEMENTS]], seen


def _windows(occupied: Bool[np.ndarray, "a b"], size: tuple[int, int]) -> list[tuple[float, tuple[int, int]]]:
    """Windows of the given size that hold nearly all points that one can hold, and how they fill: points inside minus outside."""
    height, width = size
    padded = np.pad(occupied.astype(int), ((height, height), (width, width)))
    total = np.pad(padded.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))

    def count(i: int, j: int, rows: int, columns: int) -> int:
        i1, j1 = min(i + rows, padded.shape[0]), min(j + columns, padded.shape[1])
        i, j = max(i, 0), max(j, 0)
        return int(total[i1, j1] - total[i, j1] - total[i1, j] + total[i, j])

    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    windows = []
    for i, j in np.argwhere(sums >= max(0.5 * height * width, 0.97 * sums.max())).tolist():
        outside = (
            count(i - 1, j, 1, width) / width,
            count(i + height, j, 1, width) / width,
            count(i, j - 1, height, 1) / height,
            count(i, j + width, height, 1) / height,
        )
        if max(outside) <= 0.6:
            windows.append((float(sums[i, j]) / (height * width) - 0.1 * max(outside), (i - height, j - width)))
    return windows


def _core(occupied: Bool[np.ndarray, "a b"]) -> tuple[tuple[int, int], int]:
    """Size of the lattice without border lines that are less than half occupied; its occupied minus its empty cells."""
    part = occupied
    while part.size:
        ends = (part[0].mean(), part[-1].mean(), part[:, 0].mean(), part[:, -1].mean())
        worst = int(np.argmin(ends))
        if ends[worst] >= 0.5:
            break
        part = (part[1:], part[:-1], part[:, 1:], part[:, :-1])[worst]
    return (int(part.shape[0]), int(part.shape[1])), int(2 * part.sum() - part.size)
