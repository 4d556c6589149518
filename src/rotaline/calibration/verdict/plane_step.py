"""The laser plane: poses that do not fit, poses left out, and what its uncertainty does where parts are measured."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import special

from rotaline.calibration.model import LaserPlaneCalibration
from rotaline.calibration.stripe_on_board import PlacedStripe, place_stripe_on_board
from rotaline.calibration.verdict.evidence import Evidence, Judged, Scale, axis_of, gain_of, level_of, rms_of, um, worst
from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict
from rotaline.errors import DetectionError
from rotaline.geometry.primitives import Line, Plane, unit

_CHANCE = 1e-7
_THIN = 0.5
"""Stripes that spread less than this part of the reach of the parts are called too few depths."""
_ONE_SIDED = 3.0
"""A turn known this many times worse than the other one comes from the places of the plates, not from their scatter."""
_CLEARANCE = 2.5


@dataclass(frozen=True, eq=False)
class _Witness:
    """What one pose says of the plane: distance in the middle of the stripe and at its rms length, with standard uncertainties, mm."""

    name: str
    middle: float
    tilt: float
    u_middle: float
    u_tilt: float
    centre: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]
    rms_px: float


def judge_plane(evidence: Evidence, scale: Scale) -> Judged:
    """The step "laser-plane"."""
    views = evidence.observations.plate_views
    if not views:
        return Judged(StepVerdict("laser-plane", "none", "The session has no capture with role laser-plane."))
    witnesses = _witnesses(evidence)
    plane = evidence.laser_plane
    if plane is None:
        return _failed(evidence, witnesses, scale)
    used = [v for v in plane.views if v.used]
    u_mm, spread = near_axis(plane, axis_of(evidence), scale)
    figures = [
        Figure("distance from the plane", plane.rms_mm, "mm RMS"),
        Figure("poses used", float(len(used)), "poses", f"of {len(plane.views)}"),
        Figure("uncertainty where parts stand", u_mm, "mm", f"noise of a point {um(scale.u_noise_mm)}"),
        Figure("spread of the stripes in depth", spread, "mm RMS", f"reach of the parts {um(scale.reach_mm)}"),
    ]
    held_out = _held_out(evidence, plane)
    if np.isfinite(held_out):
        figures.append(Figure("poses held out", held_out, "mm RMS"))
    findings = [
        f
        for f in (_few_depths(plane, u_mm, spread, scale), _moved(plane, witnesses, _by_camera(evidence, scale), scale))
        if f is not None
    ]
    level: Level = worst(["pass", *(f.level for f in findings)])
    text = f"{um(plane.rms_mm)} RMS over {len(used)} of {len(plane.views)} poses, known to {um(u_mm)} where parts stand"
    text += f"; {'; '.join(f.cause for f in findings)}." if findings else "."
    return Judged(StepVerdict("laser-plane", level, text, tuple(figures)), tuple(findings))


def _failed(evidence: Evidence, witnesses: list[tuple[str, PlacedStripe]], scale: Scale) -> Judged:
    reason = evidence.failures.get("laser-plane", "there is no camera")
    finding: Finding | None = None
    if len(witnesses) >= 2:
        centres = np.array([p.points_camera.mean(axis=0) for _, p in witnesses])
        along = unit(
            np.linalg.svd(np.concatenate([p.points_camera - c for (_, p), c in zip(witnesses, centres, strict=True)]))[
                2
            ][0]
        )
        across = centres - centres.mean(axis=0)
        across = across - np.outer(across @ along, along)
        spread = rms_of(np.linalg.norm(across, axis=1))
        if spread < _THIN * scale.reach_mm:
            finding = _depths(spread, f"no plane was found ({reason})", "fail", 10.0)
    if finding is None:
        action = "Take 8 or more poses of a target in the laser sheet, near and far, each with the laser off and on."
        finding = Finding(
            "stage failed", "laser-plane", "fail", f"The laser plane was not found: {reason}", action, 100.0
        )
    if evidence.camera is None:
        return Judged(StepVerdict("laser-plane", "fail", "Without a camera there is no laser plane."))
    return Judged(StepVerdict("laser-plane", "fail", finding.text), (finding,))


def _witnesses(evidence: Evidence) -> list[tuple[str, PlacedStripe]]:
    if evidence.camera is None:
        return []
    found = []
    for view in evidence.observations.plate_views:
        as_found = replace(view, detection=evidence.camera.with_target_as_found(view.detection))
        try:
            found.append((view.name, place_stripe_on_board(evidence.camera.camera, as_found, _CLEARANCE)))
        except DetectionError:
            continue
    return found


def near_axis(plane: LaserPlaneCalibration, axis: Line | None, scale: Scale) -> tuple[float, float]:
    """Standard uncertainty of the plane over the region of parts, and rms spread of the stripes across their common direction, mm."""
    points = [v.points_camera for v in plane.views if v.used]
    centre = np.mean([p.mean(axis=0) for p in points], axis=0)
    scatter = np.mean([(p - centre).T @ (p - centre) / len(p) for p in points], axis=0)
    flat = np.eye(3) - np.outer(plane.plane_camera.normal, plane.plane_camera.normal)
    values, vectors = np.linalg.eigh(flat @ scatter @ flat)
    most, least = vectors[:, 2], vectors[:, 1]
    spread = float(np.sqrt(max(values[1], 0.0)))
    middle = centre if axis is None else axis.closest_to(_centre_of_view(plane.plane_camera, scale)[None])[0]
    middle = middle - float(plane.plane_camera.signed_distance_to(middle[None])[0]) * plane.plane_camera.normal
    arm = middle - centre
    half = scale.reach_mm / 2
    weak = plane.u_normal_rad[0] ** 2 * (float(arm @ least) ** 2 + half**2)
    strong = plane.u_normal_rad[1] ** 2 * (float(arm @ most) ** 2 + half**2)
    total = weak + strong + plane.u_offset_mm**2
    return float(np.sqrt(total)), spread


def _centre_of_view(plane: Plane, scale: Scale) -> Float[np.ndarray, "3"]:
    """Where the optical axis passes the region of parts."""
    return np.array([0.0, 0.0, scale.depth_mm])


def _few_depths(plane: LaserPlaneCalibration, u_mm: float, spread: float, scale: Scale) -> Finding | None:
    one_sided = plane.u_normal_rad[0] > _ONE_SIDED * plane.u_normal_rad[1]
    if not (2 * u_mm > scale.matters_mm and one_sided and spread < _THIN * scale.reach_mm):
        return None
    return _depths(
        spread,
        f"where parts stand, the plane is uncertain by {um(u_mm)} (k = 1)",
        level_of(2 * u_mm, scale),
        gain_of(2 * u_mm, scale),
    )


def _depths(spread: float, why: str, level: Level, gain: float) -> Finding:
    return Finding(
        "too few depths",
        "laser-plane",
        level,
        f"The stripes on the plates lie close together: they spread {um(spread)} RMS across their common direction, so the laser plane can "
        f"turn about it; {why}.",
        "Add 5 or more poses of the target in the laser sheet, some as near to the camera and some as far from it as parts will be.",
        gain,
    )


def _by_camera(evidence: Evidence, scale: Scale) -> float:
    """What the uncertainty of the focal length does to points on the plates, mm."""
    assert evidence.camera is not None
    return float(np.max(evidence.camera.u_parameters[:2])) / evidence.camera.camera.fx * scale.reach_mm


def _moved(
    plane: LaserPlaneCalibration, witnesses: list[tuple[str, PlacedStripe]], u_camera: float, scale: Scale
) -> Finding | None:
    """Poses whose stripe does not lie in the plane of the others by more than pose, camera (mm) and noise explain."""
    told = [_tell(name, placed, plane, u_camera) for name, placed in witnesses]
    if len(told) < 4:
        return None
    used = {v.name for v in plane.views if v.used}
    carried = [w for w in told if w.name in used]
    squares = sum((w.middle / w.u_middle) ** 2 + (w.tilt / w.u_tilt) ** 2 for w in carried)
    dof = 2 * len(carried) - 3
    size = rms_of(np.array([w.middle for w in carried] + [w.tilt for w in carried]))
    scatter_clear = dof > 0 and special.chdtrc(dof, squares) < _CHANCE and size > scale.matters_mm
    typical = float(np.median([np.hypot(w.middle, w.tilt) for w in carried]))
    off = []
    for w in told:
        distance = float(np.hypot(w.middle, w.tilt))
        score = max(abs(w.middle) / w.u_middle, abs(w.tilt) / w.u_tilt)
        if distance > max(scale.matters_mm, 4 * typical) and score > -special.ndtri(_CHANCE / 2):
            off.append((distance, w))
    poses_px = float(np.median([w.rms_px for w in told]))
    off = [(d, w) for d, w in off if w.rms_px < 3 * poses_px]  # a bad pose is another matter
    if off and len(off) <= len(told) // 2:
        names = ", ".join(f"{w.name} ({um(d)})" for d, w in sorted(off, key=lambda e: -e[0])[:4])
        left_out = all(w.name not in used for _, w in off)
        largest = max(d for d, _ in off)
        return Finding(
            "target moved between off and on",
            "laser-plane",
            "doubtful" if left_out else level_of(largest, scale),
            f"The stripe of {names} lies off the plane of the others (those: {um(typical)}), though its target fits its pose as well as the "
            "others: the target (or the camera) moved between the laser-off and the laser-on frame."
            + (" It was left out." if left_out else ""),
            "Clamp the target, wait after touching it, and take these poses again.",
            1.1 if left_out else gain_of(largest / np.sqrt(len(told)), scale),
        )
    if not scatter_clear:
        return None
    if _drifting(carried):
        return Finding(
            "drift",
            "laser-plane",
            level_of(size, scale),
            f"The stripes lie {um(size)} RMS off one plane, and in the order of the frames they move steadily to one side: camera or laser drifted "
            "during the capture.",
            "Let camera and laser warm up for half an hour, fix them to one stiff frame, and take the capture again.",
            gain_of(size, scale),
        )
    if _bowed(told):
        return Finding(
            "sheet not flat",
            "laser-plane",
            level_of(size, scale),
            f"The stripes lie {um(size)} RMS off one plane, and most of that follows a curved surface: the sheet of light is bowed.",
            "Let the joint estimate find the curvature (method joint), or use the middle of the fan only.",
            gain_of(size, scale),
        )
    return Finding(
        "target moved between off and on",
        "laser-plane",
        level_of(size, scale),
        f"The stripes of the {len(carried)} poses lie {um(size)} RMS off one plane, {np.sqrt(squares / dof):.0f} times what poses and noise explain: "
        "the target (or the camera) moved between laser-off and laser-on frames in many poses, or the plate is not flat.",
        "Clamp the target in every pose, trigger both frames without touching it, use a stiff flat plate, and take the capture again.",
        gain_of(size, scale),
    )


def _tell(name: str, placed: PlacedStripe, plane: LaserPlaneCalibration, u_camera: float) -> _Witness:
    """Middle and tilt of a stripe against the plane; uncertainty from the pose of the plate, the stripe's noise, and the plane itself."""
    normal = plane.plane_camera.normal
    points = placed.points_camera
    along = (placed.xy_board - placed.line_board.point) @ placed.line_board.direction
    along = along - along.mean()
    length = max(rms_of(along), 1e-9)
    operator = np.stack([np.ones(len(along)), along / length]) / len(along)
    distance = plane.plane_camera.signed_distance_to(points)
    middle, tilt = operator @ distance
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    board = placed.plane_camera.normal
    lever = (rays @ normal) / (rays @ board)
    arms = points - placed.pivot_camera
    by_pose = operator @ (lever[:, None] * np.hstack([np.cross(arms, board), np.broadcast_to(board, arms.shape)]))
    rest = distance - middle - along / length * tilt
    noise = float(np.sum(rest**2)) / max(len(rest) - 2, 1) * _alike(rest) / len(rest)
    cov = by_pose @ placed.pose.cov_pose @ by_pose.T + (noise + u_camera**2) * np.eye(2)
    direction = unit(points[-1] - points[0]) * length
    u_middle, u_tilt = np.sqrt(np.diag(cov)).tolist()
    return _Witness(
        name, float(middle), float(tilt), u_middle, u_tilt, points.mean(axis=0), direction, placed.pose.rms_px
    )


def _alike(rest: Float[np.ndarray, " n"]) -> float:
    """Neighbours that count as one, from their correlation."""
    power = float(rest @ rest)
    if len(rest) < 10 or power == 0:
        return 1.0
    correlation = min(max(float(rest[1:] @ rest[:-1]) / power, 0.0), 0.98)
    return (1 + correlation) / (1 - correlation)


def _drifting(told: list[_Witness]) -> bool:
    """Whether a plane that shifts evenly from pose to pose takes most of the distances away.

    The plane that was fitted has taken a part of the drift already, so it is fitted anew beside it.
    """
    places = np.array([w.centre for w in told])
    values = np.array([w.middle for w in told])
    flat = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][:2]
    plane = np.column_stack([np.ones(len(told)), (places - places.mean(axis=0)) @ flat.T])
    drift = np.column_stack([plane, np.arange(len(told))])
    if len(told) < 6:
        return False
    before, after = (
        float(np.sum((values - a @ np.linalg.lstsq(a, values, rcond=None)[0]) ** 2)) for a in (plane, drift)
    )
    f = (before - after) / max(after / (len(told) - 4), 1e-30)
    return bool(special.fdtrc(1, len(told) - 4, f) < 1e-3 and after < 0.3 * before)


def _bowed(told: list[_Witness]) -> bool:
    """Whether a quadratic surface takes most of the distances away, with more poses than it has parameters."""
    places = np.concatenate([[w.centre - w.along, w.centre + w.along] for w in told])
    values = np.concatenate([[w.middle - w.tilt, w.middle + w.tilt] for w in told])
    flat = np.linalg.svd(places - places.mean(axis=0))[2][:2]
    u, v = ((places - places.mean(axis=0)) @ flat.T).T
    linear = np.column_stack([np.ones_like(u), u, v])
    curved = np.column_stack([linear, u * u, u * v, v * v])
    if len(values) < 12:
        return False
    before, after = (
        float(np.sum((values - a @ np.linalg.lstsq(a, values, rcond=None)[0]) ** 2)) for a in (linear, curved)
    )
    f = (before - after) / 3 / max(after / (len(values) - 6), 1e-30)
    return bool(special.fdtrc(3, len(values) - 6, f) < 1e-3 and after < 0.5 * before)


def _held_out(evidence: Evidence, plane: LaserPlaneCalibration) -> float:
    """RMS distance of each pose from the plane through the other poses, mm: least squares without that pose."""
    points = [v.points_camera[np.linspace(0, len(v.points_camera) - 1, 20).astype(int)] for v in plane.views if v.used]
    if len(points) < 4:
        return float("nan")
    distances = []
    for k, own in enumerate(points):
        others = np.concatenate(points[:k] + points[k + 1 :])
        middle = others.mean(axis=0)
        normal = np.linalg.svd(others - middle, full_matrices=False)[2][2]
        distances.append((own - middle) @ normal)
    return rms_of(np.concatenate(distances))
