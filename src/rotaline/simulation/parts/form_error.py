"""Form errors: a solid that is a little out of round, or bowed.

Space is bent by a small smooth displacement ``h(p) e(p)``, with a height h and a unit direction e: the point p belongs to
the bent solid if ``p - h e`` belongs to the exact one. So edges stay closed, and every face is exact.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from rotaline.simulation.parts.surface import Box, Distances, Faces, Surface, Vectors, box_interval, dot_rows

_CORE_AMPLITUDES = 4.0
_NEWTON_STEPS, _CONVERGED_MM = 8, 1e-9
_SAMPLES, _BISECTIONS, _LOOK_MM = 64, 30, 1e-4


@dataclass(frozen=True)
class FormError:
    """Deviation of a surface from its exact form.

    On round parts the radius changes by ``amplitude cos(lobes phi + phase)``, with phi about the part's z axis. On a ball it
    also goes with ``sin(theta)^lobes``, theta being the angle from z: smooth at the poles. Flat parts are bent in z along
    their longer side: ``amplitude cos(pi lobes s / length + phase)``, s from the middle; one lobe is a bow, two are a wave.

    Attributes
    ----------
    amplitude_um : largest deviation
    lobes : full waves round a round part, half waves along a flat one; at least 1
    phase_deg : see above
    """

    amplitude_um: float
    lobes: int = 3
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no form error.

        Raises
        ------
        ValueError
            If a value is outside its range.
        """
        if not 0.0 <= self.amplitude_um <= 1000.0:
            raise ValueError(f"amplitude_um of a form error must be 0 to 1000, not {self.amplitude_um}.")
        if self.lobes < 1:
            raise ValueError(f"A form error has at least 1 lobe, not {self.lobes}.")

    @property
    def amplitude_mm(self) -> float:
        """Largest deviation, mm."""
        return self.amplitude_um * 1e-3

    @property
    def core_radius_mm(self) -> float:
        """Round parts: the amplitude is whole from this distance from the axis on, and falls to zero at the axis."""
        return _CORE_AMPLITUDES * (self.lobes + 1) * self.amplitude_mm


@runtime_checkable
class Displacement(Protocol):
    """How far, and which way, space is bent."""

    @property
    def largest(self) -> float:
        """No height is larger, mm."""
        ...

    def at(self, points: Vectors) -> tuple[Distances, Vectors, Vectors]:
        """Heights h (mm), unit directions e, and gradients of h at points of the bent solid."""
        ...


@dataclass(frozen=True)
class OutOfRound:
    """The radius about z changes with the angle; near the axis the change fades away."""

    error: FormError

    @property
    def largest(self) -> float:
        """See :class:`Displacement`."""
        return self.error.amplitude_mm

    def at(self, points: Vectors) -> tuple[Distances, Vectors, Vectors]:
        """See :class:`Displacement`."""
        x, y = points[:, 0], points[:, 1]
        r = np.hypot(x, y)
        safe = np.where(r > 0, r, 1.0)
        cos_phi, sin_phi, none = np.where(r > 0, x / safe, 1.0), y / safe, np.zeros(len(points))
        turn = self.error.lobes * np.arctan2(y, x) + np.radians(self.error.phase_deg)
        s = np.minimum(r / self.error.core_radius_mm, 1.0)
        weight = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        weight_slope = 30.0 * s**2 * (1.0 - s) ** 2 / self.error.core_radius_mm
        outward = self.largest * weight_slope * np.cos(turn)
        along = -self.largest * self.error.lobes * weight * np.sin(turn) / safe
        gradients = np.column_stack([outward * cos_phi - along * sin_phi, outward * sin_phi + along * cos_phi, none])
        return self.largest * weight * np.cos(turn), np.column_stack([cos_phi, sin_phi, none]), gradients


@dataclass(frozen=True)
class OutOfSphere:
    """The radius about (0, 0, ``centre_z``) changes as a spherical harmonic: ``sin(theta)^lobes cos(lobes phi + phase)``."""

    error: FormError
    centre_z: float

    @property
    def largest(self) -> float:
        """See :class:`Displacement`."""
        return self.error.amplitude_mm

    def at(self, points: Vectors) -> tuple[Distances, Vectors, Vectors]:
        """See :class:`Displacement`."""
        relative = points - np.array([0.0, 0.0, self.centre_z])
        radius = np.sqrt(dot_rows(relative, relative))
        directions = relative / radius[:, None]
        zeta = directions[:, 0] + 1j * directions[:, 1]
        lobes = self.error.lobes
        # h = Re(factor * zeta^lobes); zeta changes by (dx + i dy) / radius - zeta * d(radius) / radius
        factor = self.largest * np.exp(1j * np.radians(self.error.phase_deg))
        slope = lobes * factor * zeta ** (lobes - 1) / radius
        heights = (factor * zeta**lobes).real
        gradients = np.column_stack([slope.real, -slope.imag, np.zeros(len(points))])
        return heights, directions, gradients - (slope * zeta).real[:, None] * directions


@dataclass(frozen=True)
class Bent:
    """The solid is bent in z along x (``axis`` 0) or y (1), on which it is ``length`` mm long about 0."""

    error: FormError
    axis: int
    length: float

    @property
    def largest(self) -> float:
        """See :class:`Displacement`."""
        return self.error.amplitude_mm

    def at(self, points: Vectors) -> tuple[Distances, Vectors, Vectors]:
        """See :class:`Displacement`."""
        rate = np.pi * self.error.lobes / self.length
        turn = rate * points[:, self.axis] + np.radians(self.error.phase_deg)
        gradients = np.zeros_like(points)
        gradients[:, self.axis] = -self.largest * rate * np.sin(turn)
        return self.largest * np.cos(turn), np.broadcast_to([0.0, 0.0, 1.0], points.shape), gradients


@dataclass(frozen=True, eq=False)
class DisplacedSurface:
    """An exact surface in bent space.

    Attributes
    ----------
    exact : the surface without form error
    hull : a surface that holds the bent one inside: ``exact``, grown by the largest displacement
    displacement : of space
    """

    exact: Surface
    hull: Surface
    displacement: Displacement

    def bounds(self) -> Box:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        return self.exact.bounds() + self.displacement.largest * np.array([[-1.0], [1.0]])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`rotaline.simulation.parts.surface.Surface`.

        Newton's method from where a ray enters the hull finds nearly all entries; rays that graze the surface are searched.
        """
        t, faces = self.hull.intersect(origin, directions)
        (near,) = np.nonzero(np.isfinite(t))
        t_hull = t[near]
        t[near], faces[near] = self._by_newton(origin, directions[near], t_hull)
        grazing = np.isnan(t[near])
        rays = near[grazing]
        t[rays], faces[rays] = self._by_search(origin, directions[rays], t_hull[grazing])
        return t, faces

    def _by_newton(
        self, origin: Float[np.ndarray, "3"], directions: Vectors, t_start: Distances
    ) -> tuple[Distances, Faces]:
        """Entry near ``t_start``; nan where a step finds none, or an exit, or the steps do not end.

        Each step meets the exact surface along the aimed ray, and corrects for the change of the aim on the way.
        """
        t, faces, rays = t_start.copy(), np.zeros(len(t_start), int), np.arange(len(t_start))
        for _ in range(_NEWTON_STEPS):
            if not len(rays):
                break
            d, t_old = directions[rays], t[rays]
            heights, e, gradients = self.displacement.at(origin + t_old[:, None] * d)
            aimed = d - (heights / t_old)[:, None] * e
            t_exact, face = self.exact.intersect(origin, aimed)
            hit = np.isfinite(t_exact)
            t[rays[~hit]] = np.nan
            rays, d, aimed, t_old, t_exact, face = (a[hit] for a in (rays, d, aimed, t_old, t_exact, face))
            normals = self.exact.normals(origin + t_exact[:, None] * aimed, face)
            towards = dot_rows(_bent_normals(normals, e[hit], gradients[hit]), d)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = dot_rows(normals, aimed) / towards
            step = (t_exact - t_old) * np.where((ratio > 0.5) & (ratio < 2.0), ratio, 1.0)
            t[rays], faces[rays] = np.where(towards < 0, t_old + step, np.nan), face
            rays = rays[(towards < 0) & (np.abs(step) * np.sqrt(dot_rows(d, d)) > _CONVERGED_MM)]
        t[rays] = np.nan
        return t, faces

    def contains(self, points: Vectors) -> Bool[np.ndarray, " n"]:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        return self.exact.contains(self._exact_points(points))

    def _by_search(
        self, origin: Float[np.ndarray, "3"], directions: Vectors, t_hull: Distances
    ) -> tuple[Distances, Faces]:
        """First entry between ``t_hull`` and where the ray leaves the box, by samples and bisection; inf where there is none."""
        _, t_out = box_interval(self.bounds(), origin, directions)
        spacing = np.maximum(t_out - t_hull, 0.0) / _SAMPLES
        outside, inside = t_hull.copy(), np.full(len(t_hull), np.inf)
        for i in range(1, _SAMPLES):
            (rays,) = np.nonzero(np.isinf(inside))
            t = t_hull[rays] + i * spacing[rays]
            entered = self.contains(origin + t[:, None] * directions[rays])
            inside[rays[entered]], outside[rays[~entered]] = t[entered], t[~entered]
        (rays,) = np.nonzero(np.isfinite(inside))
        d, low, high = directions[rays], outside[rays], inside[rays]
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            entered = self.contains(origin + middle[:, None] * d)
            low, high = np.where(entered, low, middle), np.where(entered, middle, high)
        t, faces = np.full(len(t_hull), np.inf), np.zeros(len(t_hull), int)
        step = _LOOK_MM / np.sqrt(dot_rows(d, d))
        starts, ends = (self._exact_points(origin + t_near[:, None] * d) for t_near in (high - step, high + step))
        for ray, t_ray, start, end in zip(rays.tolist(), high, starts, ends, strict=True):
            # the face entered, looked at from close by along the curved ray
            (t_look,), (face,) = self.exact.intersect(start, (end - start)[None])
            t[ray], faces[ray] = (t_ray, face) if np.isfinite(t_look) else (np.inf, 0)
        return t, faces

    def _exact_points(self, points: Vectors) -> Vectors:
        """Where points of bent space are in exact space."""
        heights, e, _ = self.displacement.at(points)
        return np.asarray(points - heights[:, None] * e)

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        heights, e, gradients = self.displacement.at(points)
        normals = _bent_normals(self.exact.normals(points - heights[:, None] * e, faces), e, gradients)
        return normals / np.sqrt(dot_rows(normals, normals))[:, None]


def _bent_normals(normals: Vectors, e: Vectors, gradients: Vectors) -> Vectors:
    """Normals of the bent surface, not of length 1: the transposed derivative of ``p - h e`` times the exact normals.

    Where a face's normal is seen from e, e itself turns only at right angles to both; so only the slope of h counts.
    """
    return np.asarray(normals - gradients * dot_rows(normals, e)[:, None])
