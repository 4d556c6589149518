"""Point clouds as a rotary line scan gives them, from ideal solids: truth for the measurement of features.

A fan of laser rays in one plane meets the solids; what the camera sees from its place becomes a point. The table turns
between the frames. The cloud is dense along the stripe, uneven across it, has shadows, rounded edges, points between a near
and a far surface, noise along the camera's ray, and stray points. No image is rendered.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere in the table frame, mm."""

    centre: Float[np.ndarray, "3"]
    radius: float

    def first_hit(self, origins: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance along each unit ray to the surface: infinite where it misses, 0 where it starts inside."""
        relative = origins - self.centre
        along = np.einsum("ij,ij->i", relative, rays)
        root = along**2 - np.einsum("ij,ij->i", relative, relative) + self.radius**2
        width = np.sqrt(np.maximum(root, 0.0))
        return np.where((root > 0) & (width > along), np.maximum(-along - width, 0.0), np.inf)


@dataclass(frozen=True, eq=False)
class Prism:
    """A convex solid: an upright cylinder (``radius``), cut or not by half spaces ``normals . X <= offsets``.

    ``table_from_part`` places it; without a radius the half spaces alone bound it.
    """

    normals: Float[np.ndarray, "k 3"]
    offsets: Float[np.ndarray, " k"]
    radius: float = np.inf
    table_from_part: RigidTransform = field(default_factory=RigidTransform.identity)

    def first_hit(self, origins: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance along each unit ray to the surface: infinite where it misses, 0 where it starts inside."""
        o = self.table_from_part.inv().apply(origins)
        r = self.table_from_part.rotation.inv().apply(rays)
        towards = r @ self.normals.T
        gap = self.offsets - o @ self.normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = gap / towards
        entry = np.max(np.where(towards < 0, at, -np.inf), axis=1)
        leave = np.min(np.where(towards > 0, at, np.inf), axis=1)
        outside = np.any((towards == 0) & (gap < 0), axis=1)
        if np.isfinite(self.radius):
            a = r[:, 0] ** 2 + r[:, 1] ** 2
            b = o[:, 0] * r[:, 0] + o[:, 1] * r[:, 1]
            root = b**2 - a * (o[:, 0] ** 2 + o[:, 1] ** 2 - self.radius**2)
            with np.errstate(divide="ignore", invalid="ignore"):
                width = np.sqrt(np.maximum(root, 0.0))
                entry = np.maximum(entry, (-b - width) / a)
                leave = np.minimum(leave, (-b + width) / a)
            outside |= root <= 0
        return np.where(~outside & (entry < leave) & (leave > 0), np.maximum(entry, 0.0), np.inf)


Solid = Ball | Prism


def upright_cylinder(radius: float, bottom: float, top: float, table_from_part: RigidTransform | None = None) -> Prism:
    """A cylinder along z from ``bottom`` to ``top``, mm."""
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    pose = RigidTransform.identity() if table_from_part is None else table_from_part
    return Prism(normals, np.array([top, -bottom]), radius, pose)


def box(low: Sequence[float], high: Sequence[float], table_from_part: RigidTransform | None = None) -> Prism:
    """A box between two corners, mm."""
    pose = RigidTransform.identity() if table_from_part is None else table_from_part
    offsets = np.concatenate([np.asarray(high, dtype=float), -np.asarray(low, dtype=float)])
    return Prism(np.vstack([np.eye(3), -np.eye(3)]), offsets, table_from_part=pose)


def table_top(radius: float = 60.0, z: float = 0.0) -> Prism:
    """The table: a disc of 10 mm thickness with its upper side at z, mm."""
    return upright_cylinder(radius, z - 10.0, z)


def grooved_block(
    size: tuple[float, float, float],
    depth: float,
    width_top: float,
    width_bottom: float,
    table_from_part: RigidTransform | None = None,
) -> tuple[Solid, ...]:
    """A block (x, y, z sizes, standing on z = 0) with a trapezoidal groove along y in its top, mm."""
    x, y, z = (float(s) for s in size)
    pose = RigidTransform.identity() if table_from_part is None else table_from_part
    base = box((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z - depth), pose)
    slope = np.array([(width_top - width_bottom) / 2, depth])
    solids: list[Solid] = [base]
    for side in (1.0, -1.0):
        # The wall's flank passes through (width_bottom / 2, z - depth) and (width_top / 2, z).
        inward = np.array([-side * slope[1], 0.0, slope[0]]) / np.hypot(*slope)
        foot = np.array([side * width_bottom / 2, 0.0, z - depth])
        normals = np.vstack([np.eye(3), -np.eye(3), inward])
        high = np.array([x / 2, y / 2, z]) if side > 0 else np.array([-width_bottom / 2, y / 2, z])
        low = np.array([width_bottom / 2, -y / 2, 0.0]) if side > 0 else np.array([-x / 2, -y / 2, 0.0])
        solids.append(Prism(normals, np.concatenate([high, -low, [inward @ foot]]), table_from_part=pose))
    return tuple(solids)


@dataclass(frozen=True)
class ScanPlan:
    """How the solids are scanned; lengths in mm, angles in deg."""

    step_deg: float = 4.0
    turn_deg: float = 360.0
    n_rays: int = 600
    laser: tuple[float, float, float] = (60.0, -150.0, 170.0)
    camera: tuple[float, float, float] = (150.0, -110.0, 190.0)
    aim_height: float = 20.0
    fan_deg: float = 28.0
    noise_mm: float = 0.005
    blur_rays: int = 3
    stray_fraction: float = 0.002


@dataclass(frozen=True, eq=False)
class ScannedPoints:
    """Points and viewpoints in the table frame, mm."""

    points_table: Float[np.ndarray, "n 3"]
    viewpoints_table: Float[np.ndarray, "n 3"]


def scan_solids(solids: Sequence[Solid], plan: ScanPlan, rng: np.random.Generator) -> ScannedPoints:
    """Scan solids that stand on a turntable (z: rotation axis).

    The laser plane holds the laser and the z axis; the fan is centred on the axis at ``aim_height``.
    """
    laser, camera = np.asarray(plan.laser), np.asarray(plan.camera)
    middle = np.array([0.0, 0.0, plan.aim_height]) - laser
    middle /= np.linalg.norm(middle)
    sideways = np.cross(np.cross(laser, [0.0, 0.0, 1.0]), middle)
    sideways /= np.linalg.norm(sideways)
    fan = np.deg2rad(np.linspace(-plan.fan_deg, plan.fan_deg, plan.n_rays))
    rays_base = np.cos(fan)[:, None] * middle + np.sin(fan)[:, None] * sideways
    clouds, eyes = [], []
    for angle in np.deg2rad(np.arange(0.0, plan.turn_deg, plan.step_deg)):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        eye = turn @ camera
        hits, seen = _sweep(solids, turn @ laser, rays_base @ turn.T, eye)
        points = _blur(hits, plan.blur_rays, rng)[seen]
        points = points[plan.blur_rays : len(points) - plan.blur_rays]
        rays = points - eye
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        clouds.append(points + rng.normal(0.0, plan.noise_mm, len(points))[:, None] * rays)
        eyes.append(np.broadcast_to(eye, points.shape))
    cloud, viewpoints = np.vstack(clouds), np.vstack(eyes)
    stray = rng.random(len(cloud)) < plan.stray_fraction
    cloud[stray] += rng.normal(0.0, 3.0, (int(stray.sum()), 3))
    return ScannedPoints(cloud, viewpoints)


def _blur(hits: np.ndarray, n_rays: int, rng: np.random.Generator) -> np.ndarray:
    """Round the edges by a running mean; beside a jump, put points anywhere between the near and the far surface."""
    if n_rays == 1:
        return hits
    kernel = np.ones(n_rays) / n_rays
    smooth = np.column_stack([np.convolve(column, kernel, mode="same") for column in hits.T])
    gap = np.linalg.norm(np.diff(hits, axis=0), axis=1)
    usual = np.median(gap[np.isfinite(gap)]) if np.isfinite(gap).any() else 0.0
    jump = np.append(np.nan_to_num(gap) > 5.0 * usual, False)
    beside = np.convolve(jump, np.ones(2 * (n_rays // 2) + 1), mode="same") > 0
    smooth[beside] = hits[beside]
    at = np.flatnonzero(jump)
    smooth[at] += rng.random(len(at))[:, None] * (hits[at + 1] - hits[at])
    return smooth


def _sweep(
    solids: Sequence[Solid], laser: np.ndarray, rays: np.ndarray, eye: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where a fan of laser rays ends, and which of these ends the camera sees."""
    origins = np.broadcast_to(laser, rays.shape)
    distance = np.min([solid.first_hit(origins, rays) for solid in solids], axis=0)
    seen = np.isfinite(distance)
    hits = laser + np.where(seen, distance, 0.0)[:, None] * rays
    to_eye = eye - hits
    length = np.linalg.norm(to_eye, axis=1)
    to_eye /= length[:, None]
    starts = hits + 1e-6 * to_eye
    for solid in solids:
        seen &= ~(solid.first_hit(starts, to_eye) < length)
    # Blurring must not mix in rays that met nothing.
    hits[~np.isfinite(distance)] = np.nan
    return hits, seen & np.all(np.isfinite(np.roll(hits, 1, axis=0) + hits + np.roll(hits, -1, axis=0)), axis=1)
