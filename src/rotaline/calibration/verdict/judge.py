"""The verdict: every step judged, causes named, and what to do, most useful first."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from rotaline.calibration.verdict.artifact_step import ArtifactVerdict, judge_artifact
from rotaline.calibration.verdict.axis_step import angle_scale, judge_axis, with_true_angles, wrong_angle_scale
from rotaline.calibration.verdict.camera_step import judge_camera
from rotaline.calibration.verdict.evidence import Evidence, Judged, Scale, rms_of, scale_of, um, worst
from rotaline.calibration.verdict.light_step import judge_light
from rotaline.calibration.verdict.model import STEPS, Figure, Finding, Level, StepVerdict, Verdict
from rotaline.calibration.verdict.plane_step import judge_plane, near_axis

_CLEAR = 6.0
_DOUBTED = 10.0
_FAR = 3.0
"""An error this many times U is no matter of doubt."""


def judge_calibration(evidence: Evidence) -> Verdict:
    """Judge every step of a calibration, and name what spoils it.

    Each cause needs two things: it is significant against the scatter of the session itself, and it is larger than what the noise of the
    stripe does to a single point, so that the same rules hold for any rig. A wrong scale of the angles is put right before the later steps
    are compared, so that it does not look like other causes.
    """
    scale = scale_of(evidence)
    plane = judge_plane(evidence, scale)
    axis, on_table = _angles_and_artifact(_with_doubt(evidence, plane), scale)
    u_point = next(
        (u for u in (evidence.u_point_mm, on_table.u_point_mm, _u_of_stages(evidence, scale)) if np.isfinite(u)),
        float("nan"),
    )
    judged = [
        judge_light(evidence, scale),
        judge_camera(evidence, scale),
        plane,
        axis,
        on_table.artifact,
        on_table.table,
    ]
    judged.append(_scan(evidence, scale, u_point, judged))
    findings = _ordered([f for j in judged for f in j.findings])
    steps = [_with_findings(j.step, findings) for j in judged]
    steps.append(StepVerdict("measure", "none", "No measured part has been compared with a reference."))
    return _verdict(steps, findings, u_point, scale.u_noise_mm)


def _with_doubt(evidence: Evidence, plane: Judged) -> Evidence:
    """A laser plane from poses that contradict each other is off by more than their scatter says: it is not held against the artefact."""
    doubts = {"drift", "target moved between off and on", "sheet not flat"}
    found = evidence.laser_plane
    if found is None or not doubts & {f.cause for f in plane.findings}:
        return evidence
    first, second = found.u_normal_rad
    return replace(
        evidence,
        laser_plane=replace(
            found,
            u_normal_rad=(_DOUBTED * first, _DOUBTED * second),
            u_offset_mm=_DOUBTED * found.u_offset_mm,
        ),
    )


def _u_of_stages(evidence: Evidence, scale: Scale) -> float:
    """Standard uncertainty of a point near the axis from laser plane and axis of the targets, mm; NaN where one is missing."""
    if evidence.laser_plane is None or evidence.axis is None:
        return float("nan")
    u_plane, _ = near_axis(evidence.laser_plane, evidence.axis.axis_camera, scale)
    return float(np.hypot(u_plane, evidence.axis.u_position_mm))


def _angles_and_artifact(evidence: Evidence, scale: Scale) -> tuple[Judged, ArtifactVerdict]:
    """Axis and artefact; where the target on the table shows a wrong scale of the angles, the artefact over its full turn confirms it or not."""
    axis = judge_axis(evidence, scale)
    if evidence.axis is None or not any(f.cause == "wrong angle scale" for f in axis.findings):
        return axis, judge_artifact(evidence, scale)
    factor, _ = angle_scale(evidence.axis, evidence.camera)
    as_read = judge_artifact(evidence, scale)
    if _fits_as_read(as_read, factor):
        return _acquitted(axis), as_read
    corrected = judge_artifact(with_true_angles(evidence, factor), scale)
    if not _CLEAR * corrected.u_angle_factor < abs(factor - 1):
        return axis, corrected  # the artefact cannot tell
    whole, u_whole = factor * corrected.angle_factor, factor * corrected.u_angle_factor
    size = abs(whole - 1) * np.pi * scale.reach_mm
    if abs(whole - 1) < _CLEAR * u_whole or size < scale.matters_mm:
        return _acquitted(axis), as_read
    finding = wrong_angle_scale("axis", whole, u_whole, size, scale, "target and artefact")
    others = tuple(f for f in axis.findings if f.cause != "wrong angle scale")
    return Judged(axis.step, (*others, finding)), judge_artifact(with_true_angles(evidence, whole), scale)


def _fits_as_read(as_read: ArtifactVerdict, factor: float) -> bool:
    """Whether the artefact is well explained with the angles as read, and contradicts a factor: a part of a turn told wrong.

    A once-per-turn error of the read-out is such a factor, up to its amplitude, over the part of a turn that the target was seen.
    """
    causes = {f.cause for f in (*as_read.artifact.findings, *as_read.table.findings)}
    known = abs(as_read.angle_factor - factor) > _CLEAR * as_read.u_angle_factor
    harmonic = abs(factor - 1) < 2 * as_read.angle_harmonic_rad
    return (known or harmonic) and causes <= {"turntable eccentricity", "mount too well centred"}


def _acquitted(axis: Judged) -> Judged:
    """The step without the wrong scale of the angles."""
    others = tuple(f for f in axis.findings if f.cause != "wrong angle scale")
    text = axis.step.text.replace("; wrong angle scale", "")
    return Judged(replace(axis.step, level=worst(["pass", *(f.level for f in others)]), text=text), others)


def _scan(evidence: Evidence, scale: Scale, u_point: float, judged: Sequence[Judged]) -> Judged:
    """What a scan with this calibration can tell: uncertainty of a point near the axis against the noise of the stripe."""
    figures: tuple[Figure, ...] = (
        Figure("uncertainty of a point near the axis, from the calibration", u_point, "mm", "k = 1"),
        Figure("uncertainty of a single point, from the stripe's noise", scale.u_noise_mm, "mm", "k = 1"),
    )
    joint = evidence.joint
    findings = []
    if joint is not None:
        for weak in joint.weak_directions:
            if weak.unit == "mm" and weak.u > 5 * scale.matters_mm and weak.share > 0.5:
                findings.append(
                    Finding("weak direction", "scan", "doubtful", f"{weak.text}.", weak.action, 1.0 + weak.share)
                )
        held_out = rms_of(np.array([m.held_out_rms_mm for m in joint.mounts]))
        if np.isfinite(held_out):
            figures = (*figures, Figure("surfaces of mounts held out", held_out, "mm RMS"))
    if evidence.failures.get("joint"):
        findings.append(
            Finding(
                "stage failed",
                "scan",
                "doubtful",
                f"The joint estimate failed: {evidence.failures['joint']}",
                "Do the other things named first.",
                1.5,
            )
        )
    if evidence.laser_plane is None and (joint is None or joint.laser_plane_camera is None):
        return Judged(StepVerdict("scan", "none", "Without a laser plane nothing can be scanned."))
    bad = worst([f.level for j in judged for f in j.findings if j.step.step != "session"])
    level: Level = worst(["pass" if bad != "fail" else "fail", *(f.level for f in findings)])
    text = f"A point near the axis has the uncertainty {um(u_point)} from the calibration and {um(scale.u_noise_mm)} from the stripe (k = 1)"
    text += ", as far as what is named above is put right." if bad == "fail" else "."
    return Judged(StepVerdict("scan", level, text, figures), tuple(findings))


def _with_findings(step: StepVerdict, findings: Sequence[Finding]) -> StepVerdict:
    """A step is no better than what was found to spoil it, by whichever step it was found."""
    own = [f for f in findings if f.step == step.step]
    level = worst([step.level, *(f.level for f in own)])
    unsaid = [f.cause for f in own if f.cause not in step.text.lower() and f.text not in step.text]
    text = step.text if not unsaid else f"{step.text.rstrip('.')}; {', '.join(dict.fromkeys(unsaid))}."
    return replace(step, level=level, text=text)


def _ordered(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Most useful first; one finding for each cause, step and text."""
    kept: dict[tuple[str, str, str], Finding] = {(f.cause, f.step, f.text): f for f in findings}
    return tuple(sorted(kept.values(), key=lambda f: (f.level != "fail", -f.gain)))


def _verdict(steps: Sequence[StepVerdict], findings: tuple[Finding, ...], u_point: float, u_noise: float) -> Verdict:
    level = worst([s.level for s in steps])
    known = [(2 * u, by) for u, by in ((u_point, "the calibration"), (u_noise, "the stripe")) if np.isfinite(u)]
    can = f"A point is known to {' and '.join(f'{um(u)} by {by}' for u, by in known)} (k = 2)." if known else ""
    if findings:
        more = f", and {len(findings) - 1} more" if len(findings) > 1 else ""
        text = f"{findings[0].cause.capitalize()} (step {findings[0].step}){more}. {can}"
    elif level == "pass":
        text = f"No step shows an error. {can}"
    else:
        text = f"Some steps could not be judged. {can}"
    return Verdict(
        level, text.strip(), tuple(sorted(steps, key=lambda s: STEPS.index(s.step))), findings, u_point, u_noise
    )


@dataclass(frozen=True)
class MeasuredEntry:
    """A measured value with its reference: ``name`` for people ("ball, diameter"), all in mm; ``u`` is a standard uncertainty.

    ``check``: the part is a check feature of the session. ``points`` of the fit scatter by ``scatter`` (mm RMS), NaN if not known.
    """

    name: str
    value: float
    reference: float
    u: float
    check: bool = False
    scatter: float = float("nan")


def judge_measurements(verdict: Verdict, entries: Sequence[MeasuredEntry]) -> Verdict:
    """Add the step "measure": measured features against their references.

    Of many values some lie outside U (k = 2) by chance. An error that chance alone would hardly give to any of them (5 %, all together) is
    doubtful, one beyond 3 U fails, and the step that most likely made it is named: that of the gravest
    finding; without findings the kind of the errors tells (all sizes by one factor: a scale; otherwise the axis).
    """
    judged = [e for e in entries if np.isfinite([e.value, e.reference, e.u]).all()]
    others = tuple(s for s in verdict.steps if s.step != "measure")
    kept = tuple(f for f in verdict.findings if f.step != "measure")
    if not judged:
        step = StepVerdict("measure", "none", "No measured part has been compared with a reference.")
        return _verdict((*others, step), kept, verdict.u_point_mm, verdict.u_noise_mm)
    ratio = {e: abs(e.value - e.reference) / max(2 * e.u, 1e-9) for e in judged}
    figures = tuple(
        Figure(f"error of {e.name}", e.value - e.reference, "mm", f"U = {um(2 * e.u)} (k = 2)") for e in judged
    )
    by_chance = max(-float(special.ndtri(0.025 / len(judged))) / 2.0, 1.0)  # in units of U
    bad = sorted((e for e in judged if ratio[e] > by_chance), key=lambda e: -ratio[e])
    n_outside = sum(r > 1 for r in ratio.values())
    inside = f"{len(judged) - n_outside} of {len(judged)} measured values agree with their references within U (k = 2)"
    if not bad:
        text = inside + (", as many as chance allows." if n_outside else ".")
        return _verdict(
            (*others, StepVerdict("measure", "pass", text, figures)),
            kept,
            verdict.u_point_mm,
            verdict.u_noise_mm,
        )
    level: Level = "fail" if ratio[bad[0]] > _FAR else "doubtful"
    cause, action = _likely(kept, judged)
    listed = "; ".join(f"{e.name}: {um(e.value - e.reference)} with U = {um(2 * e.u)}" for e in bad[:4])
    finding = Finding("wrong result", "measure", level, f"{listed}. {cause}", action, ratio[bad[0]])
    findings = _ordered((*kept, finding))
    step = StepVerdict("measure", level, f"{inside}; off: {listed}.", figures)
    return _verdict((*others, step), findings, verdict.u_point_mm, verdict.u_noise_mm)


def _likely(findings: Sequence[Finding], entries: Sequence[MeasuredEntry]) -> tuple[str, str]:
    """Which step made the errors, and what to do."""
    if findings:
        first = findings[0]
        return f"The likely step is {first.step}: {first.cause}.", first.action
    relative = np.array([(e.value - e.reference) / e.reference for e in entries if e.reference])
    absolute = np.array([e.value - e.reference for e in entries])
    if len(relative) >= 2 and abs(relative.mean()) > 3 * relative.std() and abs(relative.mean()) > 1e-4:
        return (
            f"All values are off by about {100 * relative.mean():+.2f} %: the likely step is the scale, that is laser-plane (pitch of a target) or "
            "the sizes of the artefact.",
            "Measure the pitch of the targets and the artefact, correct session.toml, and calibrate again.",
        )
    if len(absolute) >= 2 and abs(absolute.mean()) > 3 * absolute.std():
        return (
            f"All values are off by about {um(float(absolute.mean()))}, whatever their size: the likely step is axis, whose place across the laser "
            "plane adds to every radius.",
            "Add a mount of the artefact 5 to 8 mm off centre, and calibrate again.",
        )
    return (
        "No step of the calibration shows an error: the likely step is the scan itself, or the reference.",
        "Check that the part did not slip on the table, its surface (shine, shadow, edges), and the reference value.",
    )
