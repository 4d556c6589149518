"""A smooth map from the plane of a target to the image: a homography followed by a polynomial in the image.

The homography holds the perspective, the polynomial the lens distortion: radial distortion of first order and tangential
distortion are polynomials of degree three in ideal image coordinates, the second radial term has degree five. No camera
calibration is needed, so the map serves during detection: to predict points, to judge them, and to find the offset between
the image of a dot and the image of its centre.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.errors import GeometryError


def fit_homography(
    source: Float[np.ndarray, "n 2"], image: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, " n"] | None = None
) -> Float[np.ndarray, "3 3"]:
    """Homography by the normalised direct linear transform: ``image ~ H @ (source, 1)``.

    Raises
    ------
    GeometryError
        If there are fewer than four points, or they lie on a line.
    """
    if len(source) < 4:
        raise GeometryError(f"A homography needs four points, {len(source)} are there.")
    t_source, t_image = _normalisation(source), _normalisation(image)
    a = source * t_source[0, 0] + t_source[:2, 2]
    b = image * t_image[0, 0] + t_image[:2, 2]
    w = np.ones(len(a)) if weights is None else np.sqrt(weights)
    one, zero = np.ones(len(a)), np.zeros((len(a), 3))
    a1 = np.column_stack([a, one])
    rows_u = np.concatenate([a1, zero, -b[:, :1] * a1], axis=1) * w[:, None]
    rows_v = np.concatenate([zero, a1, -b[:, 1:] * a1], axis=1) * w[:, None]
    design = np.concatenate([rows_u, rows_v])
    values, vectors = np.linalg.eigh(design.T @ design)
    if not values[1] > 1e-12 * values[-1]:
        raise GeometryError("The points lie on a line or in one place: they fix no homography.")
    h = np.linalg.inv(t_image) @ vectors[:, 0].reshape(3, 3) @ t_source
    return h / np.linalg.norm(h) * np.sign(np.linalg.det(h))


def _normalisation(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 3"]:
    centre = points.mean(axis=0)
    spread = float(np.sqrt(np.mean((points - centre) ** 2)))
    if not spread > 0:
        raise GeometryError("All points are the same: they fix no homography.")
    return np.array([[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1]])


def _exponents(degree: int) -> list[tuple[int, int]]:
    return [(i, k - i) for k in range(degree + 1) for i in range(k + 1)]


def _powers(x: Float[np.ndarray, " n"], degree: int) -> list[Float[np.ndarray, " n"]]:
    """``x**0 ... x**degree`` by products, many times faster than powers."""
    powers = [np.ones_like(x)]
    for _ in range(degree):
        powers.append(powers[-1] * x)
    return powers


def _monomials(xy: Float[np.ndarray, "n 2"], degree: int) -> Float[np.ndarray, "n m"]:
    x, y = _powers(xy[:, 0], degree), _powers(xy[:, 1], degree)
    return np.stack([x[i] * y[j] for i, j in _exponents(degree)], axis=1)


def _monomial_slopes(xy: Float[np.ndarray, "n 2"], degree: int) -> Float[np.ndarray, "n m 2"]:
    x, y = _powers(xy[:, 0], degree), _powers(xy[:, 1], degree)
    along_x = [i * x[max(i - 1, 0)] * y[j] for i, j in _exponents(degree)]
    along_y = [j * x[i] * y[max(j - 1, 0)] for i, j in _exponents(degree)]
    return np.stack([np.stack(along_x, axis=1), np.stack(along_y, axis=1)], axis=2)


@dataclass(frozen=True, eq=False)
class GridMap:
    """Map from the target's plane to the image.

    ``q = H (x, y, 1)``, ``uv = q + polynomial((q - centre) / spread)``.

    Attributes
    ----------
    homography : (3, 3)
    centre, spread : (2,), float   px; they bring q into about -1 ... 1
    degree : int   of the polynomial; 0 where there are too few points for one
    coefficients : (m, 2)   px
    """

    homography: Float[np.ndarray, "3 3"]
    centre: Float[np.ndarray, "2"]
    spread: float
    degree: int
    coefficients: Float[np.ndarray, "m 2"]

    def _ideal(self, xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        h = np.column_stack([xy, np.ones(len(xy))]) @ self.homography.T
        return h[:, :2] / h[:, 2:], h[:, 2]

    def apply(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points of the plane to the image, px."""
        q, _ = self._ideal(xy)
        if not self.degree:
            return q
        return q + _monomials((q - self.centre) / self.spread, self.degree) @ self.coefficients

    def jacobian(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 2"]:
        """Derivative of :meth:`apply`: entry [i, a, b] is d uv_a / d xy_b."""
        q, scale = self._ideal(xy)
        slope = (self.homography[None, :2, :2] - q[:, :, None] * self.homography[None, 2:, :2]) / scale[:, None, None]
        if not self.degree:
            return slope
        bend = _monomial_slopes((q - self.centre) / self.spread, self.degree) / self.spread
        return (np.eye(2) + np.einsum("nmb,ma->nab", bend, self.coefficients)) @ slope

    def bend(self, xy: Float[np.ndarray, "n 2"], step: float) -> Float[np.ndarray, "n 2 2 2"]:
        """Second derivative of :meth:`apply` (central differences of the Jacobian over ``step``): [i, a, b, c]."""
        along_x = self.jacobian(xy + np.array([step, 0.0])) - self.jacobian(xy - np.array([step, 0.0]))
        along_y = self.jacobian(xy + np.array([0.0, step])) - self.jacobian(xy - np.array([0.0, step]))
        return np.stack([along_x, along_y], axis=3) / (2 * step)


def _degree(n_points: int) -> int:
    for degree, needed in ((5, 120), (3, 16), (2, 10)):
        if n_points >= needed:
            return degree
    return 0


def fit_grid_map(
    xy: Float[np.ndarray, "n 2"],
    uv: Float[np.ndarray, "n 2"],
    max_degree: int = 5,
    weights: Float[np.ndarray, " n"] | None = None,
) -> tuple[GridMap, Float[np.ndarray, "n 2"], float]:
    """Fit the map by (weighted) least squares.

    Returns
    -------
    grid_map : GridMap
    residuals_px : (n, 2)   observed minus mapped
    rms_px : float   standard deviation of a coordinate, freed from the number of parameters; NaN without redundancy

    Raises
    ------
    GeometryError
        If fewer than four points are given, or they lie on a line.
    """
    homography = fit_homography(xy, uv, weights)
    root = np.ones((len(xy), 1)) if weights is None else np.sqrt(weights)[:, None]
    centre, spread = uv.mean(axis=0), max(float(np.ptp(uv, axis=0).max()) / 2, 1e-9)
    degree = min(_degree(len(xy)), max_degree)
    grid_map = GridMap(homography, centre, spread, 0, np.zeros((1, 2)))
    residuals = uv - grid_map.apply(xy)
    parameters = 8
    if degree:
        q, _ = grid_map._ideal(xy)
        monomials = _monomials((q - centre) / spread, degree)
        coefficients = np.linalg.lstsq(monomials * root, residuals * root, rcond=1e-8)[0]
        grid_map = GridMap(homography, centre, spread, degree, coefficients)
        residuals = uv - grid_map.apply(xy)
        parameters = 2 * monomials.shape[1] + 2
    freedom = 2 * len(xy) - parameters
    rms = float(np.sqrt(np.sum(residuals**2) / freedom)) if freedom > 0 else float("nan")
    return grid_map, residuals, rms


def fit_grid_map_robust(
    xy: Float[np.ndarray, "n 2"], uv: Float[np.ndarray, "n 2"], floor_px: float, max_degree: int = 5
) -> tuple[GridMap, Bool[np.ndarray, " n"], float]:
    """Fit the map and leave out the points that do not follow it.

    Weights that fall with the residual (Cauchy) find the map that most points follow; then a point is left out where its
    residual exceeds both ``floor_px`` and six robust standard deviations.

    Returns
    -------
    grid_map : GridMap
    kept : (n,)   points that follow the map
    rms_px : float   of the kept points, see :func:`fit_grid_map`
    """
    weights = np.ones(len(xy))
    distance, scale = np.zeros(len(xy)), 0.0
    degree = min(_degree(len(xy)), max_degree)
    freedom = max(0.2, 1 - ((degree + 1) * (degree + 2) + 2 if degree else 8) / (2 * len(xy)))
    for _ in range(6):
        grid_map, residuals, _ = fit_grid_map(xy, uv, max_degree, weights)
        distance = np.linalg.norm(residuals, axis=1)
        scale = float(np.median(distance)) / 1.1774 / np.sqrt(freedom)  # Rayleigh: median = 1.1774 sigma
        weights = 1.0 / (1.0 + (distance / max(2.0 * scale, 0.1 * floor_px)) ** 2)
    kept = distance <= max(floor_px, 6.0 * scale)
    if kept.sum() < max(4, len(xy) // 3):
        kept = np.ones(len(xy), dtype=bool)
    grid_map, _, rms = fit_grid_map(xy[kept], uv[kept], max_degree)
    return grid_map, kept, rms
