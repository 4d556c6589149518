"""Scans of a part of known shape as a rotary line scan gives them, of any number of points, without images."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.scanning.cloud import PointCloud
from rotaline.simulation.ideal.stripe_trace import sheet_rays
from rotaline.simulation.imaging.raycast import Placed, PosedPart, View
from rotaline.simulation.parts.mesh import MeshPart
from rotaline.simulation.rig import Rig, build_rig

NOISE_MM = 0.005
_SEEN = 0.44
"""Part of the rays of the fan that end on the bust where the camera sees it."""


def scan_part(part: MeshPart, n_points: int, seed: int = 0) -> PointCloud:
    """About ``n_points`` points of a part that stands in the middle of the table of the article's rig.

    Profiles are as far apart as points along them, on the average; noise lies along the camera's rays. A laser ray gives a point where
    it first meets the part and the camera sees that place.
    """
    rig, rng = build_rig((1280, 960)), np.random.default_rng(seed)
    n_turns = max(int(np.sqrt(n_points / _SEEN)), 90)
    n_rays = int(n_points / _SEEN / n_turns)
    half = np.radians(12.0)
    xy = sheet_rays(rig.laser, np.linspace(-half, half, n_rays))
    columns: list[tuple[np.ndarray, np.ndarray, float]] = []
    for angle in np.linspace(0.0, 2 * np.pi, n_turns, endpoint=False):
        points, eye = _profile(rig, part, angle, xy)
        rays = points - eye
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        columns.append((points + rng.normal(0.0, NOISE_MM, (len(points), 1)) * rays, eye, angle))
    sizes = [len(points) for points, _, _ in columns]
    n = sum(sizes)
    return PointCloud(
        np.concatenate([points for points, _, _ in columns]),
        np.repeat([eye for _, eye, _ in columns], sizes, axis=0),
        np.full(n, 150.0),
        np.repeat([angle for _, _, angle in columns], sizes),
        np.repeat(np.arange(len(columns)), sizes),
        np.full(n, NOISE_MM),
        np.full(n, np.nan),
    )


def _profile(rig: Rig, part: MeshPart, angle: float, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lit and seen points with the table turned by an angle, and the place of the camera, in the table frame."""
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, angle]))
    posed = (PosedPart.of(Placed(part, turn)),)
    normal, beam = rig.laser.plane_base.normal, rig.laser.beam_base
    start = np.asarray(rig.laser.position_base, dtype=float)
    laser = View.of(posed, start, np.stack([np.cross(normal, beam), normal, beam], axis=1))
    base_from_camera = rig.camera_from_base.inv()
    eye = np.asarray(base_from_camera.translation)
    camera = View.of(posed, eye, base_from_camera.rotation.as_matrix())
    t = laser.hits(xy).t
    lit = np.isfinite(t)
    points = start + t[lit, None] * laser.directions_base(xy[lit])
    depth = (points - eye) @ camera.base_from_view
    seen = camera.hits(depth[:, :2] / depth[:, 2:]).t > depth[:, 2] * (1.0 - 1e-6)
    back = turn.inv()
    return back.apply(points[seen]), back.apply(eye[None])[0]
