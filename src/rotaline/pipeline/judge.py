"""From what a run found to the verdict: the evidence of the calibration, then the measured features against their references."""

from collections.abc import Sequence

import numpy as np

from rotaline.calibration.model import SystemCalibration
from rotaline.calibration.verdict.evidence import Evidence
from rotaline.calibration.verdict.judge import MeasuredEntry, judge_calibration, judge_measurements
from rotaline.calibration.verdict.model import Verdict
from rotaline.io.results import MeasurementEntry
from rotaline.io.session_file import MeasurementRequest
from rotaline.pipeline.calibrate import CalibrationParts
from rotaline.scanning.propagation import calibration_uncertainty


def judge_parts(parts: CalibrationParts) -> Verdict:
    """The verdict on a calibration, before anything was measured with it."""
    failures: dict[str, str] = {}
    for warning in parts.warnings:
        if warning.serious:
            failures[warning.stage] = " ".join(filter(None, (failures.get(warning.stage), warning.text)))
    return judge_calibration(
        Evidence(
            parts.observations,
            parts.camera,
            parts.laser_plane,
            parts.axis,
            parts.joint,
            failures,
            u_near_axis_mm(parts.system) if parts.system is not None else float("nan"),
        )
    )


def u_near_axis_mm(system: SystemCalibration) -> float:
    """Standard uncertainty from the calibration of the point in the laser plane that is nearest to the origin of the base frame, mm.

    NaN where the covariance is not known.
    """
    origin, plane = system.rotation_axis_camera.point, system.laser_plane_camera
    nearest = origin - float(plane.signed_distance_to(origin[None])[0]) * plane.normal
    return float(calibration_uncertainty(system.base_from_camera.apply(nearest[None]), np.zeros(1), system)[0])


def judge_measured(
    verdict: Verdict, entries: Sequence[MeasurementEntry], requests: Sequence[MeasurementRequest]
) -> Verdict:
    """The verdict with the step "measure": values whose whole uncertainty is known against their references.

    Parameters
    ----------
    verdict : Verdict   on the calibration
    entries : what was measured
    requests : what was asked for; they tell which parts are there to check
    """
    checks = {(r.capture, r.feature, r.name) for r in requests if r.check}
    measured = []
    for entry in entries:
        m = entry.measurement
        if m is None:
            continue
        for key in entry.error.keys() & m.u_calibration.keys():
            quantity = key.replace("_", " ")
            check = (entry.capture, entry.feature, entry.name) in checks
            measured.append(
                MeasuredEntry(
                    f"{entry.capture}, {quantity}", m.value[key], entry.reference[key], m.uncertainty[key], check, m.rms
                )
            )
    return judge_measurements(verdict, sorted(measured, key=lambda e: e.name))
