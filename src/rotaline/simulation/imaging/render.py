"""Rendering one frame by ray casting.

First the rays through the corners of all pixels find what is where (:mod:`rotaline.simulation.imaging.pixels`). A pixel whose four corners see the
same smooth face, in the same print and shadow, away from the laser sheet, has even light: the mean of its corners. All others
are split into sub-pixel points (:mod:`rotaline.simulation.imaging.subpixel`). The light of every point, and that of every even pixel, is then spread over the
pixels around as blur and pixel area demand (:mod:`rotaline.simulation.imaging.footprint`), each with the blur at its own depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from rotaline.simulation.imaging.exposure import expose
from rotaline.simulation.imaging.footprint import pixel_kernel, point_kernels, reach_px
from rotaline.simulation.imaging.pixels import CHUNK_RAYS, corner_xy, of_corners, pixel_kinds, seen_at_corners
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.scene import Scene
from rotaline.simulation.imaging.speckle import contrast, grain_px, speckle_factor, speckle_pattern
from rotaline.simulation.imaging.subpixel import cell_offsets, edge_light, lattice_offsets, smooth_light
from rotaline.simulation.rig import Rig

_STRIPE_POINTS_PX2 = 2.0
"""Over the square of the sheet's width in px: how many rays a pixel of its profile needs."""

_BLUR_STEP_PX = 0.2
"""Distance of the widths of blur between which is interpolated (in the square of the width)."""


@dataclass(frozen=True, eq=False)
class Irradiance:
    """The light on the sensor, noise and speckle aside.

    Attributes
    ----------
    ambient, laser : (h, w)   electrons a millisecond
    part : (h, w)   index of the part that the pixel's corner sees; -1: nothing
    """

    ambient: Float[np.ndarray, "h w"]
    laser: Float[np.ndarray, "h w"]
    part: Int[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class _Blur:
    """The lens's blur at the depths of a scene: widths, between two of which each depth is shared out."""

    rig: Rig
    sigmas_px: Float[np.ndarray, " k"]

    @staticmethod
    def of(scene: Scene) -> "_Blur":
        """Widths for all that a coarse grid of rays sees."""
        rig, xy = scene.rig, corner_xy(scene.rig.camera, 0)
        step = max(min(xy.shape[:2]) // 60, 1)
        depth = scene.camera.hits(np.ascontiguousarray(xy[::step, ::step]).reshape(-1, 2)).t
        depth = depth[np.isfinite(depth)]
        if not len(depth):
            return _Blur(rig, np.array([rig.optics.blur_px]))
        at_hits = rig.optics.blur_px_at(depth, rig.camera.fx)
        low, high = float(at_hits.min()), float(at_hits.max())
        n = 1 + int(np.ceil((high - low) / _BLUR_STEP_PX - 1e-9))
        return _Blur(rig, np.sqrt(np.linspace(low**2, high**2, n)) if n > 1 else np.array([high]))

    @property
    def reach_px(self) -> int:
        """How far light is spread."""
        return reach_px(float(self.sigmas_px[-1]))

    def places(self, depth_mm: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Place of each depth among the widths, 0 to k - 1, linear in the square of the width: so the variance is right."""
        squares = self.sigmas_px**2
        if len(squares) == 1:
            return np.zeros(depth_mm.shape)
        at = np.where(np.isfinite(depth_mm), depth_mm, 1e9)
        square = self.rig.optics.blur_px_at(at, self.rig.camera.fx) ** 2
        return np.clip((square - squares[0]) / (squares[1] - squares[0]), 0.0, len(squares) - 1.0)

    def shares(self, depth_mm: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
        """Share of each width at each depth."""
        away = self.places(depth_mm)[:, None] - np.arange(len(self.sigmas_px))
        return np.asarray(np.maximum(1.0 - np.abs(away), 0.0))


def _spread_even(
    light: Float[np.ndarray, "h w"], depth_mm: Float[np.ndarray, "h w"], blur: _Blur
) -> Float[np.ndarray, "h w"]:
    """Light of even pixels, after blur and pixel area."""
    places = blur.places(depth_mm).astype(np.float32)
    spread = np.zeros_like(light)
    for k, sigma in enumerate(blur.sigmas_px):
        kernel = pixel_kernel(float(sigma))
        layer = light * np.maximum(1.0 - np.abs(places - k), 0.0)
        spread += cv2.sepFilter2D(layer, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    return spread


def _spread_points(
    image: Float[np.ndarray, "h w"],
    pixels: Int[np.ndarray, "m 2"],
    light: Float[np.ndarray, "m n k"],
    kernels: Sequence[Float[np.ndarray, "n _ _"]],
    reach: int,
) -> None:
    """Add the light of sub-pixel points, in k classes of blur, to an image that is larger by ``reach`` on every side."""
    flat = image.reshape(-1)
    for k, kernel in enumerate(kernels):
        side = kernel.shape[1]
        falls = np.ascontiguousarray((light[:, :, k] @ kernel.reshape(len(kernel), -1)).T, dtype=np.float32)
        first = (pixels[:, 0] + reach - side // 2) * image.shape[1] + pixels[:, 1] + reach - side // 2
        # every pixel is there once: no two of a line add to the same place
        for i, line in enumerate(falls):
            flat[first + (i // side * image.shape[1] + i % side)] += line


def _stripe_points(rig: Rig, depth_mm: Float[np.ndarray, "h w"]) -> int:
    """How many rays a pixel with a smooth stripe needs: the narrower the sheet, the more."""
    farthest_mm = float(np.max(depth_mm, where=np.isfinite(depth_mm), initial=0.0))
    return int(np.ceil(_STRIPE_POINTS_PX2 * (farthest_mm / rig.camera.fx / rig.laser.sigma_mm) ** 2))


def render_irradiance(rig: Rig, parts_base: Sequence[Placed], *, laser_on: bool, ambient_e_per_ms: float) -> Irradiance:
    """The light that the lens puts on the pixels.

    Parameters
    ----------
    rig : Rig
    parts_base : what stands there, in the base frame
    laser_on : False leaves the laser image black
    ambient_e_per_ms : light of a white surface that faces the camera
    """
    scene = Scene.of(rig, parts_base)
    blur = _Blur.of(scene)
    width, height = rig.camera.image_size
    margin = blur.reach_px
    xy = corner_xy(rig.camera, margin)
    corners = seen_at_corners(scene, xy, laser_on)
    kinds = pixel_kinds(corners, rig.camera.fx)

    even = of_corners(corners.ambient, np.add) / 4
    even[tuple(kinds.edges.T)] = 0.0
    ambient, laser = (np.zeros((height + 4 * margin, width + 4 * margin), np.float32) for _ in range(2))
    inner = (slice(margin, height + 3 * margin), slice(margin, width + 3 * margin))
    ambient[inner] = _spread_even(even, of_corners(corners.depth_mm, np.minimum), blur)

    def corners_of(pixels: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 4 2"]:
        row, column = pixels.T
        return np.stack([xy[row, column], xy[row, column + 1], xy[row + 1, column], xy[row + 1, column + 1]], axis=1)

    offsets = cell_offsets()
    kernels = [point_kernels(offsets, float(sigma)) for sigma in blur.sigmas_px]
    step = CHUNK_RAYS // len(offsets)
    for i in range(0, len(kinds.edges), step):
        some = kinds.edges[i : i + step]
        light = edge_light(scene, corners_of(some), kinds.edge_runs_along_u[i : i + step], blur.shares, laser_on)
        _spread_points(ambient, some, light.ambient, kernels, margin)
        if laser_on:
            _spread_points(laser, some, light.laser, kernels, margin)

    # the ambient light of pixels with a smooth stripe is even
    offsets = lattice_offsets(_stripe_points(rig, corners.depth_mm))
    kernels = [point_kernels(offsets, float(sigma)) for sigma in blur.sigmas_px]
    step = CHUNK_RAYS // len(offsets)
    for i in range(0, len(kinds.stripe), step):
        some = kinds.stripe[i : i + step]
        light = smooth_light(scene, corners_of(some), offsets, blur.shares, laser_on)
        _spread_points(laser, some, light.laser, kernels, margin)

    image = (slice(2 * margin, 2 * margin + height), slice(2 * margin, 2 * margin + width))
    part = corners.part[margin : margin + height, margin : margin + width].astype(int)
    return Irradiance(ambient[image] * ambient_e_per_ms, laser[image] * rig.laser.peak_e_per_ms, part)


def focus_distance_mm(rig: Rig) -> float:
    """Distance from the lens to what is in focus; where everything is, to the origin of the base frame."""
    return rig.optics.focus_mm or float(np.linalg.norm(rig.camera_from_base.translation))


def _speckled(
    rig: Rig, parts_base: Sequence[Placed], light: Irradiance, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """The laser's light with speckle."""
    laser = light.laser
    (rows,), (columns,) = np.nonzero(laser.any(axis=1)), np.nonzero(laser.any(axis=0))
    if not len(rows):
        return laser
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    grain = grain_px(rig.laser, rig.optics, rig.camera.fx, focus_distance_mm(rig))
    factor = np.ones_like(laser)
    pattern, part = speckle_pattern(laser[box].shape, grain, rng), light.part[box]
    for index in range(-1, len(parts_base)):
        roughness = parts_base[max(index, 0)].shape.material.roughness_um
        here = (part == index) & (laser[box] > 0)
        factor[box][here] = speckle_factor(pattern[here], contrast(rig.laser, grain, roughness))
    return laser * factor


@dataclass(frozen=True, eq=False)
class Moment:
    """What stands where, and how it is lit, for a part of an exposure.

    Attributes
    ----------
    parts_base : in the base frame
    laser_power : share of the laser's full power; 0: it is off
    ambient_e_per_ms : light of a white surface that faces the camera
    """

    parts_base: Sequence[Placed]
    laser_power: float
    ambient_e_per_ms: float


def _signal_e_per_ms(
    rig: Rig, moment: Moment, rng: np.random.Generator
) -> Float[np.ndarray, "h w"] | Float[np.ndarray, "h w 3"]:
    laser_on = moment.laser_power > 0
    light = render_irradiance(rig, moment.parts_base, laser_on=laser_on, ambient_e_per_ms=moment.ambient_e_per_ms)
    laser = _speckled(rig, moment.parts_base, light, rng) * moment.laser_power if laser_on else light.laser
    if rig.sensor.colour:
        return light.ambient[:, :, None] + laser[:, :, None] * np.array(rig.laser.rgb, np.float32)
    return light.ambient + laser


def render_exposure(
    rig: Rig, moments: Sequence[Moment], *, exposure_ms: float, seed: int | Sequence[int]
) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]:
    """One image of what changes while it is exposed: each of the moments has an equal share of the exposure, and speckle of its own.

    See :func:`render_frame`, which is this with one moment.
    """
    rng = np.random.default_rng(seed)
    signals = [_signal_e_per_ms(rig, moment, rng) for moment in moments]
    signal = signals[0] if len(signals) == 1 else np.mean(signals, axis=0)
    return expose(signal * exposure_ms, rig.sensor, rng)


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
    moment = Moment(parts_base, float(laser_on), ambient_e_per_ms)
    return render_exposure(rig, [moment], exposure_ms=exposure_ms, seed=seed)
