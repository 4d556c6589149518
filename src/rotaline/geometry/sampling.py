"""Random sample consensus: the engine behind the searches of ``robust``.

Every sampled model is scored by the residuals of that very model (MSAC: squared distances, cut at the threshold) [1]_.
Hypotheses are made and scored in blocks; a large cloud is scored on a random part of it, the inliers are those of the whole.

References
----------
.. [1] Torr and Zisserman, MLESAC, Computer Vision and Image Understanding 78 (2000) 138
"""

from collections.abc import Callable

import numpy as np

from rotaline.errors import GeometryError

CONFIDENCE = 0.999
MAX_HYPOTHESES = 4096
BLOCK = 128
MAX_SCORED = 4000
FIRST_SCORED = 400


def sample_consensus(
    n: int,
    n_sample: int,
    threshold: float,
    rng: np.random.Generator,
    propose: Callable[[np.ndarray], np.ndarray],
    score: Callable[[np.ndarray, np.ndarray], np.ndarray],
    n_min: int,
    shape: str,
    block: int = BLOCK,
    max_hypotheses: int = MAX_HYPOTHESES,
) -> tuple[np.ndarray, np.ndarray]:
    """The model with the least truncated squared residuals, and its inliers among all points.

    Parameters
    ----------
    n, n_sample : number of points, and of points that make a model
    threshold : largest residual of an inlier
    rng : for the samples
    propose : index tuples (m, n_sample) -> models (m, p); rows with NaN are dropped
    score : models (m, p), indices (k,) -> residuals (m, k), >= 0
    n_min : fewest inliers
    shape : its name, for messages
    block, max_hypotheses : samples drawn at a time, and in all

    Raises
    ------
    GeometryError
        If no model has that many inliers.
    """
    scored = some_indices(n, rng)
    best, best_cost, needed, done = None, np.inf, float(max_hypotheses), 0
    while done < min(needed, max_hypotheses):
        models = propose(index_tuples(n, n_sample, block, rng))
        done += block
        models = models[np.all(np.isfinite(models), axis=1)]
        if len(models) == 0:
            continue
        if len(scored) > 4 * FIRST_SCORED:
            # Most hypotheses are poor, and a few points show that.
            rough = np.sum(np.minimum(score(models, scored[:FIRST_SCORED]), threshold) ** 2, axis=1)
            models = models[np.argsort(rough)[:16]]
        residuals = score(models, scored)
        costs = np.sum(np.minimum(residuals, threshold) ** 2, axis=1)
        first = int(np.argmin(costs))
        if costs[first] < best_cost:
            best, best_cost = models[first], float(costs[first])
            ratio = float(np.mean(residuals[first] <= threshold))
            chance = min(max(ratio**n_sample, 1e-12), 1 - 1e-12)
            # Noise of the samples makes some all-inlier models poor: allow for that with three times the usual number.
            needed = 3 * np.log(1 - CONFIDENCE) / np.log1p(-chance)
    if best is None:
        raise GeometryError(
            f"No sample of {n_sample} of the {n} points makes a {shape}; they coincide, lie on a line, or do not face as it would."
        )
    inliers = np.concatenate(
        [score(best[None], np.arange(at, min(at + 65536, n)))[0] <= threshold for at in range(0, n, 65536)]
    )
    if np.count_nonzero(inliers) < max(n_min, n_sample):
        raise GeometryError(
            f"The best {shape} has only {np.count_nonzero(inliers)} of {n} points within {threshold:.3g} of it; "
            f"{max(n_min, n_sample)} are needed. Allow a larger threshold, or choose points of a {shape}."
        )
    return best, inliers


def require_points(points: np.ndarray, n_needed: int, shape: str) -> None:
    """Raise GeometryError if there are too few points, or some are not finite."""
    if len(points) < n_needed:
        raise GeometryError(f"A {shape} needs at least {n_needed} points; there are {len(points)}.")
    if not np.all(np.isfinite(points)):
        raise GeometryError(f"The points of a {shape} must be finite numbers; leave out the missing ones.")


def some_indices(n: int, rng: np.random.Generator) -> np.ndarray:
    """Indices on which hypotheses are scored, in random order."""
    return rng.permutation(n) if n <= MAX_SCORED else rng.choice(n, MAX_SCORED, replace=False)


def index_tuples(n: int, n_sample: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random index tuples (count, n_sample) without repeats inside a tuple."""
    samples = rng.integers(0, n, size=(count, n_sample))
    ordered = np.sort(samples, axis=1)
    repeated = np.any(ordered[:, 1:] == ordered[:, :-1], axis=1)
    for row in np.flatnonzero(repeated):
        samples[row] = rng.choice(n, n_sample, replace=False)
    return samples
