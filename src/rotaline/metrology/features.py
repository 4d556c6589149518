"""Measuring a feature in a cloud: the one address of the layer."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from rotaline.metrology.groove import measure_groove
from rotaline.metrology.model import FEATURES, FeatureMeasurement, Region
from rotaline.metrology.options import MeasureOptions
from rotaline.metrology.planes import measure_plane, measure_step
from rotaline.metrology.rounds import measure_cylinder, measure_sphere
from rotaline.metrology.scene import Scene, build_scene
from rotaline.metrology.stepped import measure_stepped_cylinder

__all__ = ["MeasureOptions", "measure_feature"]

_MEASURE: dict[str, Callable[[Scene, dict[str, float] | None], FeatureMeasurement]] = {
    "sphere": measure_sphere,
    "cylinder": measure_cylinder,
    "plane": measure_plane,
    "step": measure_step,
    "groove": measure_groove,
    "stepped-cylinder": measure_stepped_cylinder,
}


def measure_feature(
    points: Float[np.ndarray, "n 3"],
    feature: str,
    *,
    viewpoints: Float[np.ndarray, "n 3"] | None = None,
    frame: Int[np.ndarray, " n"] | None = None,
    nominal: dict[str, float] | None = None,
    region: Region | None = None,
    options: MeasureOptions | None = None,
) -> FeatureMeasurement:
    """Find a feature in a cloud and fit it to all points that belong to it.

    The cloud may also hold the table top (taken for the lowest large plane at right angles to z), other surfaces, points at
    edges and strays. The search runs on a thinned cloud, the fit on all points away from edges.

    Parameters
    ----------
    points : (n, 3)   mm, any frame with z up; rows that are not finite are left out
    feature : one of ``FEATURES``
    viewpoints : (n, 3)   where the camera stood when it saw each point, if known: tells the outside of planes
    frame : (n,)   index of the frame of each point, if known, in the order of the turn: the uncertainty then counts errors
        that the points of a frame, and of frames next to each other, have in common
    nominal : expected values, mm, with keys of ``FeatureMeasurement.value``; they guide the search and never the value
    region : where to look; None: everywhere
    options : MeasureOptions

    Raises
    ------
    MeasurementError
        If the feature is not there; the message says what was found instead and what to do.
    ValueError
        If ``feature`` is none of ``FEATURES``.
    """
    if feature not in _MEASURE:
        raise ValueError(f"Unknown feature {feature!r}; expected one of {', '.join(FEATURES)}.")
    scene = build_scene(points, viewpoints, frame, region, MeasureOptions() if options is None else options)
    return _MEASURE[feature](scene, nominal)
