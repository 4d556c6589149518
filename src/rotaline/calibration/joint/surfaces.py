"""The surfaces of artefacts: how far a point is from each, on which one it lies, and how that changes with the artefact's sizes.

All in the frame ``part``: the axis is z, z = 0 the bottom (of a sphere: its centre). Points near an edge belong to no surface: there the stripe is
bent, half lit and blurred.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, SteppedCylinder

NONE = -1
"""Number of the surface of points that lie on none."""


@dataclass(frozen=True, eq=False)
class OnSurface:
    """Points with the surface that each lies on.

    Attributes
    ----------
    surface : (n,)   index into :func:`surface_names`, ``NONE`` for none
    distance : (n,)   signed distance, mm, positive outside; NaN on none
    normal : (n, 3)   gradient of the distance by the point
    """

    surface: Int[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    normal: Float[np.ndarray, "n 3"]


def surface_names(artifact: Artifact) -> tuple[str, ...]:
    """The surfaces that are used."""
    if isinstance(artifact, SteppedCylinder):
        return ("top disc", "small side", "step", "large side")
    if isinstance(artifact, KnownCylinder):
        return ("side",) if artifact.height is None else ("side", "top disc")
    return ("sphere",)


def size_names(artifact: Artifact) -> tuple[str, ...]:
    """Its sizes."""
    if isinstance(artifact, SteppedCylinder):
        return ("diameter_small", "diameter_large", "height_small", "height_large")
    if isinstance(artifact, KnownCylinder):
        return ("diameter",) if artifact.height is None else ("diameter", "height")
    return ("diameter",)


def with_sizes(artifact: Artifact, sizes: Float[np.ndarray, " k"]) -> Artifact:
    """The artefact with other sizes, in the order of :func:`size_names`."""
    named: dict[str, Any] = {name: float(v) for name, v in zip(size_names(artifact), sizes, strict=True)}
    return replace(artifact, **named)


def sizes_of(artifact: Artifact) -> Float[np.ndarray, " k"]:
    """Its sizes, mm."""
    return np.array([getattr(artifact, name) for name in size_names(artifact)], dtype=float)


def by_sizes(artifact: Artifact, surface: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
    """Derivative of the distances by the sizes; 0 on no surface."""
    rows = np.zeros((len(surface_names(artifact)) + 1, len(size_names(artifact))))
    if isinstance(artifact, SteppedCylinder):
        rows[0, 2:] = -1.0
        rows[1, 0] = -0.5
        rows[2, 3] = -1.0
        rows[3, 1] = -0.5
    elif isinstance(artifact, KnownCylinder):
        rows[0, 0] = -0.5
        if artifact.height is not None:
            rows[1, 1] = -1.0
    else:
        rows[0, 0] = -0.5
    return rows[surface]


def size_scale(artifact: Artifact) -> float:
    """Half its largest extent, mm: the lever of its tilt."""
    if isinstance(artifact, SteppedCylinder):
        return max(artifact.height_small + artifact.height_large, artifact.diameter_large) / 2
    if isinstance(artifact, KnownCylinder):
        return max(artifact.diameter, artifact.height or 0.0) / 2
    return artifact.diameter / 2


def mid_height(artifact: Artifact) -> float:
    """Height of the point of the part about which its pose is counted, mm."""
    if isinstance(artifact, SteppedCylinder):
        return (artifact.height_small + artifact.height_large) / 2
    if isinstance(artifact, KnownCylinder):
        return (artifact.height or artifact.diameter) / 2
    return 0.0


def assign(
    artifact: Artifact,
    points_part: Float[np.ndarray, "n 3"],
    margin_mm: Float[np.ndarray, " n"],
    band_mm: float | Float[np.ndarray, " n"],
) -> OnSurface:
    """The surface that each point lies on.

    Parameters
    ----------
    artifact : Artifact
    points_part : (n, 3)   mm
    margin_mm : (n,)   distance that a point keeps from the edges of its surface
    band_mm : a point lies on a surface if it is not farther from it than this
    """
    x, y, z = points_part.T
    rho = np.hypot(x, y)
    n = len(z)
    with np.errstate(invalid="ignore", divide="ignore"):
        radial = np.stack([x / rho, y / rho, np.zeros(n)], axis=1)
    upward = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (n, 3))
    if isinstance(artifact, KnownSphere):
        length = np.linalg.norm(points_part, axis=1)
        distances = [length - artifact.diameter / 2]
        with np.errstate(invalid="ignore", divide="ignore"):
            normals = [points_part / length[:, None]]
        inside = [np.ones(n, dtype=bool)]
    elif isinstance(artifact, KnownCylinder):
        r = artifact.diameter / 2
        distances, normals = [rho - r], [radial]
        on_side = np.abs(rho - r) < band_mm
        if artifact.height is None:
            low, high = (np.quantile(z[on_side], [0.01, 0.99])) if on_side.any() else (0.0, 0.0)
        else:
            low, high = 0.0, artifact.height
            distances.append(z - artifact.height)
            normals.append(upward)
        inside = [(z > low + margin_mm) & (z < high - margin_mm)]
        if artifact.height is not None:
            inside.append(rho < r - margin_mm)
    else:
        r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
        h2 = artifact.height_large
        top = artifact.height_small + h2
        distances = [z - top, rho - r1, z - h2, rho - r2]
        normals = [upward, radial, upward, radial]
        inside = [
            rho < r1 - margin_mm,
            (z > h2 + margin_mm) & (z < top - margin_mm),
            (rho > r1 + margin_mm) & (rho < r2 - margin_mm),
            (z > margin_mm) & (z < h2 - margin_mm),
        ]
    all_distances = np.stack(distances)
    allowed = np.stack(inside) & (np.abs(all_distances) <= band_mm)
    cost = np.where(allowed, np.abs(all_distances), np.inf)
    best = np.argmin(cost, axis=0)
    any_ok = allowed.any(axis=0)
    rows = np.arange(n)
    surface = np.where(any_ok, best, NONE)
    distance = np.where(any_ok, all_distances[best, rows], np.nan)
    return OnSurface(surface, distance, np.where(any_ok[:, None], np.stack(normals)[best, rows], np.nan))


def has_axis(artifact: Artifact) -> bool:
    """Whether its sides are straight along an axis."""
    return not isinstance(artifact, KnownSphere)


def curvature_of(
    artifact: Artifact, points_part: Float[np.ndarray, "n 3"], surface: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Curvature of the surface at each point, across its axis, 1/mm; 0 on discs and on no surface."""
    if isinstance(artifact, KnownSphere):
        return np.asarray(np.where(surface == NONE, 0.0, 2.0 / artifact.diameter))
    round_ones = np.array([name.endswith("side") for name in surface_names(artifact)] + [False])
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(round_ones[surface], 1.0 / np.hypot(points_part[:, 0], points_part[:, 1]), 0.0))
