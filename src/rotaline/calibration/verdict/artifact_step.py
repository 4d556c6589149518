"""Consistency between the steps, with the stepped cylinder as the witness: pitches, sizes, senses and angles, moves of the camera.

Where the stripes on the artefact do not fit laser plane, axis and stated sizes, the explanations of
:mod:`rotaline.calibration.verdict.explanations` are tried; what is grossly wrong (sizes swapped, sense turned round) is put right first, so
that it does not hide the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rotaline.calibration.verdict import explanations as ways
from rotaline.calibration.verdict.artifact_case import (
    Case,
    candidates_for,
    case_of,
    expected_for,
    explain_case,
    sizes_seen,
)
from rotaline.calibration.verdict.artifact_causes import findings_of, too_well_centred, turned_round
from rotaline.calibration.verdict.artifact_sizes import gross_sizes, wrong_large_height
from rotaline.calibration.verdict.evidence import Evidence, Judged, Scale, gain_of, level_of, um, worst
from rotaline.calibration.verdict.explanations import Explained
from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict
from rotaline.calibration.verdict.plane_step import near_axis
from rotaline.calibration.verdict.steps_fit import FittedSteps, fit_steps


@dataclass(frozen=True, eq=False)
class ArtifactVerdict:
    """The steps "artifact" and "table", and what follows from them.

    ``u_point_mm``: standard uncertainty of a point near the axis from plane and axis; ``angle_factor``: true over read angle by the artefact, and
    its standard uncertainty. NaN: not known. ``angle_harmonic_rad``: amplitude of the once-per-turn error of the read-out, 0 if there is none.
    """

    artifact: Judged
    table: Judged
    u_point_mm: float = float("nan")
    angle_factor: float = float("nan")
    u_angle_factor: float = float("nan")
    angle_harmonic_rad: float = 0.0


def judge_artifact(evidence: Evidence, scale: Scale) -> ArtifactVerdict:
    """Judge what the stripes on the mounts say of all steps before."""
    if not evidence.observations.mounts:
        none = StepVerdict(
            "artifact",
            "none",
            "The session has no capture with role artifact: pitches, plane and axis are not checked by a known part.",
        )
        return ArtifactVerdict(
            Judged(none), Judged(StepVerdict("table", "none", "Without an artefact the turntable is not checked."))
        )
    if evidence.camera is None or evidence.laser_plane is None or evidence.axis is None:
        text = evidence.failures.get(
            "artifact",
            "without camera, laser plane and a target on the table the artefact cannot be used to check them",
        )
        level: Level = "fail" if evidence.observations.plate_views and evidence.laser_plane is None else "none"
        return ArtifactVerdict(
            Judged(StepVerdict("artifact", level, text[0].upper() + text[1:] + ("" if text.endswith(".") else "."))),
            Judged(StepVerdict("table", "none", "Not judged.")),
        )
    case = case_of(evidence, evidence.camera, evidence.laser_plane, evidence.axis, scale)
    if case is None:
        text = "No mount shows top disc, step and both sides of a stepped cylinder, so it is not known whether plane and axis agree with it."
        return ArtifactVerdict(
            Judged(StepVerdict("artifact", "doubtful", text)), Judged(StepVerdict("table", "none", "Not judged."))
        )
    findings = list(turned_round(case))
    artifact, gross = gross_sizes(case.artifact, *sizes_seen(case), scale)
    findings += [] if gross is None else [gross]
    case = replace(case, artifact=artifact)
    fitted = fit_steps(case.plane.plane_camera, case.axis.axis_camera, case.senses, 1.0, case.seen, artifact)
    explained = explain_case(case, fitted)
    findings += [f for f in findings_of(case, explained) if gross is None or f.cause != "wrong artefact sizes"]
    if not any(f.cause in ("wrong artefact sizes", "wrong pitch", "camera moved") for f in findings):
        u_mm, _ = near_axis(case.plane, case.axis.axis_camera, scale)
        large = wrong_large_height(artifact, [s.height_mm[1] for s in case.seen], u_mm, scale)
        findings += [] if large is None else [large]
    centred = too_well_centred(case, fitted, explained)
    findings += [] if centred is None else [centred]
    return _judged(case, fitted, explained, findings)


def _judged(case: Case, fitted: FittedSteps, explained: Explained, findings: Sequence[Finding]) -> ArtifactVerdict:
    """The two steps; findings of other steps count there."""
    u_plane = float(np.sqrt(explained.cov_state[2, 2]))
    u_axis = float(np.sqrt(np.trace(explained.cov_state[3:5, 3:5])))
    direction = fitted.pivot_camera / np.linalg.norm(fitted.pivot_camera)
    steep = max(abs(float(direction @ case.plane.plane_camera.normal)), 0.05)
    u_point = float(np.hypot(u_plane / steep, u_axis))
    own = [f for f in findings if f.step != "table"]
    of_table = [f for f in findings if f.step == "table"]
    ecc = [f"{s.name} {float(np.linalg.norm(c[:2])):.2f} mm" for s, c in zip(case.seen, fitted.centres_mm, strict=True)]
    figures = (
        Figure("groups of stripe points from the surfaces", fitted.rms_mm, "mm RMS", "with all that is wrong freed"),
        Figure(
            "disagreement with plane, axis and sizes", explained.chi2_dof, "chi-square per degree of freedom", "about 1"
        ),
        Figure("uncertainty of the axis", u_axis, "mm"),
        Figure("uncertainty of the laser plane at the axis", u_plane, "mm"),
    )
    disagree = list(own)
    if explained.chi2_dof > 2 and fitted.sigma_mm * np.sqrt(explained.chi2_dof - 1) > case.scale.matters_mm:
        size = fitted.sigma_mm * float(np.sqrt(explained.chi2_dof - 1))
        disagree.append(
            Finding(
                "steps disagree",
                "artifact",
                level_of(size, case.scale),
                f"Plane, axis and artefact do not fit each other by {um(size)}, and no single cause explains it.",
                "Do the other things named first; then check that nothing moved between the captures, and that the artefact is clean and round.",
                gain_of(size, case.scale),
            )
        )
    text = (
        "Plane, axis and artefact fit each other"
        if not disagree
        else "; ".join(dict.fromkeys(f.cause for f in disagree)).capitalize()
    )
    artifact = StepVerdict(
        "artifact",
        worst(["pass", *(f.level for f in disagree)]),
        f"{text}; mounts off the axis: {', '.join(ecc)}.",
        figures,
    )
    table = StepVerdict(
        "table",
        worst(["pass", *(f.level for f in of_table)]),
        "; ".join(dict.fromkeys(f.cause for f in of_table)).capitalize() + "."
        if of_table
        else "The turntable turns as its angles say.",
    )
    half_turn = np.pi * case.artifact.diameter_large / 2
    change, u_change = ways.tried(
        fitted, expected_for(case, fitted), candidates_for(case, fitted), explained, "angle scale"
    )
    harmonic = float(np.linalg.norm(explained.values.get("angle harmonics", 0.0))) * np.pi / half_turn
    return ArtifactVerdict(
        Judged(artifact, tuple(disagree)),
        Judged(table, tuple(of_table)),
        u_point,
        1 + change / half_turn,
        u_change / half_turn,
        harmonic,
    )
