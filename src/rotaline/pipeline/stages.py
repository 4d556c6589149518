"""Which stages a session allows, before anything is done."""

from dataclasses import dataclass

from rotaline.io.session import Session
from rotaline.vision.targets.model import DotGrid


@dataclass(frozen=True)
class PlannedStage:
    """A stage, whether the session allows it, and why (not)."""

    name: str
    possible: bool
    text: str


def planned_stages(session: Session) -> tuple[PlannedStage, ...]:
    """The stages of the chain for this session, in order."""
    camera, laser = session.in_role("camera"), session.in_role("laser-plane")
    axis, artifact, scans = session.in_role("axis"), session.in_role("artifact"), session.in_role("scan")
    n_views = len({f.name for c in camera for f in c.off_frames})
    n_poses = sum(len(c.on_frames) for c in laser)
    dots = any(isinstance(c.target, DotGrid) for c in laser)
    calibrated = n_views >= 3
    plane = calibrated and n_poses >= 2
    turned = axis or artifact
    return (
        PlannedStage(
            "camera", calibrated, f"{n_views} views of a target" + ("" if calibrated else "; at least 3 are needed")
        ),
        PlannedStage(
            "laser plane",
            plane,
            f"{n_poses} poses with the stripe" + ("" if n_poses >= 2 else "; at least 2 are needed"),
        ),
        PlannedStage("cross-ratio optimisation", plane and dots, "dot plate" if dots else "only with a dot plate"),
        PlannedStage(
            "initial axis",
            calibrated and bool(axis),
            f"{sum(len(c.off_frames) for c in axis)} frames of a target on the table"
            if axis
            else "no capture with role 'axis'",
        ),
        PlannedStage(
            "axis optimisation",
            plane and bool(artifact),
            f"{len(artifact)} mount(s) of the stepped cylinder"
            if artifact
            else "no capture with role 'artifact': the initial axis is final",
        ),
        PlannedStage(
            "scan",
            plane and bool(turned) and bool(scans or artifact),
            ", ".join(c.folder for c in scans) or "no capture with role 'scan'",
        ),
        PlannedStage(
            "measurement", bool(session.measurements or artifact), f"{len(session.measurements)} feature(s) asked for"
        ),
    )
