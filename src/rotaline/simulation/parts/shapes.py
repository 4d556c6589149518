"""Shapes that a ray can hit, each in its own ``part`` frame: z up, z = 0 is the face that stands on the table, mm.

Every shape answers three questions about rays and points in its frame: where a ray first enters it (``intersect``), which
way the surface faces there (``normals``), and how much light it sends back (``albedo``, ``material``). Only the entry of a
ray from outside counts: nothing here is transparent.

The parts of this module are exact: no facets. Each may have a form error, and chamfers where it has edges.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.parts.form_error import Bent, DisplacedSurface, FormError, OutOfRound, OutOfSphere
from rotaline.simulation.parts.material import BRIGHT, MATT, Material
from rotaline.simulation.parts.polyhedra import PolyhedraSurface, box_solid, prism
from rotaline.simulation.parts.revolution import RevolutionSurface, SphereSurface
from rotaline.simulation.parts.surface import (
    Box,
    Distances,
    Faces,
    Surface,
    Vectors,
    bevelled,
    meets_box,
    require_lengths,
)


@runtime_checkable
class Shape(Protocol):
    """What the renderer asks of a shape."""

    @property
    def material(self) -> Material:
        """How the surface sends light back; where a print changes that, ``albedo`` knows better."""
        ...

    def bounds(self) -> Box:
        """Lower and upper corner of a box that holds the whole shape, mm."""
        ...

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """First entry ``origin + t * direction``: t > 0 (inf where the ray misses) and the number of the face entered."""
        ...

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """Outward unit normals at points of the surface."""
        ...

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """Fraction of the light that comes back, 0 to 1."""
        ...

    def sizes(self) -> dict[str, float]:
        """The true sizes, mm, with the names that measurements have."""
        ...


class Solid(ABC):
    """A shape of one material whose surface follows from its sizes; what all parts of this module have in common."""

    material: Material
    _surface: Surface

    def __post_init__(self) -> None:
        """Build the surface.

        Raises
        ------
        ValueError
            If sizes, chamfer and form error make no solid.
        """
        object.__setattr__(self, "_surface", self._build())

    @abstractmethod
    def _build(self) -> Surface:
        """The surface of these sizes."""

    @abstractmethod
    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""

    def bounds(self) -> Box:
        """See :class:`Shape`."""
        return self._surface.bounds()

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`Shape`."""
        t, faces = np.full(len(directions), np.inf), np.zeros(len(directions), int)
        (near,) = np.nonzero(meets_box(self.bounds(), origin, directions))
        t[near], faces[near] = self._surface.intersect(origin, directions[near])
        return t, faces

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`Shape`."""
        return self._surface.normals(points, faces)

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`Shape`."""
        return np.full(len(points), self.material.albedo)


def _round(outline_rz: Float[np.ndarray, "k 2"], form_error: FormError | None, smallest_radius: float) -> Surface:
    """The surface of an outline, out of round if that is wanted."""
    exact = RevolutionSurface(outline_rz)
    if form_error is None or form_error.amplitude_um == 0.0:
        return exact
    if form_error.core_radius_mm > smallest_radius:
        raise ValueError(
            f"A form error of {form_error.amplitude_um} um with {form_error.lobes} lobes needs a radius of at least "
            f"{form_error.core_radius_mm:.3g} mm; this part has {smallest_radius:.3g} mm."
        )
    return DisplacedSurface(exact, exact.grown(form_error.amplitude_mm), OutOfRound(form_error))


def _flat(exact: PolyhedraSurface, form_error: FormError | None) -> Surface:
    """The surface of a flat part, bent along its longer side if that is wanted."""
    if form_error is None or form_error.amplitude_um == 0.0:
        return exact
    width, length, _ = (float(size) for size in np.ptp(exact.box, axis=0))
    bent = Bent(form_error, 0, width) if width > length else Bent(form_error, 1, length)
    return DisplacedSurface(exact, exact.grown(form_error.amplitude_mm), bent)


@dataclass(frozen=True)
class Ball(Solid):
    """A sphere that stands on z = 0."""

    diameter: float
    material: Material = BRIGHT
    form_error: FormError | None = None

    def _build(self) -> Surface:
        require_lengths("ball", diameter=self.diameter)
        radius = self.diameter / 2
        exact = SphereSurface(radius, radius)
        error = self.form_error
        if error is None or error.amplitude_um == 0.0:
            return exact
        if error.core_radius_mm > radius:
            raise ValueError(f"A ball of {self.diameter} mm is too small for a form error of {error.amplitude_um} um.")
        return DisplacedSurface(exact, exact.grown(error.amplitude_mm), OutOfSphere(error, radius))

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {"diameter": self.diameter}


@dataclass(frozen=True)
class Rod(Solid):
    """An upright cylinder from ``z_bottom`` to ``z_bottom + height``; ``chamfer`` on both edges."""

    diameter: float
    height: float
    z_bottom: float = 0.0
    material: Material = MATT
    chamfer: float = 0.0
    form_error: FormError | None = None

    def _build(self) -> Surface:
        require_lengths("rod", diameter=self.diameter, height=self.height)
        r, low, high = self.diameter / 2, self.z_bottom, self.z_bottom + self.height
        outline = np.array([[0.0, low], [r, low], [r, high], [0.0, high]])
        return _round(bevelled(outline, (1, 2), self.chamfer), self.form_error, r)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {"diameter": self.diameter, "height": self.height}


@dataclass(frozen=True)
class SteppedRod(Solid):
    """The stepped cylinder of the article as a solid: the small cylinder stands on the large one.

    ``chamfer`` is on the edges at the top, at the outside of the step and at the bottom; the inner corner of the step is sharp.
    """

    artifact: SteppedCylinder
    material: Material = MATT
    chamfer: float = 0.0
    form_error: FormError | None = None

    def _build(self) -> Surface:
        require_lengths("stepped cylinder", **self.sizes())
        a = self.artifact
        small, large = a.diameter_small / 2, a.diameter_large / 2
        if small >= large:
            raise ValueError(
                f"The small cylinder must be narrower than the large one, not {a.diameter_small} against {a.diameter_large} mm."
            )
        step, top = a.height_large, a.height_large + a.height_small
        outline = np.array([[0.0, 0.0], [large, 0.0], [large, step], [small, step], [small, top], [0.0, top]])
        return _round(bevelled(outline, (1, 2, 4), self.chamfer), self.form_error, small)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        a = self.artifact
        return {
            "diameter_small": a.diameter_small,
            "diameter_large": a.diameter_large,
            "height_small": a.height_small,
            "height_large": a.height_large,
        }


@dataclass(frozen=True)
class Cone(Solid):
    """An upright cone or frustum that stands on z = 0; a diameter of 0 is an apex.

    ``chamfer`` cuts both edges by the same length along the flat and along the flank. A form error is whole at the wider end and
    fades away towards an apex.
    """

    diameter_bottom: float
    diameter_top: float
    height: float
    material: Material = MATT
    chamfer: float = 0.0
    form_error: FormError | None = None

    def _build(self) -> Surface:
        require_lengths("cone", height=self.height, larger_diameter=max(self.diameter_bottom, self.diameter_top))
        bottom, top = self.diameter_bottom / 2, self.diameter_top / 2
        if min(bottom, top) < 0.0:
            raise ValueError(
                f"A diameter of a cone must not be negative: {self.diameter_bottom}, {self.diameter_top} mm."
            )
        ring = [[bottom, 0.0], [top, self.height]]
        outline = np.array([[0.0, 0.0]] * (bottom > 0) + ring + [[0.0, self.height]] * (top > 0))
        edges = (1, 2) if bottom > 0 and top > 0 else (1,)
        return _round(bevelled(outline, edges, self.chamfer), self.form_error, max(bottom, top))

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {"diameter_bottom": self.diameter_bottom, "diameter_top": self.diameter_top, "height": self.height}


@dataclass(frozen=True)
class Block(Solid):
    """A plate or block that stands on z = 0: ``width`` along x, ``length`` along y; ``chamfer`` on all twelve edges."""

    width: float
    length: float
    height: float
    material: Material = MATT
    chamfer: float = 0.0
    form_error: FormError | None = None

    def _build(self) -> Surface:
        require_lengths("block", **self.sizes())
        high = np.array([self.width / 2, self.length / 2, self.height])
        low = np.array([-self.width / 2, -self.length / 2, 0.0])
        if not 0.0 <= 2 * self.chamfer < min(self.width, self.length, self.height):
            raise ValueError(
                f"A chamfer of {self.chamfer} mm does not fit on a block of {high - low} mm; make it smaller."
            )
        solid = box_solid(low.tolist(), high.tolist())
        if self.chamfer > 0:
            for i in range(6):
                for j in range(i + 1, 6):
                    if j - i != 3:  # not opposite
                        edge = solid.offsets[i] + solid.offsets[j] - self.chamfer
                        solid = solid.cut((solid.normals[i] + solid.normals[j]).tolist(), float(edge))
        return _flat(PolyhedraSurface((solid,), np.stack([low, high])), self.form_error)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {"width": self.width, "length": self.length, "height": self.height}


@dataclass(frozen=True)
class GrooveBlock(Solid):
    """A block with a trapezoidal groove along y, open at the top and at both ends.

    ``chamfer`` is on the edges of the top: those of the groove and those of the block.
    """

    width: float
    length: float
    height: float
    groove_depth: float
    groove_width_top: float
    groove_width_bottom: float
    material: Material = MATT
    chamfer: float = 0.0
    form_error: FormError | None = None

    def _build(self) -> Surface:
        """Three convex solids: below the groove, right and left of it."""
        require_lengths("groove block", length=self.length)
        w, top, bottom = self.width / 2, self.groove_width_top / 2, self.groove_width_bottom / 2
        h, floor = self.height, self.height - self.groove_depth
        if not (0 < bottom <= top < w and 0 < floor < h):
            raise ValueError("The groove must fit into the block: 0 < bottom <= top < width and 0 < depth < height.")
        if 2 * self.chamfer >= self.length:
            raise ValueError(f"A chamfer of {self.chamfer} mm does not fit on a block {self.length} mm long.")
        right = bevelled(np.array([[bottom, floor], [w, floor], [w, h], [top, h]]), (2, 3), self.chamfer)
        left = right[::-1] * [-1.0, 1.0]
        box = np.array([[-w, -self.length / 2, 0.0], [w, self.length / 2, h]])
        end = self.length / 2 + h - self.chamfer
        sides = (prism(outline, self.length) for outline in (right, left))
        if self.chamfer > 0:
            sides = (side.cut([0.0, 1.0, 1.0], end).cut([0.0, -1.0, 1.0], end) for side in sides)
        below = box_solid(box[0].tolist(), [w, self.length / 2, floor])
        return _flat(PolyhedraSurface((below, *sides), box), self.form_error)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {
            "depth": self.groove_depth,
            "width_top": self.groove_width_top,
            "width_bottom": self.groove_width_bottom,
        }
