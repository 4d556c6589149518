"""The laser stripe of one frame as geometry: where the sheet meets the parts and the camera sees it. No image is made.

The sheet is made of straight rays that leave the laser (a bowed sheet is a cone of them). Where such a ray first enters a part
is a lit point of the stripe: it lies on the sheet and on the surface, and nothing stands before it. It is a point of the image if a
ray from the camera enters at the same place first. So every centre is exact, without any search in the image.

The rays of the fan are first spread evenly, about one a pixel. Where two neighbours end more than a pixel apart, or do not belong to
the same smooth piece of surface, the gap is halved, until the edge is known to a few hundredths of a pixel. Along each piece, points
are then placed at an even distance in the image and cast anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.simulation.imaging.laser_light import reflected, sheet_light, sheet_sigma_mm
from rotaline.simulation.imaging.raycast import Placed, PosedPart, View
from rotaline.simulation.rig import Laser, Rig
from rotaline.vision.camera import CameraModel

_HALVINGS = 8
_COS_CREASE = np.cos(np.radians(20.0))
_SIN_JUMP = np.sin(np.radians(15.0))
_STEP_MM = 1e-3
_SAME_POINT = 1e-6
"""Part of the distance from the camera within which two hits are the same point."""
_FULL_SCALE_DN = 255.0
_PIXEL_VARIANCE_PX2 = 1.0 / 12.0
"""Variance of a pixel's own area, by which it widens a profile."""


@dataclass(frozen=True, eq=False)
class StripeTrace:
    """Points of the stripe in one frame, ordered along each piece.

    Attributes
    ----------
    points_base : (n, 3)   on the sheet and on a surface, mm
    uv : (n, 2)   their images, px
    normal : (n, 2)   unit normal of the stripe in the image
    width_px : (n,)   standard deviation of the stripe's profile in the image, with the blur of the lens and of the pixels' area
    intensity_dn : (n,)   height of the profile, grey values of an 8 bit image
    saturated : (n,)   the profile's core is clipped
    segment : (n,)   piece of smooth surface, numbered from 0
    """

    points_base: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    width_px: Float[np.ndarray, " n"]
    intensity_dn: Float[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]
    segment: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Points:
    """Where rays of the fan end; ``seen``: lit, in the image, not hidden and bright enough. NaN where nothing is hit."""

    angle_rad: Float[np.ndarray, " n"]
    points_base: Float[np.ndarray, "n 3"]
    normals_base: Float[np.ndarray, "n 3"]
    part: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    width_px: Float[np.ndarray, " n"]
    intensity_dn: Float[np.ndarray, " n"]
    seen: Bool[np.ndarray, " n"]

    def select(self, keep: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"]) -> "_Points":
        return _Points(*(getattr(self, f.name)[keep] for f in fields(self)))

    def merged(self, other: "_Points") -> "_Points":
        """Both, in the order of the angle."""
        both = _Points(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))
        return both.select(np.argsort(both.angle_rad, kind="stable"))


def sheet_rays(laser: Laser, angle_rad: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Rays that make up the sheet, at angles from the beam: along ``plane_base.normal x beam_base`` and along the plane's normal, for 1
    along the beam.

    A bowed sheet leaves the plane in proportion to the distance and to the square of the angle (see :class:`Laser`).
    """
    slope = laser.bow_mm / laser.waist_mm * (angle_rad / np.radians(laser.fan_deg / 2)) ** 2
    return np.stack([np.tan(angle_rad), slope / np.cos(angle_rad)], axis=1)


class _Scene:
    """Parts in the base frame as laser and camera of a rig see them."""

    def __init__(self, rig: Rig, parts_base: Sequence[Placed], min_intensity_dn: float) -> None:
        parts = tuple(PosedPart.of(part) for part in parts_base)
        normal, beam = rig.laser.plane_base.normal, rig.laser.beam_base
        base_from_laser = np.stack([np.cross(normal, beam), normal, beam], axis=1)
        base_from_camera = rig.camera_from_base.inv()
        self.rig = rig
        self.laser = View.of(parts, np.asarray(rig.laser.position_base, dtype=float), base_from_laser)
        self.camera = View.of(parts, np.asarray(base_from_camera.translation), base_from_camera.rotation.as_matrix())
        self.min_intensity_dn = min_intensity_dn
        self.peak_dn = rig.laser.peak_e_per_ms * rig.light.exposure_on_ms / rig.sensor.electrons_per_dn

    def project(self, points_base: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of points; NaN where the point is behind the camera or so far out that the distortion folds."""
        points = (points_base - self.camera.origin_base) @ self.camera.base_from_view
        uv = self.rig.camera.project(points)
        with np.errstate(invalid="ignore", divide="ignore"):
            beyond = np.hypot(points[:, 0], points[:, 1]) > _radius_of_view(self.rig.camera) * points[:, 2]
        uv[beyond] = np.nan
        return uv

    def cast(self, angle_rad: Float[np.ndarray, " n"]) -> _Points:
        """Where rays of the fan end, and how the camera sees it."""
        n, xy = len(angle_rad), sheet_rays(self.rig.laser, angle_rad)
        hits, rays = self.laser.hits(xy), self.laser.directions_base(xy)
        points, normals, light = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.zeros(n)
        for i, part in enumerate(self.laser.parts):
            (here,) = np.nonzero(hits.part == i)
            points[here] = self.laser.origin_base + hits.t[here, None] * rays[here]
            points_part, faces = part.to_part(points[here]), hits.face[here]
            normals[here] = part.shape.normals(points_part, faces) @ part.base_from_part.T
            to_laser, to_camera = _unit_rows(-rays[here]), _unit_rows(self.camera.origin_base - points[here])
            albedo = part.shape.albedo(points_part, faces)
            light[here] = reflected(part.shape.material, albedo, normals[here], to_laser, to_camera)

        uv = self.project(points)
        width, height = self.rig.camera.image_size
        inside = (uv[:, 0] >= 0) & (uv[:, 0] <= width - 1) & (uv[:, 1] >= 0) & (uv[:, 1] <= height - 1)
        seen = inside & (light > 0)

        normal, width_px, intensity = np.full((n, 2), np.nan), np.full(n, np.nan), np.zeros(n)
        normal[seen], width_px[seen], share = self._profile(points[seen], normals[seen])
        intensity[seen] = self.peak_dn * sheet_light(self.rig.laser, points[seen]) * light[seen] * share
        seen &= (intensity > 0) & (intensity >= self.min_intensity_dn) & np.isfinite(width_px)
        in_view = (points[seen] - self.camera.origin_base) @ self.camera.base_from_view
        depth_mm = in_view[:, 2]
        seen[seen] = self.camera.hits(in_view[:, :2] / depth_mm[:, None]).t > depth_mm * (1.0 - _SAME_POINT)
        return _Points(angle_rad, points, normals, hits.part, uv, normal, width_px, intensity, seen)

    def _profile(
        self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """The stripe's normal and width in the image, and the part of its height that blur leaves."""
        laser = self.rig.laser
        sheet_normal = laser.plane_base.normal
        with np.errstate(invalid="ignore", divide="ignore"):
            along = _unit_rows(np.cross(normals, sheet_normal))
            across = np.cross(along, normals)
            tangent = _unit_rows(self._image_of(points, along))
            normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
            px_per_mm = (normal * self._image_of(points, across)).sum(axis=1) / (across @ sheet_normal)
        distance_mm = np.linalg.norm(points - laser.position_base, axis=1)
        sharp_px = np.abs(px_per_mm) * sheet_sigma_mm(laser, distance_mm)
        depth_mm = (points - self.camera.origin_base) @ self.camera.base_from_view[:, 2]
        blur_px = self.rig.optics.blur_px_at(depth_mm, self.rig.camera.fx)
        width_px = np.sqrt(sharp_px**2 + blur_px**2 + _PIXEL_VARIANCE_PX2)
        with np.errstate(invalid="ignore", divide="ignore"):
            return normal, width_px, sharp_px / width_px

    def _image_of(self, points: Float[np.ndarray, "n 3"], motion: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """How the images of points move, px/mm."""
        step = _STEP_MM * motion
        return (self.project(points + step) - self.project(points - step)) / (2 * _STEP_MM)


def _unit_rows(vectors: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return np.asarray(vectors / np.sqrt(np.vecdot(vectors, vectors))[:, None])


@lru_cache(maxsize=8)
def _radius_of_view(camera: CameraModel) -> float:
    """Largest ideal normalised radius in the image, and a little more."""
    width, height = camera.image_size
    u, v = np.linspace(-1.0, width, 50), np.linspace(-1.0, height, 50)
    border = [(x, y) for x in (-1.0, float(width)) for y in v] + [(x, y) for x in u for y in (-1.0, float(height))]
    return float(np.nanmax(np.linalg.norm(camera.rays(np.array(border))[:, :2], axis=1)))


def _linked(points: _Points) -> Bool[np.ndarray, " m"]:
    """Whether a point and the next one lie on the same smooth piece of surface: no jump, no crease, both seen."""
    step = np.diff(points.points_base, axis=0)
    n0, n1 = points.normals_base[:-1], points.normals_base[1:]
    with np.errstate(invalid="ignore"):
        limit = _SIN_JUMP * np.sqrt(np.vecdot(step, step))
        smooth = (np.vecdot(n0, n1) > _COS_CREASE) & (np.abs(np.vecdot(step, n0)) < limit)
        smooth &= np.abs(np.vecdot(step, n1)) < limit
    return np.asarray(smooth & points.seen[:-1] & points.seen[1:] & (points.part[:-1] == points.part[1:]))


def trace_stripe(
    rig: Rig,
    parts_base: Sequence[Placed],
    *,
    spacing_px: float = 1.0,
    edge_px: float = 3.0,
    min_intensity_dn: float = 2.0,
) -> StripeTrace:
    """The stripe that an ideal extractor would find on parts in the base frame.

    Parameters
    ----------
    rig : Rig   its laser, camera, lens and exposure; the errors of its turntable play no part
    parts_base : what stands there, in the base frame
    spacing_px : distance of the points along the stripe
    edge_px : points nearer than this to the end of a smooth piece of surface are left out, as extractors lose or mistake them: to
        a crease (the surface turns by more than 20 deg), a jump, a shadow, the border of the image
    min_intensity_dn : fainter points are not found; grey values of an 8 bit image

    Returns
    -------
    StripeTrace   empty where the camera sees no part of the stripe

    Notes
    -----
    The centre is where the middle of the sheet meets the surface. A rendered stripe of finite width has its centroid
    elsewhere on curved surfaces (docs/theory/11-renderer.md), which is not modelled here. Details of a part that are
    narrower than a pixel may be passed over.
    """
    scene = _Scene(rig, parts_base, min_intensity_dn)
    half_rad = np.radians(rig.laser.fan_deg / 2)
    n_first = int(np.ceil(2 * half_rad * max(rig.camera.fx, rig.camera.fy))) + 2
    points = scene.cast(np.linspace(-half_rad, half_rad, n_first))
    for _ in range(_HALVINGS):
        linked = _linked(points)
        gap = ~linked & (points.seen[:-1] | points.seen[1:])
        gap |= linked & (np.linalg.norm(np.diff(points.uv, axis=0), axis=1) > 1.0)
        points = points.merged(scene.cast((points.angle_rad[:-1][gap] + points.angle_rad[1:][gap]) / 2))

    piece = np.concatenate([[0], np.cumsum(~_linked(points))])
    angles, segments = [np.empty(0)], [np.empty(0, int)]
    for k in np.unique(piece[points.seen]):
        part = points.select(piece == k)
        arc_px = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(part.uv, axis=0), axis=1))])
        places_px = np.arange(edge_px, arc_px[-1] - edge_px + 1e-9, spacing_px)
        if len(places_px):
            angles.append(np.interp(places_px, arc_px, part.angle_rad))
            segments.append(np.full(len(places_px), len(segments) - 1))
    found = scene.cast(np.concatenate(angles))
    kept = found.select(found.seen)
    segment = np.concatenate(segments)[found.seen]
    full_dn = _FULL_SCALE_DN - rig.sensor.black_level_dn
    return StripeTrace(
        kept.points_base,
        kept.uv,
        kept.normal,
        kept.width_px,
        np.minimum(kept.intensity_dn, full_dn),
        kept.intensity_dn >= full_dn,
        segment,
    )
