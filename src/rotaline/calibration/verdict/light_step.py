"""The images of the session as the detectors saw them: over-exposure and defocus of the stripes."""

import numpy as np

from rotaline.calibration.verdict.evidence import Evidence, Judged, Scale, all_stripes, um
from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict
from rotaline.vision.stripe.model import StripePoints

_CLIPPED = 0.2
"""Part of the stripe that may be clipped: single bright spots are in most images."""
_WIDE_PX = 2.0
"""Standard deviation of a stripe from which its centre depends on surface and texture over more than ten pixels."""
_BLURRED = 2.0
"""A stripe this many times as wide as where it is sharpest is out of focus."""
_MUCH = 0.3


def judge_light(evidence: Evidence, scale: Scale) -> Judged:
    """Exposure and sharpness of the stripes on plates and mounts."""
    observations = evidence.observations
    stripes = all_stripes(observations)
    if not stripes:
        return Judged(StepVerdict("session", "none", "No stripe was seen in the captures that calibrate."))
    findings: list[Finding] = []
    figures: list[Figure] = []
    groups = {"plates": [v.stripe for v in observations.plate_views]}
    groups |= {m.name: list(m.stripes) for m in observations.mounts}
    clipped = {name: _clipped(own) for name, own in groups.items() if any(len(s) for s in own)}
    for name, part in clipped.items():
        figures.append(Figure(f"stripe clipped, {name}", 100 * part, "%", f"at most {100 * _CLIPPED:.0f}"))
    bad = {name: part for name, part in clipped.items() if part > _CLIPPED}
    if bad:
        where = ", ".join(f"{100 * part:.0f} % of the stripe on {name}" for name, part in bad.items())
        findings.append(
            Finding(
                "over-exposure",
                "session",
                "doubtful",
                f"Over-exposed: {where} is clipped. The top of its profile is flat, so its centre is drawn towards the brighter flank, "
                "and halos widen it.",
                "Shorten the exposure of the laser-on frames, or dim the laser, until the brightest stripe stays below full scale, and "
                "take these captures again.",
                1.0 + 2.0 * max(bad.values()),
            )
        )
    width = np.concatenate([s.width_px for s in stripes])
    width = width[np.isfinite(width)]
    if len(width):
        sharp, typical = np.percentile(width, [5, 50]).tolist()
        wide = float(np.mean(width > _BLURRED * sharp))
        figures.append(
            Figure("stripe width, sharpest and median", typical, "px", f"sharpest {sharp:.2f}, below {_WIDE_PX:g}")
        )
        if not bad and (typical > _WIDE_PX or wide > _MUCH):
            findings.append(_defocus(evidence, scale, sharp, typical, wide))
    empty = sum(not len(s) for own in groups.values() for s in own)
    total = sum(len(own) for own in groups.values())
    if empty:
        figures.append(Figure("frames without a stripe", empty, "frames", f"of {total}"))
    level: Level = "doubtful" if findings else "pass"
    text = "; ".join(f.cause for f in findings) if findings else "The stripes are neither clipped nor blurred."
    return Judged(
        StepVerdict("session", level, text[0].upper() + text[1:] + ("." if findings else ""), tuple(figures)),
        tuple(findings),
    )


def _clipped(stripes: list[StripePoints]) -> float:
    flags = np.concatenate([s.saturated for s in stripes])
    return float(flags.mean()) if len(flags) else 0.0


def _defocus(evidence: Evidence, scale: Scale, sharp: float, typical: float, wide: float) -> Finding:
    """Where the stripe is wide, in words; depth where it is sharpest, if the width follows depth."""
    if evidence.camera is not None and np.isfinite(scale.depth_mm):
        f = float(np.sqrt(evidence.camera.camera.fx * evidence.camera.camera.fy))
        size = f" ({um(typical * scale.depth_mm / f)} on the part)"
    else:
        size = ""
    if typical > _WIDE_PX:
        text = f"The stripe is wide: standard deviation {typical:.1f} px{size} at most places; a sharp one has about 1 px. "
    else:
        text = f"{100 * wide:.0f} % of the stripe is more than {_BLURRED:g} times as wide as where it is sharpest ({sharp:.1f} px). "
    return Finding(
        "defocus",
        "session",
        "doubtful",
        text
        + "The camera (or the laser) is not in focus there: noise grows with the width, and centres on edges and curved surfaces are biased.",
        "Focus the camera on the middle of the turntable and close its aperture (larger f-number), focus the laser line there, fix both, "
        "and take all captures again.",
        max(typical / 1.5, 1.0 + wide),
    )
