"""What a verdict is based on, and the sizes that decide what matters in it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.model import JointCalibration
from rotaline.calibration.model import AxisCalibration, CameraCalibration, LaserPlaneCalibration
from rotaline.calibration.observations import SessionObservations
from rotaline.calibration.verdict.model import Finding, Level, StepVerdict
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import Line, Plane
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

_LEAST_MM = 1e-3
"""Smaller errors matter to nobody who measures with a laser line."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """All that is known of a calibration.

    Attributes
    ----------
    observations : SessionObservations
    camera, laser_plane, axis, joint : results of the stages; None where there is none
    failures : why stages failed, by step ("camera", "laser-plane", "axis", "artifact", "joint")
    u_point_mm : standard uncertainty of a point near the axis from the covariance of the joint estimate; NaN: it is estimated from the
        uncertainties of the stages
    """

    observations: SessionObservations
    camera: CameraCalibration | None = None
    laser_plane: LaserPlaneCalibration | None = None
    axis: AxisCalibration | None = None
    joint: JointCalibration | None = None
    failures: Mapping[str, str] = field(default_factory=dict)
    u_point_mm: float = float("nan")


@dataclass(frozen=True)
class Scale:
    """What counts as large for this rig.

    Attributes
    ----------
    u_noise_mm : what the stripe's own uncertainty does to a single point: what is smaller, a scan hardly shows
    reach_mm : half the shorter side of the view at the distance of the axis: how far from the axis parts reach
    depth_mm : distance of the axis, or of the targets
    """

    u_noise_mm: float
    reach_mm: float
    depth_mm: float

    @property
    def matters_mm(self) -> float:
        """Common errors below this are lost in the noise of single points."""
        return max(self.u_noise_mm, _LEAST_MM)


@dataclass(frozen=True)
class Judged:
    """A step with what was found in it."""

    step: StepVerdict
    findings: tuple[Finding, ...] = ()


def scale_of(evidence: Evidence) -> Scale:
    """From camera, laser plane and stripes; NaN noise where there is no laser plane."""
    if evidence.camera is None:
        return Scale(float("nan"), float("nan"), float("nan"))
    camera = evidence.camera.camera
    axis = axis_of(evidence)
    depths = [float(v.camera_from_board.translation[2]) for v in evidence.camera.views if v.used]
    depth = float(np.median(depths)) if axis is None else abs(float(axis.point[2]))
    reach = 0.5 * min(camera.image_size[0] / camera.fx, camera.image_size[1] / camera.fy) * depth
    plane = plane_of(evidence)
    noise = float("nan") if plane is None else _noise_mm(camera, plane, evidence.observations)
    return Scale(noise, reach, depth)


def axis_of(evidence: Evidence) -> Line | None:
    """The rotation axis from the target on the table, else from the joint estimate."""
    if evidence.axis is not None:
        return evidence.axis.axis_camera
    return evidence.joint.axis_camera if evidence.joint is not None else None


def plane_of(evidence: Evidence) -> Plane | None:
    """The laser plane from the plates, else from the joint estimate."""
    if evidence.laser_plane is not None:
        return evidence.laser_plane.plane_camera
    return evidence.joint.laser_plane_camera if evidence.joint is not None else None


def all_stripes(observations: SessionObservations) -> list[StripePoints]:
    """Stripes on the plates and on the mounts; those with points."""
    stripes = [v.stripe for v in observations.plate_views] + [s for m in observations.mounts for s in m.stripes]
    return [s for s in stripes if len(s)]


def _noise_mm(camera: CameraModel, plane: Plane, observations: SessionObservations) -> float:
    """Median over the stripes of how far a point moves when the centre moves by its uncertainty."""
    moved = []
    for stripe in (
        (s for m in observations.mounts for s in m.stripes) if observations.mounts else all_stripes(observations)
    ):
        if not len(stripe):
            continue
        here = intersect_rays_with_plane(camera.rays(stripe.uv), plane)
        there = intersect_rays_with_plane(camera.rays(stripe.uv + stripe.u_normal_px[:, None] * stripe.normal), plane)
        moved.append(np.linalg.norm(there - here, axis=1))
    return float(np.nanmedian(np.concatenate(moved))) if moved else float("nan")


def worst(levels: list[Level]) -> Level:
    """The worst of some levels; ``none`` counts least."""
    order: tuple[Level, ...] = ("none", "pass", "doubtful", "fail")
    return max(levels, key=order.index, default="none")


def level_of(size_mm: float, scale: Scale) -> Level:
    """Doubtful for an error that matters, fail for one five times as large."""
    return "fail" if size_mm > 5 * scale.matters_mm else "doubtful"


def gain_of(size_mm: float, scale: Scale) -> float:
    """How many times smaller the error of a point gets without an error of this size."""
    return float(np.hypot(size_mm, scale.matters_mm) / scale.matters_mm)


def um(value_mm: float) -> str:
    """A length for a sentence: um below a tenth of a millimetre, mm above."""
    if not np.isfinite(value_mm):
        return "unknown"
    return f"{1e3 * value_mm:.2g} um" if abs(value_mm) < 0.0995 else f"{value_mm:.3g} mm"


def rms_of(values: Float[np.ndarray, "..."]) -> float:
    """Root mean square of what is finite; NaN of nothing."""
    good = np.asarray(values)[np.isfinite(values)]
    return float(np.sqrt(np.mean(good**2))) if len(good) else float("nan")
