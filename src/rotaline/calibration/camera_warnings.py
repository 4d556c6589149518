"""What makes a camera calibration doubtful, in words: weak parameters, poor tilt, poor coverage, few views."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from rotaline.calibration.model import CameraView
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Target

_FOCAL_LIMIT = 0.01
_CENTRE_LIMIT = 0.02
_CORNER_LIMIT = 0.004
_MANY_VIEWS = 8
_MIN_TILT_DEG = 12.0
_MIN_SPREAD_DEG = 20.0
_MIN_COVERAGE = 0.5


def describe_weak_parameters(camera: CameraModel, names: Sequence[str], cov: Float[np.ndarray, "p p"]) -> list[str]:
    """Parameters that the views hardly determine, with their standard uncertainties.

    Limits: 1 % of the focal length; 2 % of the image's diagonal for the principal point; 0.4 % of the diagonal for what
    the distortion does at the corner of the image.
    """
    u = dict(zip(names, np.sqrt(np.diag(cov)), strict=True))
    diagonal = float(np.hypot(*camera.image_size))
    weak = []
    u_focal = max(u["fx"] / camera.fx, u["fy"] / camera.fy)
    if not u_focal < _FOCAL_LIMIT:
        weak.append(f"focal length {camera.fx:.0f} px to {100 * u_focal:.1f} %")
    u_centre = max(u["cx"], u["cy"])
    if not u_centre < _CENTRE_LIMIT * diagonal:
        weak.append(f"principal point to {u_centre:.0f} px")
    u_corner = corner_uncertainty_px(camera, names, cov)
    if not u_corner < _CORNER_LIMIT * diagonal:
        weak.append(f"distortion at the corners of the image to {u_corner:.1f} px")
    return weak


def corner_uncertainty_px(camera: CameraModel, names: Sequence[str], cov: Float[np.ndarray, "p p"]) -> float:
    """Standard uncertainty of the distortion at the corner of the image, px."""
    terms = [k for k, name in enumerate(names) if name in ("k1", "k2", "p1", "p2", "k3")]
    if not terms:
        return 0.0
    width, height = camera.image_size
    x, y = width / 2 / camera.fx, height / 2 / camera.fy
    r2 = x * x + y * y
    by = {
        "k1": (x * r2, y * r2),
        "k2": (x * r2**2, y * r2**2),
        "k3": (x * r2**3, y * r2**3),
        "p1": (2 * x * y, r2 + 2 * y * y),
        "p2": (r2 + 2 * x * x, 2 * x * y),
    }
    jacobian = np.array([by[names[k]] for k in terms]).T * np.array([[camera.fx], [camera.fy]])
    spread = jacobian @ cov[np.ix_(terms, terms)] @ jacobian.T
    return float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))


def describe_bent_targets(targets: Sequence[Target]) -> list[str]:
    """Targets that are not flat, by how much."""
    warnings = []
    for target in targets:
        heights = target.points_board()[:, 2]
        if not heights.any():
            continue
        columns, rows = target.grid_size
        warnings.append(
            f"The target of {columns} x {rows} points is not flat: its points lie up to {np.ptp(heights):.3f} mm apart in height. "
            "This is taken into account; a flat, stiff target (glass, aluminium) gives a better camera."
        )
    return warnings


def describe_offsets(
    targets: Sequence[Target], views: Sequence[CameraView], camera: CameraModel, sigma_px: float
) -> list[str]:
    """Targets whose points are off their places by more than the noise of a point in the image."""
    depths = [float(view.camera_from_board.translation[2]) for view in views if view.used]
    px_per_mm = camera.fx / float(np.median(depths))
    warnings = []
    for target in targets:
        off_mm = float(np.sqrt(np.mean(np.square(target.offsets)))) if target.offsets else 0.0
        if off_mm * px_per_mm > sigma_px:
            columns, rows = target.grid_size
            warnings.append(
                f"The points of the target of {columns} x {rows} points are off their places by {off_mm:.3f} mm (RMS in x and in y). "
                "This is taken into account; only the size of the print as a whole cannot be seen by the camera: measure it."
            )
    return warnings


def describe_weak_views(camera: CameraModel, views: Sequence[CameraView]) -> list[str]:
    """Few views, little tilt, poor coverage of the image."""
    warnings = []
    if len(views) < _MANY_VIEWS:
        warnings.append(
            f"Only {len(views)} views of the target: 10 to 20 in different poses make the camera trustworthy."
        )
    normals = np.array([view.camera_from_board.rotation.apply([0.0, 0.0, 1.0]) for view in views])
    normals = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    tilt = np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1)))
    spread = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    if tilt.max() < _MIN_TILT_DEG:
        warnings.append(
            f"Poor tilt: no board is turned by more than {tilt.max():.0f} deg from the image plane, so the focal length trades "
            "against the distance. Add views turned by 20 to 45 deg about different axes."
        )
    elif spread < _MIN_SPREAD_DEG:
        warnings.append(
            f"Poor tilt: all boards are parallel to within {spread:.0f} deg. Add views turned by 20 to 45 deg about different axes."
        )
    coverage = image_coverage(camera, views)
    if coverage < _MIN_COVERAGE:
        warnings.append(
            f"Poor coverage: the points span {100 * coverage:.0f} % of the image; outside, the distortion is a guess. Add views "
            "with the target near the borders and corners."
        )
    return warnings


def image_coverage(camera: CameraModel, views: Sequence[CameraView]) -> float:
    """Part of the image inside the convex hull of all points used."""
    uv = np.concatenate([view.uv[np.isfinite(view.residuals_px).all(axis=1)] for view in views])
    return float(ConvexHull(uv).volume / (camera.image_size[0] * camera.image_size[1]))
