"""Start values of the camera from homographies alone (Zhang's closed form).

References
----------
.. [1] Zhang, IEEE Trans. PAMI 22 (2000) 1330, section 3.1
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotaline.vision.camera import CameraModel

_SHORTEST, _LONGEST = 0.2, 60.0
"""Focal lengths that a real lens may have, in units of the longer image side."""

_GUESSES = (0.8, 1.5, 3.0, 6.0, 12.0)


def camera_from_homographies(
    homographies: Sequence[Float[np.ndarray, "3 3"]], image_size: tuple[int, int]
) -> CameraModel | None:
    """Focal lengths and principal point without skew, from ``h1 . w h2 = 0`` and ``h1 . w h1 = h2 . w h2`` [1]_.

    ``w`` is the image of the absolute conic. Returns None where the answer is no plausible camera, as happens with few or
    nearly parallel boards: then take :func:`focal_from_homographies`.
    """
    to_unit, size = _to_unit(image_size)
    rows = []
    for homography in homographies:
        h1, h2, _ = (to_unit @ homography).T
        scale = np.linalg.norm(h1) * np.linalg.norm(h2)
        rows.append(_conic_row(h1, h2) / scale)
        rows.append((_conic_row(h1, h1) - _conic_row(h2, h2)) / scale)
    if len(rows) < 4:
        return None
    _, _, vt = np.linalg.svd(np.array(rows))
    b11, b22, b13, b23, b33 = vt[-1] * np.sign(vt[-1][0])
    if not (b11 > 0 and b22 > 0):
        return None
    cx, cy = -b13 / b11, -b23 / b22
    scale = b33 - b11 * cx * cx - b22 * cy * cy
    if not scale > 0:
        return None
    fx, fy = np.sqrt(scale / b11), np.sqrt(scale / b22)
    centred = max(abs(cx), abs(cy)) < 0.35
    sensible = _SHORTEST < fx < _LONGEST and _SHORTEST < fy < _LONGEST and 0.7 < fx / fy < 1.4
    return _camera(image_size, fx * size, fy * size, (cx * size, cy * size)) if centred and sensible else None


def focal_from_homographies(
    homographies: Sequence[Float[np.ndarray, "3 3"]], image_size: tuple[int, int]
) -> CameraModel | None:
    """One focal length, with the principal point in the centre of the image; None where the boards do not give one."""
    to_unit, size = _to_unit(image_size)
    coefficients, constants = [], []
    for homography in homographies:
        h1, h2, _ = (to_unit @ homography).T
        scale = np.linalg.norm(h1) * np.linalg.norm(h2)
        coefficients += [h1[:2] @ h2[:2] / scale, (h1[:2] @ h1[:2] - h2[:2] @ h2[:2]) / scale]
        constants += [-h1[2] * h2[2] / scale, -(h1[2] ** 2 - h2[2] ** 2) / scale]
    a, b = np.array(coefficients), np.array(constants)
    if not a @ a > 0 or not a @ b > 0:
        return None
    focal = 1.0 / np.sqrt(a @ b / (a @ a))  # a / f^2 = b
    return _camera(image_size, focal * size, focal * size, (0.0, 0.0)) if _SHORTEST < focal < _LONGEST else None


def start_cameras(
    homographies: Sequence[Float[np.ndarray, "3 3"]], image_size: tuple[int, int]
) -> tuple[CameraModel, ...]:
    """Cameras to start from, the most trusted first: closed form, single focal length, then plain guesses."""
    found = (camera_from_homographies(homographies, image_size), focal_from_homographies(homographies, image_size))
    guesses = tuple(_camera(image_size, g * max(image_size), g * max(image_size), (0.0, 0.0)) for g in _GUESSES)
    return tuple(camera for camera in found if camera is not None) + guesses


def _conic_row(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "5"]:
    """Coefficients of B11, B22, B13, B23, B33 in ``a . w b`` (B12 = 0: no skew)."""
    return np.array([a[0] * b[0], a[1] * b[1], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1], a[2] * b[2]])


def _to_unit(image_size: tuple[int, int]) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Pixels to coordinates centred in the image with the longer side 1; and that side in px."""
    width, height = image_size
    size = float(max(image_size))
    u0, v0 = (width - 1) / 2, (height - 1) / 2
    return np.array([[1 / size, 0.0, -u0 / size], [0.0, 1 / size, -v0 / size], [0.0, 0.0, 1.0]]), size


def _camera(image_size: tuple[int, int], fx: float, fy: float, centre_offset: tuple[float, float]) -> CameraModel:
    width, height = image_size
    return CameraModel(
        image_size,
        float(fx),
        float(fy),
        float((width - 1) / 2 + centre_offset[0]),
        float((height - 1) / 2 + centre_offset[1]),
    )
