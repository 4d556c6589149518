"""What real lenses look like: to lean on where the views of a camera calibration leave parameters open."""

import numpy as np

from rotaline.calibration.reprojection import Prior
from rotaline.vision.camera import CameraModel


def lens_prior(names: tuple[str, ...], image_size: tuple[int, int], camera: CameraModel, sigma_px: float) -> Prior:
    """What real cameras look like, as observations of the named parameters.

    The principal point lies within 8 % of the diagonal of the centre, pixels are square to 0.5 %, each radial term moves the
    corner of the image by some 20 % of its distance from the centre, each tangential term by 0.5 % (standard uncertainties).

    Parameters
    ----------
    names : parameters that are estimated
    image_size : (width, height) px
    camera : CameraModel   for its focal length
    sigma_px : standard deviation of an image coordinate, to which the observations are scaled
    """
    width, height = image_size
    diagonal = float(np.hypot(width, height))
    corner = diagonal / 2 / np.sqrt(camera.fx * camera.fy)
    expected = {"cx": ((width - 1) / 2, 0.08 * diagonal), "cy": ((height - 1) / 2, 0.08 * diagonal)}
    expected |= {name: (0.0, 0.2 / corner ** (2 * power)) for name, power in (("k1", 1), ("k2", 2), ("k3", 3))}
    expected |= dict.fromkeys(("p1", "p2"), (0.0, 0.005 / corner))
    rows, values = [], []
    for k, name in enumerate(names):
        if name in expected:
            value, u = expected[name]
            row = np.zeros(len(names))
            row[k] = sigma_px / u
            rows.append(row)
            values.append(value * sigma_px / u)
    ratio = np.zeros(len(names))
    ratio[[0, 1]] = np.array([1.0, -1.0]) * sigma_px / (0.005 * np.sqrt(camera.fx * camera.fy))
    return Prior(np.array([*rows, ratio]), np.array([*values, 0.0]))


def without_distortion(camera: CameraModel, image_size: tuple[int, int]) -> CameraModel:
    """The camera with a central principal point and no distortion: a start for the regularised estimate."""
    focal = float(np.sqrt(camera.fx * camera.fy))
    return CameraModel(image_size, focal, focal, (image_size[0] - 1) / 2, (image_size[1] - 1) / 2)
