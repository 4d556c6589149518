"""Directions of the parameter space that the data leave open, in words.

What matters is not how well a parameter is known but how far a measured point may be off. A point that the laser draws near the axis, turned back into the
table frame, moves with camera, plane and axis; most of their common errors cancel there. A few quantities that a user can picture carry what is left: how far the
axis passes from the sheet of light, how it leans against it, the scale of lengths along radius and height. Each has a standard uncertainty, and a share: by how
much the variance of points near the axis would fall if just this quantity were known.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.model import JointCalibration, JointMount, WeakDirection
from rotaline.calibration.joint.rays import RayBundle
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import KnownSphere, Line, Plane, unit
from rotaline.geometry.transforms import base_from_axis

OFF_CENTRE_MM = 3.0
"""Mounts nearer to the axis than this hardly show where it passes the laser plane."""
_RADII_MM = (2.0, 8.0, 15.0, 22.0)


@dataclass(frozen=True, eq=False)
class PointErrors:
    """How points of the sheet near the axis move in the base frame, mm per unit of each parameter of the covariance.

    ``points_base`` (n, 3); ``sensitivity`` (n, 3, p).
    """

    points_base: Float[np.ndarray, "n 3"]
    sensitivity: Float[np.ndarray, "n 3 p"]


def point_errors(found: JointCalibration) -> PointErrors | None:
    """Points of the sheet on both sides of the axis, at the heights of the mounts (without mounts: 20 mm up and down)."""
    plane, axis = found.laser_plane_camera, found.axis_camera
    if plane is None or axis is None:
        return None
    names = found.covariance.names
    pivot = found.covariance.axis_pivot_camera
    in_sheet, z = _sheet_axes(plane, axis)
    foot = pivot - float(plane.normal @ pivot + plane.offset) * plane.normal
    towards = in_sheet * (1.0 if in_sheet @ -pivot > 0 else -1.0)
    grid = [foot + r * towards + h * z for r in _RADII_MM for h in (-20.0, 0.0, 20.0)]
    points = np.array([foot, *grid])
    points = points - np.outer(points @ plane.normal + plane.offset, plane.normal)
    points = points[points[:, 2] > 0]

    uv = found.camera.project(points)
    rays = RayBundle.of(found.camera, uv)
    depth = points[:, 2]
    through = rays.directions @ plane.normal
    e1, e2 = across(plane.normal)
    offset = points - found.covariance.plane_pivot_camera
    base = base_from_axis(axis).rotation.as_matrix()
    columns = np.zeros((len(points), 3, len(names)))
    camera_names = [n for n in names if hasattr(found.camera, n)]
    for k in range(3):
        by_xy = -depth[:, None] * rays.directions[:, k : k + 1] * plane.normal[:2] / through[:, None]
        if k < 2:
            by_xy[:, k] += depth
        columns[:, k, : len(camera_names)] = rays.camera_columns(by_xy, camera_names)
    sheet = {
        "plane_turn_1": offset @ e1,
        "plane_turn_2": offset @ e2,
        "plane_offset": np.ones(len(points)),
    }
    for name, height in sheet.items():
        if name in names:
            columns[:, :, names.index(name)] = -rays.directions * (height / through)[:, None]
    in_base = np.einsum("ij,njp->nip", base, columns)
    arm = (points - pivot) @ base.T
    for i, name in enumerate(("axis_turn_x", "axis_turn_y", "axis_shift_x", "axis_shift_y")):
        if name in names:
            direction = np.eye(3)[i % 2]
            in_base[:, :, names.index(name)] = -np.cross(direction, arm) if i < 2 else -direction
    in_base[:, 2] -= in_base[0, 2]  # heights count from a point of the sheet near the axis
    return PointErrors(arm, in_base)


def u_of_points(found: JointCalibration) -> float:
    """Root mean square standard uncertainty of points near the axis from the calibration, mm; NaN without plane and axis."""
    errors = point_errors(found)
    if errors is None:
        return float("nan")
    return float(np.sqrt(_mean_variance(errors, found.covariance.matrix)))


def weak_directions(found: JointCalibration) -> tuple[WeakDirection, ...]:
    """The quantities that limit measured points, the one with the largest share first."""
    errors = point_errors(found)
    plane, axis = found.laser_plane_camera, found.axis_camera
    if errors is None or plane is None or axis is None:
        return ()
    covariance = found.covariance.matrix
    total = _mean_variance(errors, covariance)
    if not np.isfinite(total) or total <= 0:
        return ()
    out = []
    for quantity, vector, unit_name in _quantities(found, errors, plane, axis):
        variance = float(vector @ covariance @ vector)
        if variance <= 0:
            continue
        gain = covariance @ vector
        share = 1.0 - _mean_variance(errors, covariance - np.outer(gain, gain) / variance) / total
        u = float(np.sqrt(variance))
        text, action = _words(found, quantity, u, unit_name)
        out.append(WeakDirection(quantity, u, unit_name, text, action, float(np.clip(share, 0.0, 1.0))))
    return tuple(sorted(out, key=lambda w: -w.share))


def _sheet_axes(plane: Plane, axis: Line) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two directions of the sheet: across the axis, and as nearly along it as may be."""
    sideways = np.cross(axis.direction, plane.normal)
    if np.linalg.norm(sideways) < 1e-3:  # the sheet lies across the axis
        sideways = across(plane.normal)[0]
    sideways = unit(sideways)
    return sideways, unit(np.cross(plane.normal, sideways))


def _mean_variance(errors: PointErrors, covariance: Float[np.ndarray, "p p"]) -> float:
    return float(np.einsum("nip,pq,niq->", errors.sensitivity, covariance, errors.sensitivity)) / len(
        errors.points_base
    )


def _quantities(
    found: JointCalibration, errors: PointErrors, plane: Plane, axis: Line
) -> list[tuple[str, Float[np.ndarray, " p"], str]]:
    """Linear combinations of the parameters that a user can picture."""
    names = found.covariance.names
    pivot = found.covariance.axis_pivot_camera
    base = base_from_axis(axis).rotation.as_matrix()
    normal_base = base @ plane.normal
    e1, e2 = across(plane.normal)
    gap, lean = np.zeros(len(names)), np.zeros(len(names))
    arm = pivot - found.covariance.plane_pivot_camera
    for name, of_gap, of_lean in (
        ("plane_turn_1", float(e1 @ arm), float(e1 @ axis.direction)),
        ("plane_turn_2", float(e2 @ arm), float(e2 @ axis.direction)),
        ("plane_offset", 1.0, 0.0),
        ("axis_turn_x", 0.0, float(-normal_base[1])),
        ("axis_turn_y", 0.0, float(normal_base[0])),
        ("axis_shift_x", float(normal_base[0]), 0.0),
        ("axis_shift_y", float(normal_base[1]), 0.0),
    ):
        if name in names:
            gap[names.index(name)], lean[names.index(name)] = of_gap, of_lean
    points, rows = errors.points_base, errors.sensitivity
    radius = np.hypot(points[:, 0], points[:, 1])
    outward = np.column_stack([points[:, :2] / np.maximum(radius, 1e-9)[:, None], np.zeros(len(points))])
    radial = np.einsum("ni,nip->np", outward, rows)[1:]
    design = np.column_stack([np.ones(len(radial)), radius[1:] - radius[1:].mean(), points[1:, 2]])
    by_radius = np.linalg.pinv(design) @ radial
    heights = np.column_stack([np.ones(len(points)), points[:, 2], radius])
    by_height = np.linalg.pinv(heights) @ rows[:, 2]
    return [
        ("axis position across the laser plane", gap, "mm"),
        ("lean of the axis against the laser plane", lean, "rad"),
        ("radii, all alike", by_radius[0], "mm"),
        ("scale of radii", by_radius[1], "relative"),
        ("radii against height", by_radius[2], "rad"),
        ("scale of heights", by_height[1], "relative"),
    ]


def _words(found: JointCalibration, quantity: str, u: float, unit_name: str) -> tuple[str, str]:
    """What it means and what to do about it."""
    factor, unit = {"mm": (1e3, "um"), "rad": (1e6, "urad"), "relative": (1e6, "ppm")}[unit_name]
    size = f"{float(f'{u * factor:.2g}'):g} {unit}"
    cylinders = [m for m in found.mounts if not isinstance(m.artifact, KnownSphere)]
    if quantity.startswith(("axis position", "lean")):
        subject = (
            f"the axis is uncertain by {size} across the laser plane"
            if quantity.startswith("axis position")
            else f"the axis leans against the laser plane by an angle that is uncertain by {size}"
        )
        return _about_axis(found, subject, cylinders)
    if quantity in ("scale of radii", "scale of heights"):
        what = "radii" if quantity.endswith("radii") else "heights"
        source = "the sizes of the artefact" if found.mounts else "the pitch of the targets and the camera"
        text = f"{what} are uncertain by {size} of their size; the scale comes from {source}"
        action = (
            "State the tolerance of the artefact's sizes as small as its certificate allows, or use a larger artefact."
            if found.mounts
            else "Add a capture of an artefact of known size (role 'artifact')."
        )
        return text, action
    text = f"all radii are uncertain alike by {size}" if unit_name == "mm" else f"radii grow with height by {size}"
    action = (
        "Add mounts of the artefact at other places on the table, and frames over the whole turn."
        if found.mounts
        else "Add a capture of an artefact of known size (role 'artifact')."
    )
    return text, action


def _about_axis(found: JointCalibration, subject: str, mounts: list[JointMount]) -> tuple[str, str]:
    if not found.mounts:
        return (
            f"there is no artefact, so {subject}",
            "Add a stepped cylinder as artefact, 5 to 8 mm off centre; or frames of the target on the table over a larger turn.",
        )
    farthest = max((m.eccentricity_mm for m in mounts), default=0.0)
    if farthest < OFF_CENTRE_MM:
        return (
            f"the mounts are too well centred (at most {farthest:.1f} mm off): {subject}",
            "Mount the cylinder 5 to 8 mm off centre and add the capture.",
        )
    return (
        f"{subject}; the farthest mount stands {farthest:.1f} mm off centre",
        "Add a mount 5 to 8 mm off centre on the other side of the axis.",
    )
