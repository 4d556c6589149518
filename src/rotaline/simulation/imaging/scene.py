"""What a camera ray sees: the light of the surface point that it meets first.

In electrons a millisecond, ambient light gives ``ambient * albedo * (0.55 + 0.45 |cos to the viewer|)`` and the laser ``peak *``
:func:`sheet_light` ``*`` :func:`reflected` of :mod:`rotaline.simulation.imaging.laser_light`. Laser light reaches a point if the ray from the laser to it
meets nothing before: shadows, and surfaces hidden from the camera, come out by themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from rotaline.simulation.imaging.laser_light import (
    SHEET_HALF_WIDTH,
    reflected,
    sheet_distance,
    sheet_light,
    sheet_sigma_mm,
)
from rotaline.simulation.imaging.raycast import Placed, PosedPart, View
from rotaline.simulation.parts.surface import dot_rows
from rotaline.simulation.rig import Rig

DARK, LIT, SHADED = 0, 1, 2
"""No laser light falls here, it lights the surface, or something keeps it off the surface."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What rays see, in any arrangement.

    Attributes
    ----------
    ambient, laser : light per unit of ambient light and of the laser's peak
    depth_mm : z of the camera frame; inf: nothing is seen
    part, face : which part (-1: none), and which face of it
    sheet_mm : signed distance from the laser sheet; nan where nothing is seen or the laser is off
    state : ``DARK``, ``LIT`` or ``SHADED``
    """

    ambient: Float[np.ndarray, "*n"]
    laser: Float[np.ndarray, "*n"]
    depth_mm: Float[np.ndarray, "*n"]
    part: Int[np.ndarray, "*n"]
    face: Int[np.ndarray, "*n"]
    sheet_mm: Float[np.ndarray, "*n"]
    state: UInt8[np.ndarray, "*n"]

    def select(self, rays: Int[np.ndarray, " m"]) -> "Seen":
        """What some of the rays see."""
        return Seen(*(getattr(self, f.name)[rays] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Scene:
    """Parts with a rig, seen from the camera and from the laser."""

    rig: Rig
    parts: tuple[PosedPart, ...]
    camera: View
    laser: View

    @staticmethod
    def of(rig: Rig, parts_base: Sequence[Placed]) -> "Scene":
        """The same, ready for rays."""
        parts = tuple(PosedPart.of(part) for part in parts_base)
        base_from_camera = rig.camera_from_base.inv()
        camera = View.of(parts, np.asarray(base_from_camera.translation), base_from_camera.rotation.as_matrix())
        normal, beam = rig.laser.plane_base.normal, rig.laser.beam_base
        axes = np.stack([np.cross(normal, beam), normal, beam], axis=1)
        return Scene(rig, parts, camera, View.of(parts, np.asarray(rig.laser.position_base, dtype=float), axes))

    def shaded(self, points_base: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether something stands between the laser and points of the surface."""
        rays = points_base - self.laser.origin_base
        in_view = rays @ self.laser.base_from_view
        depth = in_view[:, 2:]
        return self.laser.hits(in_view[:, :2] / depth, rays / depth).t < depth[:, 0] * (1.0 - 1e-6)

    def seen(self, xy: Float[np.ndarray, "n 2"], laser_on: bool) -> Seen:
        """What the rays ``(x, y, 1)`` of the camera see; without ``laser_on`` nothing of the laser is worked out."""
        directions = self.camera.directions_base(xy)
        hits = self.camera.hits(xy, directions)
        n = len(xy)
        ambient, laser, sheet, state = np.zeros(n), np.zeros(n), np.full(n, np.nan), np.zeros(n, np.uint8)
        for i, part in enumerate(self.parts):
            (here,) = np.nonzero(hits.part == i)
            if not len(here):
                continue
            rays = directions[here]
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
            laser[here[near]], state[here[near]] = sent, np.where(sent > 0, LIT, SHADED)
        return Seen(ambient, laser, hits.t, hits.part, hits.face, sheet, state)

    def _sheet_reach_mm(self, points_base: Float[np.ndarray, "n 3"]) -> float:
        """Half width of the sheet, at least, where these points are."""
        from_laser = points_base - self.laser.origin_base
        square = dot_rows(from_laser, from_laser)
        ends = np.sqrt(np.array([square.min(), square.max()]))
        return SHEET_HALF_WIDTH * float(sheet_sigma_mm(self.rig.laser, ends).max())
