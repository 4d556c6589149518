"""A small camera and pictures of targets in front of it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.targets import pixel_rays, render_target
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Target


@dataclass(frozen=True, eq=False)
class Scene:
    """A picture and where the target's points are in it."""

    image: np.ndarray
    uv: np.ndarray


@pytest.fixture(scope="session")
def camera() -> CameraModel:
    return CameraModel((640, 480), 900.0, 905.0, 322.0, 238.0, k1=-0.15, k2=0.05, p1=5e-4, p2=-5e-4)


@pytest.fixture(scope="session")
def photograph(camera: CameraModel) -> Callable[..., Scene]:
    """Take a picture: target, roll, tilt, size of the target in the picture, position, noise, grey values."""
    rays = pixel_rays(camera)

    def take(
        target: Target,
        *,
        roll_deg: float = 0.0,
        tilt_deg: tuple[float, float] = (20.0, -25.0),
        fill: float = 0.7,
        shift: tuple[float, float] = (0.0, 0.0),
        noise: float = 1.5,
        white: float = 180.0,
        black: float = 20.0,
        background: float | np.ndarray = 60.0,
        seed: int = 0,
    ) -> Scene:
        points = target.points_board()
        middle = points.mean(axis=0)
        rotation = Rotation.from_euler("zyx", [roll_deg, *tilt_deg], degrees=True)
        extent = float(np.linalg.norm(np.ptp(points, axis=0))) + 2 * target.pitch
        distance = extent * camera.fy / (fill * camera.image_size[1])
        at = np.array([*shift, 1.0]) * distance
        pose = RigidTransform.from_components(at - rotation.apply(middle), rotation)
        picture = render_target(camera, pose, target, rays=rays, blur_px=0.6, samples=2, white=white, black=black)
        noisy = picture.over(background) + np.random.default_rng(seed).normal(0.0, noise, picture.grey.shape)
        return Scene(np.clip(np.round(noisy), 0, 255).astype(np.uint8), camera.project(pose.apply(points)))

    return take
