"""Rendering one frame by ray casting.

A first ray through the middle of every pixel finds what it sees. Only pixels where that matters, at edges and near the
laser sheet, are then split into sub-pixel rays, whose mean is the light that falls on the pixel. Laser light reaches a
point if the ray from the laser to it meets nothing before: shadows of the laser and surfaces hidden from the camera come
out by themselves.

The light of a surface point, in electrons a millisecond: ambient ``ambient * albedo * (0.55 + 0.45 |cos to the viewer|)``, laser
``peak * albedo * cos(incidence) * exp(-d^2 / (2 sigma^2))`` with ``d`` the distance of the point from the laser plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from scipy.spatial.transform import RigidTransform

from rotaline.simulation.rig import Laser, Rig, Sensor
from rotaline.simulation.shapes import Shape
from rotaline.simulation.surface import dot_rows
from rotaline.vision.camera import CameraModel

_EDGE_LATTICE, _STRIPE_LATTICE = (34, 21), (21, 13)
"""Sub-pixel rays of a pixel at an edge, and in a laser-on frame, where the profile is smooth; with Fibonacci numbers the
second one spreads them best."""

_CHUNK_RAYS = 20_000
_SHEET_HALF_WIDTH = 4.0
"""Half width of the sheet, in sigmas, beyond which there is no laser light."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A shape and where it is: ``frame_from_part``, with ``frame`` the table or the base."""

    shape: Shape
    frame_from_part: RigidTransform

    def moved(self, outer_from_frame: RigidTransform) -> "Placed":
        """The same shape, seen from another frame."""
        return Placed(self.shape, outer_from_frame * self.frame_from_part)


@dataclass(frozen=True, eq=False)
class _Posed:
    """A placed shape with its pose as plain arrays: a pose object costs more than the few thousand rays of a chunk."""

    shape: Shape
    base_from_part: Float[np.ndarray, "3 3"]
    origin_base: Float[np.ndarray, "3"]

    @staticmethod
    def of(part: Placed) -> "_Posed":
        pose = part.frame_from_part
        return _Posed(part.shape, pose.rotation.as_matrix(), np.asarray(pose.translation))

    def to_part(self, points_base: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return np.asarray((points_base - self.origin_base) @ self.base_from_part)


@dataclass(frozen=True, eq=False)
class _Hits:
    """Light of rays: ambient per unit level, laser per unit peak; signed distance from the laser plane, nan if nothing is hit."""

    ambient: Float[np.ndarray, " n"]
    laser: Float[np.ndarray, " n"]
    distance_mm: Float[np.ndarray, " n"]


def subpixel_offsets(n: int, step: int) -> Float[np.ndarray, "n 2"]:
    """Positions of sub-pixel rays in a pixel, -0.5 to 0.5: a lattice with n offsets along u and along v."""
    i = np.arange(n)
    return np.stack([(i + 0.5) / n, ((i * step) % n + 0.5) / n], axis=1) - 0.5


@lru_cache(maxsize=4)
def _pixel_xy(camera: CameraModel) -> Float[np.ndarray, "n 2"]:
    """Ideal normalised coordinates of the middle of every pixel, row by row."""
    width, height = camera.image_size
    v, u = np.mgrid[0:height, 0:width]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    return np.ascontiguousarray(camera.rays(uv)[:, :2])


def _subpixel_xy(
    camera: CameraModel, xy: Float[np.ndarray, "n 2"], offsets: Float[np.ndarray, "s 2"]
) -> Float[np.ndarray, "n s 2"]:
    """Ideal coordinates of points ``offsets`` px away from pixels: the distortion is linear within a pixel."""
    slope = np.linalg.inv(camera.distort_jacobian(xy))
    return np.asarray(xy[:, None, :] + (slope @ (offsets / (camera.fx, camera.fy)).T).transpose(0, 2, 1))


def _nearest(
    parts: Sequence[_Posed], origin_base: Float[np.ndarray, "3"], directions_base: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Distance along each ray (inf: nothing), index of the part (-1: nothing) and of its face."""
    n = len(directions_base)
    t, index, faces = np.full(n, np.inf), np.full(n, -1), np.zeros(n, int)
    for i, part in enumerate(parts):
        t_part, faces_part = part.shape.intersect(
            part.to_part(origin_base[None])[0], directions_base @ part.base_from_part
        )
        nearer = t_part < t
        t, index, faces = (
            np.where(nearer, t_part, t),
            np.where(nearer, i, index),
            np.where(nearer, faces_part, faces),
        )
    return t, index, faces


def _lit(parts: Sequence[_Posed], laser: Laser, points_base: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether the laser reaches points of the surface: nothing stands before them."""
    t, _, _ = _nearest(parts, laser.position_base, points_base - laser.position_base)
    return np.asarray(t > 1.0 - 1e-6)


def _cast(
    rig: Rig,
    parts: Sequence[_Posed],
    origin_base: Float[np.ndarray, "3"],
    directions_base: Float[np.ndarray, "n 3"],
    laser_on: bool,
) -> _Hits:
    """Light along rays; without ``laser_on`` the laser's light is not worked out."""
    t, index, faces = _nearest(parts, origin_base, directions_base)
    n = len(t)
    ambient, laser, distance = np.zeros(n), np.zeros(n), np.full(n, np.nan)
    for i, part in enumerate(parts):
        (seen,) = np.nonzero(index == i)
        if not len(seen):
            continue
        directions = directions_base[seen]
        points_base = origin_base + t[seen, None] * directions
        points = part.to_part(points_base)
        normals = part.shape.normals(points, faces[seen]) @ part.base_from_part.T
        albedo = part.shape.albedo(points, faces[seen])
        facing = np.abs(dot_rows(directions, normals)) / np.sqrt(dot_rows(directions, directions))
        ambient[seen] = albedo * (0.55 + 0.45 * facing)
        d = rig.laser.plane_base.signed_distance_to(points_base)
        distance[seen] = d
        if not laser_on:
            continue
        to_laser = rig.laser.position_base - points_base
        cos = dot_rows(to_laser, normals) / np.sqrt(dot_rows(to_laser, to_laser))
        near = (np.abs(d) < _SHEET_HALF_WIDTH * rig.laser.sigma_mm) & (cos > 0)
        near[near] = _lit(parts, rig.laser, points_base[near])
        profile = np.exp(-0.5 * (d[near] / rig.laser.sigma_mm) ** 2)
        laser[seen[near]] = albedo[near] * cos[near] * profile
    return _Hits(ambient, laser, distance)


def _range3x3(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Largest less smallest value among a pixel and its neighbours."""
    values = image.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(values, kernel) - cv2.erode(values, kernel), dtype=float)


def _to_split(rig: Rig, first: _Hits, shape: tuple[int, int], laser_on: bool) -> Bool[np.ndarray, " n"]:
    """Pixels that one ray does not describe: edges in ambient light, and the laser sheet."""
    split = _range3x3(first.ambient.reshape(shape)) > 0.003
    if laser_on:
        # far away where nothing is seen: the stripe ends there
        d = np.where(np.isnan(first.distance_mm), 1e3, first.distance_mm).reshape(shape)
        near = np.abs(d) < _SHEET_HALF_WIDTH * rig.laser.sigma_mm
        crossed = _range3x3(np.sign(d)) > 0.5
        split |= cv2.dilate((near | crossed).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.asarray(split.ravel())


def render_irradiance(
    rig: Rig, parts_base: Sequence[Placed], *, laser_on: bool, ambient_e_per_ms: float
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """What an ideal sensor would see: electrons a millisecond of the ambient light and of the laser, without noise and blur.

    Parameters
    ----------
    rig : Rig
    parts_base : what stands there, in the base frame
    laser_on : False leaves the laser image black
    ambient_e_per_ms : light of a white surface that faces the camera

    Returns
    -------
    ambient, laser : (h, w)   electrons a millisecond
    """
    camera = rig.camera
    width, height = camera.image_size
    base_from_camera = rig.camera_from_base.inv()
    rotation, origin = base_from_camera.rotation.as_matrix(), np.asarray(base_from_camera.translation)
    xy = _pixel_xy(camera)
    posed = [_Posed.of(part) for part in parts_base]

    def directions(xy_any: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        return np.asarray(xy_any @ rotation[:, :2].T + rotation[:, 2])

    first = [
        _cast(rig, posed, origin, directions(xy[i : i + _CHUNK_RAYS]), False) for i in range(0, len(xy), _CHUNK_RAYS)
    ]
    whole = _Hits(*(np.concatenate([getattr(h, name) for h in first]) for name in ("ambient", "laser", "distance_mm")))
    ambient, laser = whole.ambient, whole.laser

    (split,) = np.nonzero(_to_split(rig, whole, (height, width), laser_on))
    offsets = subpixel_offsets(*(_STRIPE_LATTICE if laser_on else _EDGE_LATTICE))
    step = max(_CHUNK_RAYS // len(offsets), 1)
    for i in range(0, len(split), step):
        pixels = split[i : i + step]
        fine = _cast(rig, posed, origin, directions(_subpixel_xy(camera, xy[pixels], offsets).reshape(-1, 2)), laser_on)
        ambient[pixels] = fine.ambient.reshape(len(pixels), -1).mean(axis=1)
        laser[pixels] = fine.laser.reshape(len(pixels), -1).mean(axis=1)
    return ambient.reshape(height, width) * ambient_e_per_ms, laser.reshape(height, width) * rig.laser.peak_e_per_ms


def _blurred(image: Float[np.ndarray, "h w"], sigma_px: float) -> Float[np.ndarray, "h w"]:
    if sigma_px <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE))


_SPECKLE_GRAIN_PX = 0.7


def _speckle(laser: Laser, shape: tuple[int, int], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Factor of the laser's light at each pixel: mean 1, standard deviation ``speckle_contrast``, never negative."""
    grain = _blurred(rng.standard_normal(shape), _SPECKLE_GRAIN_PX) * 2.0 * np.sqrt(np.pi) * _SPECKLE_GRAIN_PX
    return np.asarray(np.maximum(1.0 + (laser.speckle_contrast or 0.0) * grain, 0.0))


def expose(
    signal_e: Float[np.ndarray, "h w"] | Float[np.ndarray, "h w 3"], sensor: Sensor, rng: np.random.Generator
) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]:
    """Grey values of a sensor with so many photo-electrons: shot noise, read noise, black level, rounding, clipping."""
    variance = sensor.read_noise_e**2 + np.maximum(signal_e, 0.0)
    noise = rng.standard_normal(signal_e.shape, dtype=np.float32) * np.sqrt(variance)
    full = 255 if sensor.bit_depth == 8 else 65535
    dn = ((signal_e + noise) / sensor.electrons_per_dn + sensor.black_level_dn) * (full / 255)
    return np.clip(np.round(dn), 0, full).astype(np.uint8 if sensor.bit_depth == 8 else np.uint16)


def render_frame(
    rig: Rig,
    parts_base: Sequence[Placed],
    *,
    laser_on: bool,
    ambient_e_per_ms: float,
    exposure_ms: float,
    seed: int | Sequence[int],
) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]:
    """One image of parts in the base frame.

    Parameters
    ----------
    rig, parts_base, laser_on, ambient_e_per_ms : see :func:`render_irradiance`
    exposure_ms : exposure
    seed : int or several   the same seed gives the same image

    Returns
    -------
    (h, w) or (h, w, 3) red, green, blue; uint8 or uint16
    """
    rng = np.random.default_rng(seed)
    ambient, laser = render_irradiance(rig, parts_base, laser_on=laser_on, ambient_e_per_ms=ambient_e_per_ms)
    signal = _blurred(ambient, rig.optics.blur_px)
    if rig.sensor.colour:
        signal = np.repeat(signal[:, :, None], 3, axis=2)
    if laser_on:
        light = _blurred(laser, rig.optics.blur_px) * _speckle(rig.laser, laser.shape, rng)
        signal = signal + (light[:, :, None] * np.array(rig.laser.rgb) if rig.sensor.colour else light)
    return expose(signal * exposure_ms, rig.sensor, rng)
