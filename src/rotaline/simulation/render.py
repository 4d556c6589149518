"""Rendering one frame by ray casting.

First the rays through the corners of all pixels find what is where. A pixel whose four corners see the same smooth face, in the
same print and shadow, away from the laser sheet, has even light: the mean of its corners. All others are split into sub-pixel
rays on a lattice, few for the smooth profile of the stripe and many at edges. The light of every ray, and that of every even
pixel, is then spread over the pixels around as blur and pixel area demand (:mod:`rotaline.simulation.footprint`), each with the blur at
its own depth.

The light of a surface point, in electrons a millisecond: ambient ``ambient * albedo * (0.55 + 0.45 |cos to the viewer|)``, laser
``peak *`` :func:`sheet_light` ``*`` :func:`reflected` of :mod:`rotaline.simulation.laser_light`. Laser light reaches a point if the ray from
the laser to it meets nothing before: shadows, and surfaces hidden from the camera, come out by themselves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from rotaline.simulation.exposure import expose
from rotaline.simulation.footprint import pixel_kernel, point_kernels, reach_px, subpixel_offsets
from rotaline.simulation.laser_light import SHEET_HALF_WIDTH, reflected, sheet_distance, sheet_light, sheet_sigma_mm
from rotaline.simulation.raycast import Placed as Placed
from rotaline.simulation.raycast import PosedPart, View
from rotaline.simulation.rig import Rig
from rotaline.simulation.speckle import contrast, grain_px, speckle_factor, speckle_pattern
from rotaline.simulation.surface import dot_rows
from rotaline.vision.camera import CameraModel

_EDGE_POINTS, _DIM_EDGE_POINTS, _LEAST_STRIPE_POINTS = 144, 34, 8
"""Sub-pixel rays of a pixel at an edge, at an edge away from the stripe in a laser-on frame, and on a smooth stripe."""

_STRIPE_POINTS_PX2 = 2.0
"""Over the square of the sheet's width in px: how many rays its profile needs."""

_CHUNK_RAYS = 1 << 15
_BLUR_STEP_PX = 0.2
"""Distance of the widths of blur between which is interpolated (in the square of the width)."""

_EVEN_AMBIENT = 0.01
_KINK_PX = 0.2
_DARK, _LIT, _SHADED = 0, 1, 2


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
class _Seen:
    """What rays see, ``...`` rays: light per unit of ambient and of laser, depth (inf: nothing), part (-1: nothing), face;
    signed distance from the sheet (nan: nothing seen, or laser off); whether the sheet is here and lights the surface."""

    ambient: Float[np.ndarray, "*n"]
    laser: Float[np.ndarray, "*n"]
    depth_mm: Float[np.ndarray, "*n"]
    part: Int[np.ndarray, "*n"]
    face: Int[np.ndarray, "*n"]
    sheet_mm: Float[np.ndarray, "*n"]
    state: UInt8[np.ndarray, "*n"]


@dataclass(frozen=True, eq=False)
class _Scene:
    rig: Rig
    parts: tuple[PosedPart, ...]
    camera: View
    laser: View

    @staticmethod
    def of(rig: Rig, parts_base: Sequence[Placed]) -> "_Scene":
        parts = tuple(PosedPart.of(part) for part in parts_base)
        base_from_camera = rig.camera_from_base.inv()
        camera = View.of(parts, np.asarray(base_from_camera.translation), base_from_camera.rotation.as_matrix())
        normal, beam = rig.laser.plane_base.normal, rig.laser.beam_base
        axes = np.stack([np.cross(normal, beam), normal, beam], axis=1)
        return _Scene(rig, parts, camera, View.of(parts, np.asarray(rig.laser.position_base, dtype=float), axes))

    def shaded(self, points_base: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether something stands between the laser and points of the surface."""
        in_view = (points_base - self.laser.origin_base) @ self.laser.base_from_view
        depth = in_view[:, 2]
        return self.laser.hits(in_view[:, :2] / depth[:, None]).t < depth * (1.0 - 1e-6)

    def seen(self, xy: Float[np.ndarray, "n 2"], laser_on: bool) -> _Seen:
        """What the rays ``(x, y, 1)`` of the camera see; without ``laser_on`` nothing of the laser is worked out."""
        hits = self.camera.hits(xy)
        n = len(xy)
        ambient, laser, sheet, state = np.zeros(n), np.zeros(n), np.full(n, np.nan), np.zeros(n, np.uint8)
        for i, part in enumerate(self.parts):
            (here,) = np.nonzero(hits.part == i)
            if not len(here):
                continue
            rays = self.camera.directions_base(xy[here])
            points = self.camera.origin_base + hits.t[here, None] * rays
            points_part, face = part.to_part(points), hits.face[here]
            normals = part.shape.normals(points_part, face) @ part.base_from_part.T
            albedo = part.shape.albedo(points_part, face)
            to_camera = -rays / np.sqrt(dot_rows(rays, rays))[:, None]
            ambient[here] = albedo * (0.55 + 0.45 * np.abs(dot_rows(to_camera, normals)))
            if not laser_on:
                continue
            sheet[here] = sheet_distance(self.rig.laser, points)
            (near,) = np.nonzero(np.abs(sheet[here]) < self._sheet_reach_mm(points))
            falls = sheet_light(self.rig.laser, points[near])
            near, falls = near[falls > 0], falls[falls > 0]
            to_laser = self.laser.origin_base - points[near]
            to_laser /= np.sqrt(dot_rows(to_laser, to_laser))[:, None]
            sent = falls * reflected(part.shape.material, albedo[near], normals[near], to_laser, to_camera[near])
            faces_it = np.nonzero(sent > 0)[0]
            sent[faces_it[self.shaded(points[near[faces_it]])]] = 0.0
            laser[here[near]], state[here[near]] = sent, np.where(sent > 0, _LIT, _SHADED)
        return _Seen(ambient, laser, hits.t, hits.part, hits.face, sheet, state)

    def _sheet_reach_mm(self, points_base: Float[np.ndarray, "n 3"]) -> float:
        """Half width of the sheet, at least, where these points are."""
        from_laser = points_base - self.laser.origin_base
        square = dot_rows(from_laser, from_laser)
        ends = np.sqrt(np.array([square.min(), square.max()]))
        return SHEET_HALF_WIDTH * float(sheet_sigma_mm(self.rig.laser, ends).max())


@lru_cache(maxsize=4)
def _corner_xy(camera: CameraModel, margin: int) -> Float[np.ndarray, "h w 2"]:
    """Ideal normalised coordinates of the corners of all pixels, and of ``margin`` more pixels on every side."""
    width, height = camera.image_size
    u = np.arange(-margin, width + margin + 1) - 0.5
    rows = [np.column_stack([u, np.full(len(u), v)]) for v in np.arange(-margin, height + margin + 1) - 0.5]
    step = max(_CHUNK_RAYS // len(u), 1)
    xy = [camera.rays(np.concatenate(rows[i : i + step]))[:, :2] for i in range(0, len(rows), step)]
    return np.concatenate(xy).reshape(len(rows), len(u), 2)


def _seen_at_corners(scene: _Scene, xy: Float[np.ndarray, "h w 2"], laser_on: bool) -> _Seen:
    """What the corners of all pixels see, as images; in bands of rows, which bounds the memory."""
    height, width = xy.shape[:2]
    kinds = (np.float32, np.float32, np.float32, np.int16, np.int32, np.float32, np.uint8)
    images = _Seen(*(np.empty((height, width), kind) for kind in kinds))
    step = max(_CHUNK_RAYS // width, 1)
    for row in range(0, height, step):
        band = scene.seen(xy[row : row + step].reshape(-1, 2), laser_on)
        for f in fields(_Seen):
            getattr(images, f.name)[row : row + step] = getattr(band, f.name).reshape(-1, width)
    return images


def _of_corners(values: np.ndarray, combine: Callable[..., np.ndarray]) -> np.ndarray:
    """Combine the values at the four corners of each pixel."""
    rows = combine(values[:-1], values[1:])
    return combine(rows[:, :-1], rows[:, 1:])


def _differ(values: np.ndarray) -> np.ndarray:
    return np.asarray(_of_corners(values, np.maximum) != _of_corners(values, np.minimum))


def _edges(corners: _Seen, focal_px: float) -> Bool[np.ndarray, "h w"]:
    """Pixels with another part, face or print at one of their corners.

    Faces that go on smoothly into each other, as the triangles of a fine mesh do, are no edge: ``1 / depth`` is linear in
    the image of a plane, so its second differences show jumps and creases.
    """
    nearness = np.where(np.isfinite(corners.depth_mm), 1.0 / corners.depth_mm, np.float32(0.0))
    bend = np.zeros_like(nearness)
    bend[:, 1:-1] = np.abs(nearness[:, :-2] - 2 * nearness[:, 1:-1] + nearness[:, 2:])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(nearness[:-2] - 2 * nearness[1:-1] + nearness[2:]))
    kink = _of_corners(bend > _KINK_PX / focal_px * nearness, np.logical_or)
    uneven = _of_corners(corners.ambient, np.maximum) - _of_corners(corners.ambient, np.minimum) > _EVEN_AMBIENT
    return np.asarray(_differ(corners.part) | uneven | (_differ(corners.face) & kink))


@dataclass(frozen=True, eq=False)
class _Split:
    """Pixels (row, column) that are not even, the sub-pixel points that they need, and whether their ambient light is even."""

    pixels: Int[np.ndarray, "m 2"]
    offsets: Float[np.ndarray, "n 2"]
    even_ambient: bool = False


def _pixels_to_split(corners: _Seen, rig: Rig, laser_on: bool) -> list[_Split]:
    edges = _edges(corners, rig.camera.fx)
    if not laser_on:
        return [_Split(np.argwhere(edges), subpixel_offsets(_EDGE_POINTS))]
    lit, shaded = (_of_corners(corners.state == state, np.logical_or) for state in (_LIT, _SHADED))
    crossed = (_of_corners(corners.sheet_mm, np.fmin) < 0) & (_of_corners(corners.sheet_mm, np.fmax) > 0)
    near = lit | shaded | crossed
    around = cv2.dilate(near.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    sharp = (edges & around) | (lit & shaded)
    visible = corners.depth_mm[np.isfinite(corners.depth_mm)]
    mm_per_px = (float(visible.max()) if len(visible) else 1.0) / rig.camera.fx
    n_stripe = max(_STRIPE_POINTS_PX2 * (mm_per_px / rig.laser.sigma_mm) ** 2, _LEAST_STRIPE_POINTS)
    return [
        _Split(np.argwhere(sharp), subpixel_offsets(_EDGE_POINTS)),
        _Split(np.argwhere(near & ~sharp), subpixel_offsets(int(min(n_stripe, _EDGE_POINTS))), even_ambient=True),
        _Split(np.argwhere(edges & ~near & ~sharp), subpixel_offsets(_DIM_EDGE_POINTS)),
    ]


@dataclass(frozen=True, eq=False)
class _Blur:
    """The lens's blur at the depths of a scene: widths, between two of which each depth is shared out."""

    rig: Rig
    sigmas_px: Float[np.ndarray, " k"]

    @staticmethod
    def of(scene: _Scene) -> "_Blur":
        """Widths for all that a coarse grid of rays sees."""
        rig, xy = scene.rig, _corner_xy(scene.rig.camera, 0)
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

    def shares(self, depth_mm: Float[np.ndarray, "*n"], k: int) -> Float[np.ndarray, "*n"]:
        """Share of the k-th width at each depth: linear in the square of the width, so that the variance is right."""
        squares = self.sigmas_px**2
        if len(squares) == 1:
            return np.ones(depth_mm.shape)
        at = np.where(np.isfinite(depth_mm), depth_mm, 1e9)
        square = self.rig.optics.blur_px_at(at, self.rig.camera.fx) ** 2
        place = np.clip((square - squares[0]) / (squares[1] - squares[0]), 0.0, len(squares) - 1.0)
        return np.asarray(np.maximum(1.0 - np.abs(place - k), 0.0))


def _spread_even(
    light: Float[np.ndarray, "h w"], depth_mm: Float[np.ndarray, "h w"], blur: _Blur
) -> Float[np.ndarray, "h w"]:
    """Light of even pixels, after blur and pixel area."""
    spread = np.zeros_like(light)
    for k, sigma in enumerate(blur.sigmas_px):
        kernel = pixel_kernel(float(sigma))
        layer = (light * blur.shares(depth_mm, k)).astype(np.float32)
        spread += cv2.sepFilter2D(layer, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    return spread


def _spread_points(
    image: Float[np.ndarray, "h w"],
    pixels: Int[np.ndarray, "m 2"],
    light: Float[np.ndarray, "m n"],
    shares: Sequence[Float[np.ndarray, "m n"]],
    blur: _Blur,
) -> None:
    """Add the light of sub-pixel points to an image that is larger by the blur's reach on every side."""
    reach, flat = blur.reach_px, image.reshape(-1)
    for sigma, share in zip(blur.sigmas_px, shares, strict=True):
        kernels = point_kernels(light.shape[1], float(sigma))
        side = kernels.shape[1]
        falls = np.ascontiguousarray(((light * share) @ kernels.reshape(light.shape[1], -1)).T)
        first = (pixels[:, 0] + reach - side // 2) * image.shape[1] + pixels[:, 1] + reach - side // 2
        # every pixel is there once: no two of a line add to the same place
        for k, line in enumerate(falls):
            flat[first + (k // side * image.shape[1] + k % side)] += line


def render_irradiance(rig: Rig, parts_base: Sequence[Placed], *, laser_on: bool, ambient_e_per_ms: float) -> Irradiance:
    """The light that the lens puts on the pixels.

    Parameters
    ----------
    rig : Rig
    parts_base : what stands there, in the base frame
    laser_on : False leaves the laser image black
    ambient_e_per_ms : light of a white surface that faces the camera
    """
    scene = _Scene.of(rig, parts_base)
    blur = _Blur.of(scene)
    width, height = rig.camera.image_size
    margin = blur.reach_px
    xy = _corner_xy(rig.camera, margin)
    corners = _seen_at_corners(scene, xy, laser_on)

    depth = _of_corners(corners.depth_mm, np.minimum)
    even = _of_corners(corners.ambient, np.add) / 4
    to_split = _pixels_to_split(corners, rig, laser_on)
    for split in to_split:
        if not split.even_ambient:
            even[tuple(split.pixels.T)] = 0.0
    ambient, laser = (np.zeros((height + 4 * margin, width + 4 * margin), np.float32) for _ in range(2))
    inner = (slice(margin, height + 3 * margin), slice(margin, width + 3 * margin))
    ambient[inner] = _spread_even(even, depth, blur)

    for split in to_split:
        # bilinear between the corners, whose distances are small against the bends of the distortion
        right, down = split.offsets.T + 0.5
        weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], axis=1)
        step = max(_CHUNK_RAYS // len(weights), 1)
        for i in range(0, len(split.pixels), step):
            some = split.pixels[i : i + step]
            row, column = some.T
            around = np.stack([xy[row, column], xy[row, column + 1], xy[row + 1, column], xy[row + 1, column + 1]], 1)
            seen = scene.seen((weights @ around).reshape(-1, 2), laser_on)
            shape = (len(some), len(weights))
            shares = [blur.shares(seen.depth_mm, k).reshape(shape) for k in range(len(blur.sigmas_px))]
            if not split.even_ambient:
                _spread_points(ambient, some, seen.ambient.reshape(shape), shares, blur)
            if laser_on:
                _spread_points(laser, some, seen.laser.reshape(shape), shares, blur)

    image = (slice(2 * margin, 2 * margin + height), slice(2 * margin, 2 * margin + width))
    part = corners.part[margin : margin + height, margin : margin + width].astype(int)
    return Irradiance(ambient[image] * ambient_e_per_ms, laser[image] * rig.laser.peak_e_per_ms, part)


def _speckled(
    rig: Rig, parts_base: Sequence[Placed], light: Irradiance, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """The laser's light with speckle."""
    laser = light.laser
    (rows,), (columns,) = np.nonzero(laser.any(axis=1)), np.nonzero(laser.any(axis=0))
    if not len(rows):
        return laser
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    distance = rig.optics.focus_mm or float(np.linalg.norm(rig.camera_from_base.translation))
    grain = grain_px(rig.laser, rig.optics, rig.camera.fx, distance)
    factor = np.ones_like(laser)
    pattern, part = speckle_pattern(laser[box].shape, grain, rng), light.part[box]
    for index in range(-1, len(parts_base)):
        roughness = parts_base[max(index, 0)].shape.material.roughness_um
        here = (part == index) & (laser[box] > 0)
        factor[box][here] = speckle_factor(pattern[here], contrast(rig.laser, grain, roughness))
    return laser * factor


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
    light = render_irradiance(rig, parts_base, laser_on=laser_on, ambient_e_per_ms=ambient_e_per_ms)
    laser = _speckled(rig, parts_base, light, rng) if laser_on else light.laser
    if rig.sensor.colour:
        signal = light.ambient[:, :, None] + laser[:, :, None] * np.array(rig.laser.rgb, np.float32)
    else:
        signal = light.ambient + laser
    return expose(signal * exposure_ms, rig.sensor, rng)
