"""Measured features with what they were asked for: the entries of ``measurements.json``."""

from dataclasses import dataclass, field
from typing import Any

from rotaline.metrology.model import FeatureMeasurement


@dataclass(frozen=True, eq=False)
class MeasurementEntry:
    """One feature that was asked for in one capture.

    In the file, ``uncertainty`` (standard, k = 1, mm) has the keys of ``value`` and combines ``uncertainty_scatter`` and
    ``uncertainty_calibration``; the latter is empty where the calibration has no covariance. ``line_width_correction`` (mm) is
    what ``value`` holds beyond the fit, because the laser line has a width.

    ``measurement`` is None where the feature was not found; then ``failure`` says why and what to do.
    ``reference`` holds the values of a better instrument, mm, with keys of ``measurement.value``.
    """

    capture: str
    feature: str
    name: str
    measurement: FeatureMeasurement | None
    reference: dict[str, float] = field(default_factory=dict)
    failure: str = ""

    @property
    def error(self) -> dict[str, float]:
        """Measured minus reference, mm, for the keys that both have."""
        if self.measurement is None:
            return {}
        value = self.measurement.value
        return {key: value[key] - self.reference[key] for key in self.reference if key in value}

    def to_json(self) -> dict[str, Any]:
        """The entry as it stands in ``measurements.json``; the points themselves are left out."""
        entry: dict[str, Any] = {"capture": self.capture, "feature": self.feature, "name": self.name}
        if self.measurement is None:
            return entry | {"value": {}, "reference": self.reference, "error": {}, "failure": self.failure}
        m = self.measurement
        return entry | {
            "value": m.value,
            "uncertainty": m.uncertainty,
            "uncertainty_scatter": m.u_scatter,
            "uncertainty_calibration": m.u_calibration,
            "line_width_correction": m.line_width_correction,
            "reference": self.reference,
            "error": self.error,
            "n_points": m.n_points,
            "rms": m.rms,
            "form_error": m.form_error,
            "coverage": m.coverage,
            "geometry": m.geometry,
            "warnings": list(m.warnings),
        }
