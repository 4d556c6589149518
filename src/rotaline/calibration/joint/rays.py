"""Viewing rays of stripe points, and how what lies on them changes with the camera and with the pixel.

A stripe point counts by a distance ``d`` (mm) of the point where its ray meets a surface. Everything here is first order: with ``a = d d / d (x, y)``,
x and y the normalised coordinates of the ray, follow the derivatives by the camera's parameters (the pixel stays) and by the place of the pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.vision.camera import CameraModel


@dataclass(frozen=True, eq=False)
class RayBundle:
    """Rays ``(x, y, 1)`` of n pixels; ``by_pixel`` is the derivative of (x, y) by (u, v)."""

    camera: CameraModel
    directions: Float[np.ndarray, "n 3"]
    by_pixel: Float[np.ndarray, "n 2 2"]

    @staticmethod
    def of(camera: CameraModel, uv: Float[np.ndarray, "n 2"]) -> "RayBundle":
        """The rays of pixels; rows of NaN where the distortion has no inverse."""
        directions = camera.rays(uv)
        forward = np.array([[camera.fx], [camera.fy]]) * camera.distort_jacobian(directions[:, :2])
        determinant = forward[:, 0, 0] * forward[:, 1, 1] - forward[:, 0, 1] * forward[:, 1, 0]
        inverse = np.empty_like(forward)
        inverse[:, 0, 0], inverse[:, 1, 1] = forward[:, 1, 1], forward[:, 0, 0]
        inverse[:, 0, 1], inverse[:, 1, 0] = -forward[:, 0, 1], -forward[:, 1, 0]
        return RayBundle(camera, directions, inverse / determinant[:, None, None])

    def select(self, keep: Bool[np.ndarray, " n"]) -> "RayBundle":
        """The rays for which ``keep`` is true."""
        return RayBundle(self.camera, self.directions[keep], self.by_pixel[keep])

    def per_pixel(self, by_xy: Float[np.ndarray, "n 2"], towards: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Change of d when the pixel moves by 1 px in a direction (unit vectors)."""
        return np.einsum("ni,nij,nj->n", by_xy, self.by_pixel, towards)

    def camera_columns(self, by_xy: Float[np.ndarray, "n 2"], names: Sequence[str]) -> Float[np.ndarray, "n p"]:
        """Derivatives of d by the camera's parameters while the pixel stays where it is."""
        camera = self.camera
        u, v = -np.einsum("ni,nij->jn", by_xy, self.by_pixel)
        x, y = self.directions[:, 0], self.directions[:, 1]
        r2 = x * x + y * y
        radial = camera.fx * u * x + camera.fy * v * y
        columns = np.empty((len(x), len(names)))
        for k, name in enumerate(names):
            match name:
                case "fx":
                    xd = camera.distort(self.directions[:, :2])
                    columns[:, k] = u * xd[:, 0]
                case "fy":
                    xd = camera.distort(self.directions[:, :2])
                    columns[:, k] = v * xd[:, 1]
                case "cx":
                    columns[:, k] = u
                case "cy":
                    columns[:, k] = v
                case "k1":
                    columns[:, k] = radial * r2
                case "k2":
                    columns[:, k] = radial * r2**2
                case "k3":
                    columns[:, k] = radial * r2**3
                case "p1":
                    columns[:, k] = camera.fx * u * 2 * x * y + camera.fy * v * (r2 + 2 * y * y)
                case "p2":
                    columns[:, k] = camera.fx * u * (r2 + 2 * x * x) + camera.fy * v * 2 * x * y
                case _:
                    raise ValueError(f"The camera has no parameter {name!r}.")
        return columns
