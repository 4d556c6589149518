"""Errors of what was calibrated and measured in a session of the twin, beside the uncertainties that were stated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder
from rotaline.io.results import MeasurementEntry
from rotaline.io.session_file import MeasurementRequest
from rotaline.io.truth_file import Truth
from rotaline.metrology.features import MeasureOptions
from rotaline.pipeline.parts import artifact_sizes, measure_request, place_on_table, system_at_optical_axis
from rotaline.pipeline.twin import ScanObservation
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.plan import SessionPlan
from rotaline.simulation.rig import Rig


@dataclass(frozen=True)
class QuantityError:
    """Estimate less truth, and the standard uncertainty (k = 1) that was stated (NaN: none was).

    ``group``: "camera", "plane", "axis" or "features"; ``unit``: "px", "1", "rad" or "mm".
    """

    group: str
    name: str
    unit: str
    error: float
    u: float

    @property
    def standardised(self) -> float:
        """Error over stated uncertainty."""
        return self.error / self.u


_PLANE_UNITS = {"plane_turn_1": "rad", "plane_turn_2": "rad", "plane_offset": "mm"}
_AXIS_UNITS = {"axis_turn_x": "rad", "axis_turn_y": "rad", "axis_shift_x": "mm", "axis_shift_y": "mm"}


def truth_of(rig: Rig, plan: SessionPlan) -> Truth:
    """What is true of a planned session, as if its file had been read."""
    sizes = {c.folder: dict(c.shots[0].on_table[0].shape.sizes()) for c in plan.captures if c.shots[0].on_table}
    return Truth(rig.camera, rig.laser_plane_camera, rig.rotation_axis_camera, rig.turn_sense, sizes)


def system_errors(truth: Truth, system: SystemCalibration) -> tuple[QuantityError, ...]:
    """Errors of camera, laser plane and axis as the covariance of the system counts them.

    Parameters
    ----------
    truth : Truth
    system : SystemCalibration   with a covariance

    Returns
    -------
    one for each camera parameter, three of the plane, four of the axis (see :class:`rotaline.calibration.model.SystemCovariance`)
    """
    covariance = system.covariance
    assert covariance is not None
    u = dict(zip(covariance.names, np.sqrt(np.diag(covariance.matrix)).tolist(), strict=True))
    plane = _plane_errors(truth.laser_plane_camera, system.laser_plane_camera, covariance.plane_pivot_camera)
    axis = _axis_errors(truth.rotation_axis_camera, system, covariance.axis_pivot_camera)
    out = []
    for name, u_name in u.items():
        if name in plane:
            out.append(QuantityError("plane", name, _PLANE_UNITS[name], plane[name], u_name))
        elif name in axis:
            out.append(QuantityError("axis", name, _AXIS_UNITS[name], axis[name], u_name))
        elif hasattr(truth.camera, name):
            error = float(getattr(system.camera, name) - getattr(truth.camera, name))
            out.append(QuantityError("camera", name, "px" if name in ("fx", "fy", "cx", "cy") else "1", error, u_name))
    return tuple(out)


def _plane_errors(true: Plane, plane: Plane, pivot: Float[np.ndarray, "3"]) -> dict[str, float]:
    """The change that would have to be taken off the estimate."""
    if true.normal @ plane.normal < 0:
        true = true.flipped()
    true_at_pivot = float(true.normal @ pivot + true.offset)
    turn_1, turn_2 = (-float(true.normal @ e) for e in across(plane.normal))
    return {
        "plane_turn_1": turn_1,
        "plane_turn_2": turn_2,
        "plane_offset": float(plane.normal @ pivot + plane.offset) - true_at_pivot,
    }


def _axis_errors(true: Line, system: SystemCalibration, pivot: Float[np.ndarray, "3"]) -> dict[str, float]:
    """The true axis in the base frame of the estimate, where the estimate is the z axis; where it passes the height of the pivot."""
    base_from_camera = system.base_from_camera
    d = base_from_camera.rotation.apply(true.direction)
    d = d if d[2] > 0 else -d
    p = base_from_camera.apply(true.point) - base_from_camera.apply(pivot)
    x, y, _ = p - d * (p[2] / d[2])
    return {
        "axis_turn_x": float(d[1]),
        "axis_turn_y": -float(d[0]),
        "axis_shift_x": -float(x),
        "axis_shift_y": -float(y),
    }


def plan_requests(plan: SessionPlan, artifacts: bool) -> tuple[MeasurementRequest, ...]:
    """What a plan asks to be measured; with ``artifacts`` the stepped cylinders of its mounts as well."""
    asked = tuple(
        MeasurementRequest(capture=m.capture, feature=m.feature, reference=dict(m.reference))  # type: ignore[arg-type]
        for m in plan.measurements
    )
    if not artifacts:
        return asked
    mounts = []
    for capture in plan.captures:
        if capture.role == "artifact" and capture.target is not None:
            artifact = plan.targets[capture.target]
            assert isinstance(artifact, SteppedCylinder)
            sizes = artifact_sizes(artifact)
            request = MeasurementRequest(
                capture=capture.folder, feature="stepped-cylinder", reference=sizes, nominal=sizes
            )
            mounts.append(request)
    return (*mounts, *asked)


def measure_scans(
    scans: Mapping[str, ScanObservation],
    requests: Sequence[MeasurementRequest],
    system: SystemCalibration,
    options: MeasureOptions,
) -> tuple[MeasurementEntry, ...]:
    """Clouds of the scans, z = 0 on the table as they show it, and the features in them."""
    wanted = {r.capture for r in requests}
    captures = {name: (scan.stripes, scan.angles_rad) for name, scan in scans.items() if name in wanted}
    # traced stripes are images of the middle of the sheet: neither the width of the line nor the blur has shifted them
    exact = replace(system_at_optical_axis(system), covariance=None, line_sigma_mm=0.0, stripe_blur_px=0.0)
    placed = place_on_table(exact, [scan_points(*capture, exact) for capture in captures.values()])
    final = replace(placed, covariance=system.covariance)
    clouds = {name: scan_points(*capture, final) for name, capture in captures.items()}
    return tuple(measure_request(r, clouds.get(r.capture), options, final) for r in requests)


def feature_errors(truth: Truth, entries: Sequence[MeasurementEntry]) -> tuple[QuantityError, ...]:
    """Errors of measured sizes; NaN where a feature was not found."""
    out = []
    for entry in entries:
        true = truth.sizes[entry.capture]
        if entry.measurement is None:
            out += [
                QuantityError("features", f"{entry.capture} {k}", "mm", float("nan"), float("nan"))
                for k in entry.reference
            ]
            continue
        for key, value in entry.measurement.value.items():
            if key in true:
                u = entry.measurement.uncertainty.get(key, float("nan"))
                out.append(QuantityError("features", f"{entry.capture} {key}", "mm", value - true[key], u))
    return tuple(out)
