"""Stated sizes of a stepped cylinder against what its stripes show, and what somebody may have mixed up."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from rotaline.calibration.verdict.evidence import Scale, gain_of, level_of, um
from rotaline.calibration.verdict.model import Finding
from rotaline.geometry.primitives import SteppedCylinder

_GROSS = 0.05
"""Relative error from which a size is not inexact but another one; what is seen at once is good to this in any rig that works."""
_ONE_FACTOR = 0.2
"""A factor common to all sizes that is nearer to 1 than this may be a wrong pitch: it is no matter of mixed-up sizes."""

_ACTION = "Measure the artefact with a caliper or micrometer, correct its sizes in session.toml, and calibrate again."


def gross_sizes(
    stated: SteppedCylinder, seen_mm: Float[np.ndarray, "3"], seen_height_large: float, scale: Scale
) -> tuple[SteppedCylinder, Finding | None]:
    """The sizes that were probably meant, and the finding; as stated if the stripes show about that.

    An axis that is off adds to both radii alike, so it is their difference that counts, and the heights.

    Parameters
    ----------
    stated : SteppedCylinder
    seen_mm : small and large radius, upper height
    seen_height_large : NaN if the table top is not seen
    scale : Scale
    """
    seen = np.array([2 * seen_mm[0], 2 * seen_mm[1], seen_mm[2], seen_height_large])
    factor = seen[2] / stated.height_small
    if _fits(stated, seen / (factor if abs(factor - 1) < _ONE_FACTOR else 1.0)):
        return stated, None
    for words, meant in _mixed_up(stated, seen):
        if _fits(meant, seen):
            return meant, _finding(stated, seen, words, scale)
    heights = seen[3] if np.isfinite(seen[3]) else stated.height_large
    found = SteppedCylinder(float(seen[0]), float(seen[1]), float(seen[2]), float(heights), stated.tolerance)
    return found, _finding(stated, seen, "these are other sizes than stated", scale)


def _mixed_up(stated: SteppedCylinder, seen: Float[np.ndarray, "4"]) -> list[tuple[str, SteppedCylinder]]:
    """What may have been meant by the stated sizes, in words and sizes."""
    ds, dl, hs, hl = stated.diameter_small, stated.diameter_large, stated.height_small, stated.height_large
    factor = float(np.nanmedian(seen / np.array([ds, dl, hs, hl])))
    meant = (
        ("the heights are swapped", (ds, dl, hl, hs)),
        ("the diameters are swapped", (dl, ds, hs, hl)),
        ("diameters and heights are swapped between small and large", (dl, ds, hl, hs)),
        ("radii are stated for diameters", (2 * ds, 2 * dl, hs, hl)),
        ("twice the diameters are stated", (ds / 2, dl / 2, hs, hl)),
        ("diameters and heights are exchanged", (hs, hl, ds, dl)),
        (
            f"all sizes are stated {1 / factor:.4g} times as large (units?)",
            (factor * ds, factor * dl, factor * hs, factor * hl),
        ),
    )
    return [(words, SteppedCylinder(*sizes, tolerance=stated.tolerance)) for words, sizes in meant]


def _fits(sizes: SteppedCylinder, seen: Float[np.ndarray, "4"]) -> bool:
    own = np.array([sizes.diameter_large - sizes.diameter_small, sizes.height_small, sizes.height_large])
    shown = np.array([seen[1] - seen[0], seen[2], seen[3]])
    return bool(np.nanmax(np.abs(shown / own - 1)) < _GROSS)


def _finding(stated: SteppedCylinder, seen: Float[np.ndarray, "4"], words: str, scale: Scale) -> Finding:
    own = np.array([stated.diameter_small, stated.diameter_large, stated.height_small, stated.height_large])
    size = float(np.nanmax(np.abs(seen - own)))
    heights = f"{seen[2]:.2f}" + (f" and {seen[3]:.2f}" if np.isfinite(seen[3]) else "")
    return Finding(
        "wrong artefact sizes",
        "artifact",
        level_of(size, scale),
        f"The stripes show diameters of {seen[0]:.2f} and {seen[1]:.2f} mm and heights of {heights} mm (small, large), but stated are diameters of "
        f"{own[0]:g} and {own[1]:g} mm and heights of {own[2]:g} and {own[3]:g} mm: {words}.",
        _ACTION,
        gain_of(size, scale),
    )


def wrong_sizes(artifact: SteppedCylinder, changes: Mapping[str, tuple[float, float]], scale: Scale) -> Finding:
    """Sizes that are off by less than could be seen at once.

    Parameters
    ----------
    artifact : as stated
    changes : of "small diameter" and "large diameter" (of the radius, mm), "small height", "all sizes" (of the large diameter), with u
    """
    stated = {
        "small diameter": artifact.diameter_small,
        "large diameter": artifact.diameter_large,
        "small height": artifact.height_small,
    }
    parts, size = [], 0.0
    for name, (change, u) in changes.items():
        if name == "all sizes":
            ratio = 1 + change / artifact.diameter_large
            parts.append(
                f"all sizes are {100 * (ratio - 1):+.3f} % (+- {200 * u / artifact.diameter_large:.1g} %) from what is stated"
            )
            size = max(size, abs(change))
            continue
        by = 2 if "diameter" in name else 1
        parts.append(
            f"the {name} is {stated[name] + by * change:.3f} mm (+- {um(2 * by * u)}) rather than {stated[name]:g} mm"
        )
        size = max(size, by * abs(change))
    return Finding(
        "wrong artefact sizes",
        "artifact",
        level_of(size, scale),
        f"Measured with plane and axis of the other captures, {' and '.join(parts)}.",
        _ACTION,
        gain_of(size, scale),
    )


def wrong_large_height(
    artifact: SteppedCylinder, seen_mm: Sequence[float], u_mm: float, scale: Scale
) -> Finding | None:
    """The height of the large cylinder against the table top, if that is seen: to a third of a percent, as nothing else carries it.

    ``u_mm``: standard uncertainty of points there, mm.
    """
    heights = np.array([h for h in seen_mm if np.isfinite(h)])
    if len(heights) == 0:
        return None
    seen = float(np.median(heights))
    size = abs(seen - artifact.height_large)
    if size < max(0.003 * artifact.height_large, 5 * scale.matters_mm, 5 * u_mm):
        return None
    return Finding(
        "wrong artefact sizes",
        "artifact",
        "doubtful",
        f"The step stands {seen:.2f} mm over the table top, but the large height is stated as {artifact.height_large:g} mm.",
        _ACTION + " Or clean the bottom of the artefact, and set it down flat.",
        gain_of(size / 5, scale),
    )
