"""What a measured feature is."""

from dataclasses import dataclass, field, replace
from math import hypot

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
    uncertainty : standard uncertainty (k = 1) with the keys of ``value``, mm: that of the scatter and that of the
        calibration together, as far as they are known
    n_points : points used by the fits
    rms : of the residuals, mm
    form_error : range of the residuals without the outermost 0.5 % on either side, mm
    indices : (m,) points used, indices into the cloud; a point that two surfaces use is there twice
    residuals : (m,) their signed distances from the fitted surfaces, mm (outside positive)
    geometry : what was fitted: names to numbers or lists of numbers, in the frame of the cloud, mm
    coverage : fraction of the feature that the points cover (sphere: of the surface, cylinder: of the turn, else 1)
    warnings : what makes the value doubtful and what to do
    responses : (m,) by key of ``value``: a small move ``dX_i`` of the points changes the value by
        ``sum_i responses[key][i] * (normals[i] . dX_i)``; values that are not smooth (flatness) have none
    normals : (m, 3) unit vectors, gradients of the residuals by the points; (0, 3) if there are no responses
    u_scatter : part of ``uncertainty`` that comes from the scatter of the points about the fit, mm
    u_calibration : part that comes from the calibration, mm: its errors are common to all points and do not average out;
        empty where it is not known
    line_width_correction : what ``value`` holds beyond the fit, because the laser line has a width
        (:mod:`rotaline.metrology.line_width`), mm; ``geometry`` and ``residuals`` are those of the fit. Empty where the width is not known
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
    responses: dict[str, Float[np.ndarray, " m"]] = field(default_factory=dict)
    normals: Float[np.ndarray, "_ 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    u_scatter: dict[str, float] = field(default_factory=dict)
    u_calibration: dict[str, float] = field(default_factory=dict)
    line_width_correction: dict[str, float] = field(default_factory=dict)

    def with_calibration(self, u_calibration: dict[str, float]) -> "FeatureMeasurement":
        """The same with what the calibration adds to the uncertainty of some or all values, mm (k = 1)."""
        combined = {key: hypot(u, u_calibration.get(key, 0.0)) for key, u in self.u_scatter.items()}
        return replace(self, uncertainty=combined, u_calibration=dict(u_calibration))

    def with_line_width(self, correction: dict[str, float], share_unknown: float) -> "FeatureMeasurement":
        """The same with some or all values corrected for the width of the laser line, mm.

        ``share_unknown`` is the standard uncertainty of the corrections as a share of them; it joins that of the calibration where this is known.
        """
        value = {key: v + correction.get(key, 0.0) for key, v in self.value.items()}
        u_calibration = {
            key: hypot(u, share_unknown * correction.get(key, 0.0)) for key, u in self.u_calibration.items()
        }
        corrected = replace(self, value=value, line_width_correction=dict(correction))
        return corrected.with_calibration(u_calibration) if u_calibration else corrected
