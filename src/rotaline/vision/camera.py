"""The camera model: pinhole with radial and tangential distortion.

Equations (1) and (2) of [1]_, with the distortion in *normalised* coordinates x = X/Z, y = Y/Z, r2 = x2 + y2, where it holds:

``x_d = x (1 + k1 r2 + k2 r4 + k3 r6) + 2 p1 x y + p2 (r2 + 2 x2)``
``y_d = y (1 + k1 r2 + k2 r4 + k3 r6) + p1 (r2 + 2 y2) + 2 p2 x y``
``u = fx x_d + cx``, ``v = fy y_d + cy``; (0, 0) is the centre of the top-left pixel.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (1) and (2)
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.vision.camera_kernels import undistort

DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class CameraModel:
    """Intrinsic parameters: focal lengths and principal point in px, distortion without unit.

    ``image_size`` is (width, height). ``k3`` is 0 unless it was asked for.
    """

    image_size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def distort(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Ideal to distorted normalised coordinates, eq. (2)."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=1,
        )

    def distort_jacobian(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 2"]:
        """Derivative of :meth:`distort` with respect to ``xy``; entry [i, a, b] is d out_a / d in_b."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3))  # d radial / d x = slope * x
        jacobian = np.empty((len(xy), 2, 2))
        jacobian[:, 0, 0] = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
        jacobian[:, 0, 1] = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
        jacobian[:, 1, 0] = jacobian[:, 0, 1]
        jacobian[:, 1, 1] = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
        return jacobian

    def undistort(self, xy_distorted: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Distorted to ideal normalised coordinates: Newton's method on eq. (2), to 1e-14.

        Rows for which no ideal point exists (beyond the fold of a strong distortion) are NaN. A row does not depend on the others.
        """
        xy = np.empty((len(xy_distorted), 2))
        distortion = (float(value) for value in (self.k1, self.k2, self.p1, self.p2, self.k3))
        undistort(np.ascontiguousarray(xy_distorted, dtype=float), *distortion, xy)
        return xy

    def project(self, points_camera: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Points in the camera frame (mm) to pixels, eq. (1) and (2). NaN rows for points not in front of the camera."""
        z = points_camera[:, 2]
        with np.errstate(all="ignore"):
            xy = np.where((z > 0)[:, None], points_camera[:, :2] / z[:, None], np.nan)
        return self.distort(xy) * (self.fx, self.fy) + (self.cx, self.cy)

    def rays(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Viewing rays ``(x, y, 1)`` of pixels, in the camera frame; NaN rows where the distortion has no inverse."""
        xy = self.undistort((uv - (self.cx, self.cy)) / (self.fx, self.fy))
        return np.column_stack([xy, np.ones(len(xy))])

    def undistort_pixels(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Pixels as a camera without distortion would have seen them (same fx, fy, cx, cy)."""
        return self.rays(uv)[:, :2] * (self.fx, self.fy) + (self.cx, self.cy)
