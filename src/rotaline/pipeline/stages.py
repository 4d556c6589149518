"""Which stages a session allows, before anything is done."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.session import Capture, Session
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
    stepped = [c for c in artifact if isinstance(c.target, SteppedCylinder)]
    turned = calibrated and bool(axis or (plane and stepped))
    parts = {
        "camera": calibrated,
        "laser plane": plane,
        "axis": turned,
        _mounts(artifact): plane and turned and bool(artifact),
    }
    together = [name for name, there in parts.items() if there]
    drift: tuple[PlannedStage, ...] = ()
    if session.references:
        n_captures = len({f.pose for f in session.references})
        text = f"{len(session.references)} reference frames of {n_captures} capture{'s' if n_captures > 1 else ''}"
        drift = (PlannedStage("drift", True, text),)
    return (
        PlannedStage(
            "camera", calibrated, f"{n_views} views of a target" + ("" if calibrated else "; at least 3 are needed")
        ),
        PlannedStage(
            "laser plane",
            plane,
            f"{n_poses} poses with the stripe" + ("" if n_poses >= 2 else "; at least 2 are needed"),
        ),
        PlannedStage(
            "initial axis",
            turned,
            _initial_axis(axis, artifact, stepped),
        ),
        PlannedStage("joint estimate", calibrated, ", ".join(together) or "no camera"),
        PlannedStage(
            "cross-ratio optimisation",
            plane and dots,
            "dot plate, method article" if dots else "only with a dot plate, method article",
        ),
        PlannedStage(
            "axis optimisation",
            plane and bool(stepped),
            f"{_mounts(stepped)}, method article" if stepped else "only with a stepped cylinder, method article",
        ),
        PlannedStage(
            "scan",
            plane and turned and bool(scans or artifact),
            ", ".join(c.folder for c in scans) or "no capture with role 'scan'",
        ),
        *drift,
        PlannedStage("measurement", bool(session.measurements or artifact), _features(session)),
    )


def _initial_axis(axis: tuple[Capture, ...], artifact: tuple[Capture, ...], stepped: list[Capture]) -> str:
    if axis:
        return f"{sum(len(c.off_frames) for c in axis)} frames of a target on the table"
    if stepped:
        return "no capture with role 'axis': from the stepped cylinder"
    alone = "; only a stepped cylinder shows the axis alone" if artifact else ""
    return f"no capture with role 'axis'{alone}"


def _mounts(captures: Sequence[Capture]) -> str:
    """How many mounts there are of each kind of artefact."""
    kinds = {SteppedCylinder: "a stepped cylinder", KnownCylinder: "a cylinder", KnownSphere: "a sphere"}
    counts = Counter(kind for c in captures for known, kind in kinds.items() if isinstance(c.target, known))
    return ", ".join(f"{n} mount{'s' if n > 1 else ''} of {kind}" for kind, n in counts.items())


def _features(session: Session) -> str:
    checks = sum(m.check for m in session.measurements)
    asked = f"{len(session.measurements)} feature(s) asked for"
    return f"{asked}, {checks} of them to check the calibration" if checks else asked
