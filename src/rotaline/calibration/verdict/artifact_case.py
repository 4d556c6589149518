"""A session with a stepped cylinder, as the explanations need it: plane, axis, stripes on the mounts, and what may be wrong with them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import AxisCalibration, CameraCalibration, LaserPlaneCalibration
from rotaline.calibration.verdict import explanations as ways
from rotaline.calibration.verdict.evidence import Evidence, Scale
from rotaline.calibration.verdict.explanations import Expected, Explained, Explanation, explain
from rotaline.calibration.verdict.steps_fit import (
    ANGLE_HARMONIC,
    ANGLE_SCALE,
    LEVER_MM,
    PLANE,
    RUN_OUT,
    SIZES,
    FittedSteps,
    roundness_mm,
    seen_sizes,
)
from rotaline.calibration.verdict.steps_seen import SeenSteps, see_steps
from rotaline.geometry.primitives import SteppedCylinder
from rotaline.vision.targets.model import Target

_TURNED_ROUND = 0.5
"""The other sense is right if the stripes are this much rounder with it."""


@dataclass(frozen=True, eq=False)
class Case:
    """What the explanations start from; ``senses`` of the turntable, for each mount."""

    camera: CameraCalibration
    plane: LaserPlaneCalibration
    axis: AxisCalibration
    seen: tuple[SeenSteps, ...]
    senses: tuple[int, ...]
    artifact: SteppedCylinder
    plate_target: Target
    table_target: Target
    scale: Scale

    @property
    def u_camera_mm(self) -> float:
        """What the uncertainty of the focal length does over the lever of the state, mm: common to plane and axis."""
        return float(np.max(self.camera.u_parameters[:2]) / self.camera.camera.fx) * LEVER_MM


def case_of(
    evidence: Evidence, camera: CameraCalibration, plane: LaserPlaneCalibration, axis: AxisCalibration, scale: Scale
) -> Case | None:
    """The mounts that show a whole staircase; None if none does."""
    seen = []
    stated = [m.artifact for m in evidence.observations.mounts if isinstance(m.artifact, SteppedCylinder)]
    for mount in evidence.observations.mounts:
        if not stated or mount.artifact != stated[0]:
            continue
        found = see_steps(camera.camera, plane.plane_camera, axis.axis_camera, mount)
        if found is not None:
            seen.append(found)
    if not seen:
        return None
    senses = []
    for one in seen:
        same, other = (
            roundness_mm(plane.plane_camera, axis.axis_camera, s * axis.turn_sense, 1.0, one) for s in (1, -1)
        )
        senses.append(
            -axis.turn_sense
            if other < _TURNED_ROUND * same and same - other > 5 * scale.matters_mm
            else axis.turn_sense
        )
    return Case(
        camera,
        plane,
        axis,
        tuple(seen),
        tuple(senses),
        stated[0],
        evidence.observations.plate_views[0].detection.target,
        evidence.observations.table_views[0].detection.target,
        scale,
    )


def sizes_seen(case: Case) -> tuple[Float[np.ndarray, "3"], float]:
    """Small and large radius and upper height as seen at once; the large height, NaN if no table top is seen; mm."""
    sizes = seen_sizes(case.plane.plane_camera, case.axis.axis_camera, case.senses, 1.0, case.seen)
    large = [s.height_mm[1] for s in case.seen if np.isfinite(s.height_mm[1])]
    return sizes, float(np.median(large)) if large else float("nan")


def expected_for(case: Case, fitted: FittedSteps, free_axis: bool = False) -> Expected:
    """What plates, target on the table and stated sizes say; with ``free_axis`` the target on the table says nothing."""
    points = np.concatenate([v.points_camera for v in case.plane.views if v.used])
    cov_plane, cov_axis = ways.expected_from(
        case.plane.plane_camera,
        case.axis.axis_camera,
        fitted.pivot_camera,
        points,
        case.plane.u_normal_rad,
        case.plane.u_offset_mm,
        (
            float(np.nan_to_num(case.axis.u_direction_rad, nan=1e-2)),
            float(np.nan_to_num(case.axis.u_position_mm, nan=1.0)),
        ),
        case.u_camera_mm,
    )
    sizes = np.array([case.artifact.diameter_small / 2, case.artifact.diameter_large / 2, case.artifact.height_small])
    return Expected(
        cov_plane, cov_axis * (1e8 if free_axis else 1.0), sizes - fitted.start_sizes, case.artifact.tolerance
    )


def candidates_for(case: Case, fitted: FittedSteps) -> dict[str, Explanation]:
    """All explanations that the session can tell apart, by name."""
    plane, axis, artifact = case.plane.plane_camera, case.axis.axis_camera, case.artifact
    plane_scaled = ways.plane_scaled(fitted, plane, artifact.diameter_large)
    axis_scaled = ways.axis_scaled(fitted, axis, artifact.diameter_large)
    if case.plate_target == case.table_target:
        columns = {"pitch of both": plane_scaled + axis_scaled}
    else:
        columns = {"pitch on the plates": plane_scaled, "pitch on the table": axis_scaled}
        columns["all sizes"] = ways.sizes_scaled(fitted, artifact)
    for k, name in enumerate(("small diameter", "large diameter", "small height")):
        columns[name] = ways.columns_of(fitted, slice(SIZES.start + k, SIZES.start + k + 1))
    columns["moved after the plates"] = ways.columns_of(fitted, PLANE)
    columns["moved before the mounts"] = ways.camera_moved(fitted, plane, axis)
    for k in range(1, fitted.n_mounts):
        columns[f"moved before mount {k}"] = ways.columns_of(fitted, fitted.move(k))
    columns["angle scale"] = ways.columns_of(fitted, ANGLE_SCALE)
    columns["angle harmonics"] = ways.columns_of(fitted, ANGLE_HARMONIC)
    columns["run-out"] = ways.columns_of(fitted, RUN_OUT)
    return {name: Explanation(name, c) for name, c in columns.items()}


def explain_case(case: Case, fitted: FittedSteps) -> Explained:
    """Twice where the turntable errs: the axis from a part of a turn is off by as much, which is no further cause."""
    candidates = candidates_for(case, fitted)
    least = dict.fromkeys(candidates, case.scale.matters_mm)
    explained = explain(fitted, expected_for(case, fitted), candidates, least)
    table = [explained.values[name] for name in ("run-out", "angle harmonics") if name in explained.values]
    if not table:
        return explained
    expected = expected_for(case, fitted)
    off = float(3 * np.sqrt(sum(v @ v for v in table)))
    return explain(fitted, replace(expected, cov_axis=expected.cov_axis + off**2 * np.eye(4)), candidates, least)
