"""Centres of the circles on which points of a turning target move.

With ``p_i`` the positions of one point at successive angles, the chord ``n_i = p_(i+1) - p_i`` and its middle
``q_i = (p_i + p_(i+1)) / 2``, the centre O satisfies ``n_i . O = n_i . q_i`` (eq. (8) of [1]_) and lies in the plane of the
circle. The article writes that plane ``G . O = 1`` and solves normal equations (eq. (9) and (10)). This fails for planes near
the origin and squares the condition number; here the plane has a unit normal g, and the stacked system
``[n_i; g] O = [n_i . q_i; g . mean(p)]`` is solved by orthogonal factorisation. The solution is the same for exact circles. With
noise, the parts of the chords across the plane would push O out of it (by a millimetre, for a small board); so the positions
are projected into their plane first, and O lies in it.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (8)-(10)
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, eq=False)
class CircleFits:
    """One circle a point; NaN rows where a point was seen at fewer than three positions.

    Attributes
    ----------
    centres, normals : (m, 3)   mm, unit; each normal is turned to the side of the first
    radii_mm, rms_mm : (m,)   mean distance of the positions from the centre; RMS distance of the positions from the circle
    """

    centres: Float[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 3"]
    radii_mm: Float[np.ndarray, " m"]
    rms_mm: Float[np.ndarray, " m"]

    def distances(self, positions: Float[np.ndarray, "f m 3"]) -> Float[np.ndarray, "f m"]:
        """Distance of each position from the circle of its point, mm; NaN where there is none."""
        arms = positions - self.centres
        along = np.sum(arms * self.normals, axis=2)
        radial = np.linalg.norm(np.cross(arms, self.normals), axis=2) - self.radii_mm
        return np.hypot(radial, along)


def fit_circles_by_chords(positions: Float[np.ndarray, "f m 3"]) -> CircleFits:
    """Centre of the circle of every point, from its chords; eq. (8)-(10) of the article in a stable form.

    Parameters
    ----------
    positions : (f, m, 3)   mm; point m at f successive angles; NaN where it was not seen (the chord then spans the gap)

    Returns
    -------
    CircleFits   for the m points, in the frame of the positions

    Examples
    --------
    >>> import numpy as np
    >>> t = np.radians([0.0, 10.0, 25.0, 40.0])
    >>> circle = np.stack([5 + 3 * np.cos(t), 3 * np.sin(t), np.full(4, 7.0)], axis=1)[:, None]
    >>> fit_circles_by_chords(circle).centres.round(9) + 0.0
    array([[5., 0., 7.]])
    """
    if len(positions) < 3:
        nan = np.full(positions.shape[1:], np.nan)
        return CircleFits(nan, nan, nan[:, 0], nan[:, 0])
    seen = np.isfinite(positions).all(axis=2)
    n_seen = seen.sum(axis=0)
    enough = n_seen >= 3
    mean = np.where(seen[..., None], positions, 0.0).sum(axis=0) / np.maximum(n_seen, 1)[:, None]
    local = np.where(seen[..., None], positions - mean, 0.0)  # missing positions are rows of zeros: they say nothing

    _, _, right = np.linalg.svd(local.transpose(1, 0, 2), full_matrices=False)
    normals = right[:, 2, :]
    normals = normals * np.where(normals @ normals[int(np.argmax(enough))] < 0, -1.0, 1.0)[:, None]

    chords, middles = _chords(local - np.sum(local * normals, axis=2)[..., None] * normals, seen)
    system = np.concatenate([chords.transpose(1, 0, 2), normals[:, None, :]], axis=1)
    right_side = np.concatenate([np.sum(chords * middles, axis=2).T, np.zeros((len(mean), 1))], axis=1)
    q, r = np.linalg.qr(system)
    size = np.abs(np.diagonal(r, axis1=1, axis2=2))
    enough &= size.min(axis=1) > 1e-12 * size.max(axis=1)
    r = np.where(enough[:, None, None], r, np.eye(3))
    centres_local = np.linalg.solve(r, np.einsum("mij,mi->mj", q, right_side)[..., None])[..., 0]

    nan = np.where(enough, 0.0, np.nan)
    radial = np.linalg.norm(np.cross(positions - mean - centres_local, normals), axis=2)
    count = np.maximum(n_seen, 1)
    fits = CircleFits(
        centres=centres_local + mean + nan[:, None],
        normals=normals + nan[:, None],
        radii_mm=np.where(seen, radial, 0.0).sum(axis=0) / count + nan,
        rms_mm=nan,
    )
    squares = np.where(seen, fits.distances(positions) ** 2, 0.0)
    return replace(fits, rms_mm=np.sqrt(squares.sum(axis=0) / count))


def _chords(
    local: Float[np.ndarray, "f m 3"], seen: Bool[np.ndarray, "f m"]
) -> tuple[Float[np.ndarray, "k m 3"], Float[np.ndarray, "k m 3"]]:
    """Chords between successive positions that were seen, and their middles; zero rows where there is none."""
    chords, middles = [], []
    last, have = local[0], seen[0]
    for position, visible in zip(local[1:], seen[1:], strict=True):
        both = (have & visible)[:, None]
        chords.append(np.where(both, position - last, 0.0))
        middles.append(np.where(both, (position + last) / 2, 0.0))
        last = np.where(visible[:, None], position, last)
        have = have | visible
    return np.array(chords), np.array(middles)
