"""What a measured feature is."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

FEATURES = ("sphere", "cylinder", "plane", "step", "groove", "stepped-cylinder")


@dataclass(frozen=True)
class Region:
    """Where to look for a feature, in the frame of the cloud; mm. None: no limit."""

    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    z: tuple[float, float] | None = None
    radius: tuple[float, float] | None = None
    """Distance from the z axis."""


@dataclass(frozen=True, eq=False)
class FeatureMeasurement:
    """A feature fitted in a cloud.

    Attributes
    ----------
    feature : one of ``FEATURES``
    value : what was measured, mm: sphere, cylinder ``diameter``; plane ``flatness``; step ``height``; groove ``depth``,
        ``width_top``, ``width_bottom``; stepped cylinder ``diameter_small``, ``diameter_large``, ``height_small``, ``height_large``
    uncertainty : standard uncertainty (k = 1) with the keys of ``value``, mm, from the scatter of the points about the fit
        only: errors of the calibration are common to all points and not in it
    n_points : points used by the fits
    rms : of the residuals, mm
    form_error : range of the residuals without the outermost 0.5 % on either side, mm
    indices : (m,) points used, indices into the cloud
    residuals : (m,) their signed distances from the fitted surfaces, mm (outside positive)
    geometry : what was fitted: names to numbers or lists of numbers, in the frame of the cloud, mm
    coverage : fraction of the feature that the points cover (sphere: of the surface, cylinder: of the turn, else 1)
    warnings : what makes the value doubtful and what to do
    """

    feature: str
    value: dict[str, float]
    uncertainty: dict[str, float]
    n_points: int
    rms: float
    form_error: float
    indices: Int[np.ndarray, " m"]
    residuals: Float[np.ndarray, " m"]
    geometry: dict[str, float | list[float]]
    coverage: float = 1.0
    warnings: tuple[str, ...] = field(default=())
