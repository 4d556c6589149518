"""What ideal detectors would return: target points and stripe centres with known noise, without any image.

For tests of estimators and for planning poses: a thousand views take a second.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Plane
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import Target, TargetDetection

_MAX_TRIES = 200


def random_board_poses(
    camera: CameraModel,
    target: Target,
    n: int,
    rng: np.random.Generator,
    *,
    distance_mm: tuple[float, float] = (250.0, 380.0),
    tilt_deg: tuple[float, float] = (10.0, 35.0),
    spread: float = 0.25,
) -> list[RigidTransform]:
    """Poses ``camera_from_board`` in which the whole target is in the image.

    Parameters
    ----------
    camera, target : what sees what
    n : number of poses
    rng : random numbers
    distance_mm : least and greatest depth of the target's centre
    tilt_deg : least and greatest angle between the target and the image plane; any roll
    spread : the target's centre lies within this part of the image's size from the middle, each way

    Raises
    ------
    ValueError
        If the target hardly ever fits into the image.
    """
    points = target.points_board()
    centre = points.mean(axis=0)
    size = np.array(camera.image_size, dtype=float)
    poses: list[RigidTransform] = []
    for _ in range(_MAX_TRIES * n):
        if len(poses) == n:
            break
        azimuth, roll = rng.uniform(-np.pi, np.pi, 2)
        tilt = np.deg2rad(rng.uniform(*tilt_deg))
        rotation = Rotation.from_rotvec([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]) * Rotation.from_rotvec(
            [0.0, 0.0, roll]
        )
        middle = camera.rays((size * (0.5 + spread * rng.uniform(-1.0, 1.0, 2)))[None])[0] * rng.uniform(*distance_mm)
        pose = RigidTransform.from_components(middle - rotation.apply(centre), rotation)
        uv = camera.project(pose.apply(points))
        if np.all((uv >= 0) & (uv <= size - 1)):
            poses.append(pose)
    if len(poses) < n:
        raise ValueError(
            f"The target fits into the image in {len(poses)} of {_MAX_TRIES * n} tries; {n} poses are needed."
        )
    return poses


def observe_target(
    camera: CameraModel, camera_from_board: RigidTransform, target: Target, sigma_px: float, rng: np.random.Generator
) -> TargetDetection:
    """All points of a target that are in the image, with Gaussian noise of ``sigma_px`` a coordinate."""
    uv = camera.project(camera_from_board.apply(target.points_board()))
    seen = np.all((uv >= 0) & (uv <= np.array(camera.image_size) - 1), axis=1)
    ids = np.flatnonzero(seen)
    return TargetDetection(target, ids, uv[ids] + sigma_px * rng.standard_normal((len(ids), 2)), sigma_px)


def observe_stripe(
    camera: CameraModel,
    laser_plane_camera: Plane,
    camera_from_board: RigidTransform,
    target: Target,
    sigma_px: float,
    rng: np.random.Generator,
    *,
    width_px: float = 2.0,
    spacing_px: float = 1.0,
) -> StripePoints:
    """Stripe centres where the laser plane cuts the printed area of a target, half a pitch beyond its outer points.

    The noise is across the stripe. There are no points (an empty stripe) where the plane misses the target.
    """
    columns, rows = target.grid_size
    upper = np.array([columns - 1, rows - 1]) * target.pitch
    normal = camera_from_board.rotation.inv().apply(laser_plane_camera.normal)
    offset = laser_plane_camera.offset + float(laser_plane_camera.normal @ camera_from_board.translation)
    slope = float(np.hypot(normal[0], normal[1]))
    direction = np.array([-normal[1], normal[0]]) / slope
    foot = -offset * normal[:2] / slope**2
    middle = foot + ((upper / 2 - foot) @ direction) * direction
    length = float(np.linalg.norm(upper)) + 2 * target.pitch
    depth = float(camera_from_board.apply(np.append(upper / 2, 0.0))[2])
    along = np.arange(-length, length, spacing_px * depth / camera.fx)
    xy = middle + along[:, None] * direction
    xy = xy[np.all((xy > -target.pitch / 2) & (xy < upper + target.pitch / 2), axis=1)]
    if len(xy) < 2:
        return _stripe(np.empty((0, 2)), np.empty((0, 2)), width_px, sigma_px)
    uv = camera.project(camera_from_board.apply(np.column_stack([xy, np.zeros(len(xy))])))
    tangent = np.gradient(uv, axis=0)
    tangent = tangent / np.linalg.norm(tangent, axis=1)[:, None]
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    noisy = uv + sigma_px * rng.standard_normal(len(uv))[:, None] * across
    seen = np.all((noisy >= 0) & (noisy <= np.array(camera.image_size) - 1), axis=1)
    return _stripe(noisy[seen], across[seen], width_px, sigma_px)


def _stripe(
    uv: Float[np.ndarray, "n 2"], normal: Float[np.ndarray, "n 2"], width_px: float, sigma_px: float
) -> StripePoints:
    n = len(uv)
    return StripePoints(
        uv,
        normal,
        np.full(n, width_px),
        np.full(n, 150.0),
        np.full(n, sigma_px),
        np.zeros(n, dtype=bool),
        np.zeros(n, dtype=int),
    )
