"""Scans and what is made from them: clouds, the table's height, surfaces, measured features."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from rotaline.calibration.joint.line_width import SHARE_UNKNOWN
from rotaline.calibration.model import SystemCalibration
from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, Line, SteppedCylinder
from rotaline.io.clouds import read_points
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Session
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.features import MeasureOptions, measure_feature
from rotaline.metrology.line_width import line_width_correction
from rotaline.metrology.model import FeatureMeasurement
from rotaline.pipeline.frames import CaptureStripes
from rotaline.pipeline.options import ScanOptions
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.propagation import combination_uncertainty
from rotaline.scanning.table import find_table_height
from rotaline.scanning.triangulation import scan_points

MAX_RELATIVE_ERROR = 0.02


def make_cloud(stripes: CaptureStripes, system: SystemCalibration, options: ScanOptions) -> PointCloud:
    """The cloud of a capture in the table frame."""
    cloud = scan_points(stripes.stripes(), stripes.angles_rad, system, u_angles_rad=stripes.u_angles_rad)
    return cloud if options.max_u_mm is None else cloud.select(cloud.u_mm <= options.max_u_mm)


def place_on_table(system: SystemCalibration, clouds: Iterable[PointCloud]) -> SystemCalibration:
    """The same system with z = 0 on the table top, if the clouds (made with ``system``) show it.

    The table is seen beside the part; the median over the clouds counts. Where none shows it, z = 0 stays where it is.
    """
    heights = [h for h in (find_table_height(c.points_table, c.frame) for c in clouds) if h is not None]
    if not heights:
        return system
    axis = system.rotation_axis_camera
    on_table = Line(axis.point + float(np.median(heights)) * axis.direction, axis.direction)
    return replace(system, rotation_axis_camera=on_table, table_seen=True)


def system_at_optical_axis(system: SystemCalibration) -> SystemCalibration:
    """The same system with z = 0 at the point of the axis that is nearest to the optical axis."""
    axis = system.rotation_axis_camera
    d, p = axis.direction, axis.point
    # nearest points of the line p + s d and the line t * (0, 0, 1): solve for s with the z parts removed
    across = d[:2] @ d[:2]
    s = -(p[:2] @ d[:2]) / across if across > 1e-12 else 0.0
    return replace(system, rotation_axis_camera=Line(p + s * d, d), table_seen=False)


def measurement_requests(session: Session) -> tuple[MeasurementRequest, ...]:
    """What the session asks for, and the artefact of every artefact capture with its stated sizes."""
    artefacts = tuple(
        _artifact_request(capture.folder, capture.target_name, capture.target)
        for capture in session.in_role("artifact")
        if isinstance(capture.target, SteppedCylinder | KnownCylinder | KnownSphere)
    )
    return artefacts + session.measurements


def _artifact_request(capture: str, name: str, artifact: Artifact) -> MeasurementRequest:
    sizes = artifact_sizes(artifact)
    feature: Literal["stepped-cylinder", "cylinder", "sphere"] = "stepped-cylinder"
    if not isinstance(artifact, SteppedCylinder):
        feature = "cylinder" if isinstance(artifact, KnownCylinder) else "sphere"
    return MeasurementRequest(capture=capture, feature=feature, name=name, reference=sizes, nominal=sizes)


def artifact_sizes(artifact: Artifact) -> dict[str, float]:
    """The stated sizes of an artefact under the names of a measurement, mm."""
    if not isinstance(artifact, SteppedCylinder):
        return {"diameter": artifact.diameter}
    return {
        "diameter_small": artifact.diameter_small,
        "diameter_large": artifact.diameter_large,
        "height_small": artifact.height_small,
        "height_large": artifact.height_large,
    }


def measure_request(
    request: MeasurementRequest,
    cloud: PointCloud | None,
    options: MeasureOptions,
    system: SystemCalibration | None = None,
) -> MeasurementEntry:
    """One feature in one cloud; a feature that is not found becomes an entry with its failure.

    ``system`` is the one that the cloud was made with; where it has a covariance, its errors are in the uncertainty, and where it knows the
    width of the laser line, values are corrected for it.
    """
    if cloud is None or len(cloud) == 0:
        failure = "there are no points. See the warnings of the scan."
        name = request.name or request.capture
        return MeasurementEntry(request.capture, request.feature, name, None, dict(request.reference), failure)
    entry = _entry(request, cloud.points_table, np.asarray(cloud.viewpoints_table), cloud.frame, options)
    measurement = entry.measurement
    if measurement is None or system is None:
        return entry
    if system.covariance is not None:
        measurement = measurement.with_calibration(feature_uncertainty(measurement, cloud, system))
    correction = line_width_correction(measurement, cloud, system)
    if correction:
        measurement = measurement.with_line_width(correction, SHARE_UNKNOWN)
    return replace(entry, measurement=measurement)


def feature_uncertainty(
    measurement: FeatureMeasurement, cloud: PointCloud, system: SystemCalibration
) -> dict[str, float]:
    """Standard uncertainty of each value of a feature from the calibration, mm, k = 1.

    Parameters
    ----------
    measurement : FeatureMeasurement   in this cloud, with its responses; values without a response get none
    cloud : PointCloud
    system : SystemCalibration   the one that the cloud was made with, with its covariance
    """
    if not measurement.responses:
        return {}
    weights = np.stack([response[:, None] * measurement.normals for response in measurement.responses.values()])
    used = measurement.indices
    u = combination_uncertainty(weights, cloud.points_table[used], cloud.angle_rad[used], system)
    return {key: float(value) for key, value in zip(measurement.responses, u, strict=True)}


def _entry(
    request: MeasurementRequest,
    points: Float[np.ndarray, "n 3"],
    viewpoints: Float[np.ndarray, "n 3"] | None,
    frame: Int[np.ndarray, " n"] | None,
    options: MeasureOptions,
) -> MeasurementEntry:
    name = request.name or request.capture
    reference = dict(request.reference)
    try:
        measurement = measure_feature(
            points,
            request.feature,
            viewpoints=viewpoints,
            frame=frame,
            nominal=dict(request.nominal) or None,
            region=request.region,
            options=options,
        )
    except (MeasurementError, GeometryError) as error:
        return MeasurementEntry(request.capture, request.feature, name, None, reference, str(error))
    return MeasurementEntry(request.capture, request.feature, name, measurement, reference)


def reference_contradiction(entry: MeasurementEntry) -> str:
    """What to say where a measured size is far from its reference; empty where it is not.

    Noise and a poor axis cost fractions of a per cent. Errors beyond ``MAX_RELATIVE_ERROR`` come from a wrong statement: the
    pitch of one of the targets, the reference itself, or the sense or scale of the table's angles.
    """
    wrong = [k for k, error in entry.error.items() if abs(error) > MAX_RELATIVE_ERROR * abs(entry.reference[k])]
    if not wrong or entry.measurement is None:
        return ""
    figures = ", ".join(
        f"{k} {entry.measurement.value[k]:.3f} mm, reference {entry.reference[k]:.3f} mm" for k in wrong
    )
    return (
        f"{entry.capture}, {entry.feature}: far from its reference ({figures}). Do not rely on this session before it is "
        "explained: check the pitch of every target in session.toml, the reference, and the angles of the table."
    )


def measure_points(path: Path, request: MeasurementRequest, options: MeasureOptions) -> MeasurementEntry:
    """One feature in a cloud that any program wrote, in the frame of that cloud."""
    points = read_points(path)
    return _entry(request, points, None, None, options)
