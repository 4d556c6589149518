"""The causes that the stripes on an artefact show, in words: what was found, why it is believed, what to do."""

import numpy as np
from jaxtyping import Float

from rotaline.calibration.verdict.artifact_case import Case, expected_for
from rotaline.calibration.verdict.artifact_sizes import wrong_sizes
from rotaline.calibration.verdict.axis_step import wrong_angle_scale
from rotaline.calibration.verdict.evidence import gain_of, level_of, um
from rotaline.calibration.verdict.explanations import Explained, explain
from rotaline.calibration.verdict.model import Finding
from rotaline.calibration.verdict.steps_fit import LEVER_MM, FittedSteps

_CENTRED = 0.25
"""Mounts nearer to the axis than this part of the small radius are centred."""


def turned_round(case: Case) -> list[Finding]:
    """Mounts whose angles run against those of the axis capture."""
    turned = [s.name for s, sense in zip(case.seen, case.senses, strict=True) if sense != case.axis.turn_sense]
    if not turned:
        return []
    return [
        Finding(
            "wrong sense",
            "table",
            "fail",
            f"The stripes of {', '.join(turned)} make a round part only if the table turns the other way than in the axis capture: angle_deg "
            "grows in opposite senses in these captures.",
            "Give angle_deg the same sign in all captures (frames.csv), and find out which ones the drive counted backwards. Scans with the wrong "
            "sense come out distorted or as mirror images.",
            100.0,
        )
    ]


def findings_of(case: Case, explained: Explained) -> list[Finding]:
    """A finding for each explanation that is needed; wrong sizes together."""
    scale, artifact = case.scale, case.artifact
    found = []
    sizes: dict[str, tuple[float, float]] = {}
    for name, values in explained.values.items():
        size = float(np.linalg.norm(values))
        u = float(np.sqrt(values @ explained.covariances[name] @ values)) / size
        if name.startswith("pitch"):
            found.append(_wrong_pitch(case, name, float(values[0]), u))
        elif name in ("small diameter", "large diameter", "small height", "all sizes"):
            sizes[name] = (float(values[0]), u)
        elif name.startswith("moved"):
            found.append(_moved(case, name, values, explained.covariances[name]))
        elif name == "angle scale":
            radius = artifact.diameter_large / 2
            factor = 1 + float(values[0]) / (np.pi * radius)
            found.append(
                wrong_angle_scale(
                    "table", factor, u / (np.pi * radius), size * scale.reach_mm / radius, scale, "the artefact"
                )
            )
        else:
            found.append(_eccentric(case, name, values, u))
    if sizes:
        found.append(wrong_sizes(artifact, sizes, scale))
    return found


def _wrong_pitch(case: Case, name: str, change_mm: float, u_mm: float) -> Finding:
    """The unknown is what the large diameter changes by when the target's true pitch is taken."""
    artifact, scale = case.artifact, case.scale
    ratio, u_ratio = 1 + change_mm / artifact.diameter_large, u_mm / artifact.diameter_large
    target = case.table_target if name == "pitch on the table" else case.plate_target
    columns, rows = target.grid_size
    size = abs(ratio - 1) * 2 * scale.reach_mm
    agree = {
        "pitch of both": "Measured with it, all sizes of the artefact are off by one factor. (The same would show if all stated sizes of the "
        "artefact were off by it.)",
        "pitch on the plates": "The distance of the laser plane fits neither the artefact nor the target on the table, by one and the same factor. "
        "(A shift of the laser or the camera along the sheet's normal, after that capture, would look the same.)",
        "pitch on the table": "The distance of the rotation axis does not fit what artefact and laser plane say, by a factor.",
    }[name]
    return Finding(
        "wrong pitch",
        "axis" if name == "pitch on the table" else "laser-plane",
        level_of(size, scale),
        f"The pitch of the target of {columns} x {rows} points is {ratio * target.pitch:.4f} mm rather than {target.pitch:g} mm "
        f"({100 * (ratio - 1):+.3f} +- {200 * u_ratio:.1g} %). {agree} Over a part of {2 * scale.reach_mm:.0f} mm that is {um(size)}.",
        "Measure the target over its whole length with a caliper or on a glass scale, state the pitch in session.toml, and calibrate again.",
        gain_of(size, scale),
    )


def _moved(case: Case, name: str, values: Float[np.ndarray, " k"], cov: Float[np.ndarray, "k k"]) -> Finding:
    scale = case.scale
    if len(values) == 3:
        shift, turn = abs(float(values[2])), float(np.linalg.norm(values[:2])) / LEVER_MM
        between = "between the capture of the plates and the captures on the turntable"
        what = f"the laser plane stands {um(shift)} and {1e3 * turn:.2g} mrad from where the plates showed it"
        alternative = "camera or laser moved"
    else:
        # the components that the data show: those along which a move is known to better than itself
        known = np.sqrt(np.diag(cov)) < 0.3 * np.linalg.norm(values[:3]) + 0.01
        shift = float(np.linalg.norm(values[:3][known[:3]])) if known[:3].any() else float(np.linalg.norm(values[:3]))
        turn = float(np.linalg.norm(values[3:])) / LEVER_MM
        if name == "moved before the mounts":
            between = "between the captures of the targets and the mounts of the artefact"
        else:
            k = int(name.rsplit(" ", 1)[1])
            between = f"between {case.seen[k - 1].name} and {case.seen[k].name}"
        what = (
            f"laser plane and axis stand about {um(shift)} and {1e3 * turn:.2g} mrad elsewhere as the camera sees them"
        )
        alternative = "the camera moved"
    size = max(shift, turn * scale.reach_mm)
    return Finding(
        "camera moved",
        "artifact",
        level_of(size, scale),
        f"{alternative[0].upper() + alternative[1:]} {between}: {what}.",
        "Fix camera and laser to one stiff frame, lead their cables off, and take all captures again without touching them.",
        gain_of(size, scale),
    )


def _eccentric(case: Case, name: str, values: Float[np.ndarray, " k"], u_mm: float) -> Finding:
    amplitude = float(np.linalg.norm(values))
    scale, radius = case.scale, case.artifact.diameter_large / 2
    if name == "run-out":
        size = amplitude
        text = (
            f"The rotation axis moves during a turn (run-out): {um(2 * amplitude)} in amplitude, of which {um(amplitude)} (+- {um(2 * u_mm)}) spoil "
            "the shape of parts."
        )
        action = "Check bearing and play of the spindle; measure with the part near the axis, and average over several mounts."
    else:
        size = amplitude * scale.reach_mm / radius
        text = (
            f"The angle read-out errs once per turn by {np.degrees(amplitude / radius):.3g} deg (+- {np.degrees(2 * u_mm / radius):.1g}), "
            f"{um(size)} at the edge of a part: its disc or gear is mounted off centre."
        )
        action = 'Centre the encoder disc or the gear; or let the joint estimate correct it ("angle harmonics").'
    return Finding("turntable eccentricity", "table", level_of(size, scale), text, action, gain_of(size, scale))


def too_well_centred(case: Case, fitted: FittedSteps, explained: Explained) -> Finding | None:
    """Whether the mounts are too near to the axis to tell where it is."""
    largest = float(np.linalg.norm(fitted.centres_mm[:, :2], axis=1).max())
    if largest > _CENTRED * case.artifact.diameter_small / 2:
        return None
    alone = explain(fitted, expected_for(case, fitted, free_axis=True), {}, {})
    u_alone = _u_axis(alone)
    u_axis = _u_axis(explained)
    if not u_alone > 2 * case.scale.matters_mm:
        return None
    rest = (
        f" The target on the table gives it to {um(u_axis)}, but the artefact does not confirm that."
        if u_axis < 0.5 * u_alone
        else ""
    )
    return Finding(
        "mount too well centred",
        "artifact",
        "fail" if u_axis > 5 * case.scale.matters_mm else "doubtful",
        f"All mounts of the artefact stand at most {um(largest)} off the rotation axis, so every frame shows nearly the same points: by the artefact "
        f"alone the axis is uncertain by {um(u_alone)} across the laser plane.{rest}",
        f"Add a capture of the artefact {0.5 * case.artifact.diameter_small / 2:.0f} to {0.7 * case.artifact.diameter_small / 2:.0f} mm off centre.",
        max(gain_of(u_axis, case.scale), 1.2),
    )


def _u_axis(explained: Explained) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(explained.cov_state[3:5, 3:5]).max()))
