"""Scans and what is made from them: clouds, the table's height, surfaces, measured features."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.primitives import Line, SteppedCylinder
from rotaline.io.clouds import read_points
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Session
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.features import MeasureOptions, measure_feature
from rotaline.pipeline.frames import CaptureStripes
from rotaline.pipeline.options import ScanOptions
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.table import find_table_height
from rotaline.scanning.triangulation import scan_cloud

MAX_RELATIVE_ERROR = 0.02


def make_cloud(stripes: CaptureStripes, system: SystemCalibration, options: ScanOptions) -> PointCloud:
    """The cloud of a capture in the table frame."""
    cloud = scan_cloud(stripes.stripes(), stripes.angles_rad, system)
    return cloud if options.max_u_mm is None else cloud.select(cloud.u_mm <= options.max_u_mm)


def place_on_table(system: SystemCalibration, clouds: Sequence[PointCloud]) -> SystemCalibration:
    """The same system with z = 0 on the table top, if the clouds (made with ``system``) show it.

    The table is seen beside the part; the median over the clouds counts. Where none shows it, z = 0 stays where it is.
    """
    heights = [h for h in (find_table_height(c.points_table, c.frame) for c in clouds) if h is not None]
    if not heights:
        return system
    axis = system.rotation_axis_camera
    on_table = Line(axis.point + float(np.median(heights)) * axis.direction, axis.direction)
    return SystemCalibration(system.camera, system.laser_plane_camera, on_table, system.turn_sense, table_seen=True)


def system_at_optical_axis(system: SystemCalibration) -> SystemCalibration:
    """The same system with z = 0 at the point of the axis that is nearest to the optical axis."""
    axis = system.rotation_axis_camera
    d, p = axis.direction, axis.point
    # nearest points of the line p + s d and the line t * (0, 0, 1): solve for s with the z parts removed
    across = d[:2] @ d[:2]
    s = -(p[:2] @ d[:2]) / across if across > 1e-12 else 0.0
    return SystemCalibration(
        system.camera, system.laser_plane_camera, Line(p + s * d, d), system.turn_sense, table_seen=False
    )


def measurement_requests(session: Session) -> tuple[MeasurementRequest, ...]:
    """What the session asks for, and the artefact of every artefact capture with its stated sizes."""
    artefacts = tuple(
        MeasurementRequest(
            capture=capture.folder,
            feature="stepped-cylinder",
            name=capture.target_name,
            reference=artifact_sizes(capture.target),
            nominal=artifact_sizes(capture.target),
        )
        for capture in session.in_role("artifact")
        if isinstance(capture.target, SteppedCylinder)
    )
    return artefacts + session.measurements


def artifact_sizes(artifact: SteppedCylinder) -> dict[str, float]:
    """The stated sizes of a stepped cylinder under the names of a measurement, mm."""
    return {
        "diameter_small": artifact.diameter_small,
        "diameter_large": artifact.diameter_large,
        "height_small": artifact.height_small,
        "height_large": artifact.height_large,
    }


def measure_request(request: MeasurementRequest, cloud: PointCloud | None, options: MeasureOptions) -> MeasurementEntry:
    """One feature in one cloud; a feature that is not found becomes an entry with its failure."""
    if cloud is None or len(cloud) == 0:
        failure = "there are no points. See the warnings of the scan."
        name = request.name or request.capture
        return MeasurementEntry(request.capture, request.feature, name, None, dict(request.reference), failure)
    return _entry(request, cloud.points_table, np.asarray(cloud.viewpoints_table), options)


def _entry(
    request: MeasurementRequest,
    points: Float[np.ndarray, "n 3"],
    viewpoints: Float[np.ndarray, "n 3"] | None,
    options: MeasureOptions,
) -> MeasurementEntry:
    name = request.name or request.capture
    reference = dict(request.reference)
    try:
        measurement = measure_feature(
            points,
            request.feature,
            viewpoints=viewpoints,
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
    return _entry(request, points, None, options)
