"""A whole session at the level of observations: what ideal detectors would return for every frame of a plan, without images.

As with scans, geometry and noise are apart: :func:`trace_session` once, :meth:`IdealSession.observed` many times.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rotaline.simulation.ideal.observed_scan import IdealScan, trace_frames
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.plan import CapturePlan, SessionPlan
from rotaline.simulation.rig import Rig
from rotaline.simulation.truth import true_poses
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import Target, TargetDetection


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """What was detected in one frame.

    Attributes
    ----------
    angle_deg : what the read-out said; None: the table plays no part
    pose : frames of the same pose of a plate share it
    laser_on : bool
    detection : of the plate in a laser-off frame; None: there is none, or fewer than four of its points are in the image
    stripe : in a laser-on frame, else None
    """

    angle_deg: float | None
    pose: str
    laser_on: bool
    detection: TargetDetection | None
    stripe: StripePoints | None


@dataclass(frozen=True, eq=False)
class IdealDetection:
    """Where the points of a plate truly are in the image, px; those that are in it."""

    target: Target
    ids: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]

    def observed(self, sigma_px: float, rng: np.random.Generator) -> TargetDetection:
        """With Gaussian noise in u and in v."""
        return TargetDetection(self.target, self.ids, self.uv + sigma_px * rng.standard_normal(self.uv.shape), sigma_px)


@dataclass(frozen=True, eq=False)
class IdealCapture:
    """The true points of the plates and the true stripes in the frames of one capture.

    ``detections`` has an entry for each frame, ``scan`` the frames with the laser on, in their order; its angles are NaN where the
    table plays no part.
    """

    plan: CapturePlan
    detections: tuple[IdealDetection | None, ...]
    scan: IdealScan | None

    def observed(
        self, target_px: float, stripe_px: float, seed: Sequence[int], **stripe_noise: float
    ) -> tuple[ObservedFrame, ...]:
        """All frames, with noise; see :meth:`IdealSession.observed`."""
        stripes = iter(self.scan.observed(stripe_px, [*seed, 1], **stripe_noise) if self.scan is not None else ())
        rng = np.random.default_rng([*seed, 2])
        return tuple(
            ObservedFrame(
                shot.angle_deg,
                shot.pose,
                shot.laser,
                None if ideal is None else ideal.observed(target_px, rng),
                next(stripes) if shot.laser else None,
            )
            for shot, ideal in zip(self.plan.shots, self.detections, strict=True)
        )


@dataclass(frozen=True, eq=False)
class IdealSession:
    """The true observations of a session, one capture after another."""

    captures: tuple[IdealCapture, ...]

    def observed(
        self, target_px: float, stripe_px: float, seed: int, **stripe_noise: float
    ) -> dict[str, tuple[ObservedFrame, ...]]:
        """What detectors would return, by folder.

        Parameters
        ----------
        target_px : standard deviation of the points of plates, in u and in v
        stripe_px : standard deviation of the stripe's centres along its normal
        seed : the same seed gives the same noise; a capture's noise does not depend on the others
        stripe_noise : correlated noise and outliers of the stripes, as :meth:`IdealScan.observed` takes them
        """
        return {
            capture.plan.folder: capture.observed(target_px, stripe_px, [seed, index], **stripe_noise)
            for index, capture in enumerate(self.captures)
        }


def trace_session(
    rig: Rig,
    plan: SessionPlan,
    *,
    spacing_px: float = 1.0,
    edge_px: float = 3.0,
    min_intensity_dn: float = 2.0,
) -> IdealSession:
    """The true observations of a plan, with the errors of plates and turntable that a rendered session would have.

    Parameters
    ----------
    rig, plan : as for ``write_session``; the table stands where it stands there
    spacing_px, edge_px, min_intensity_dn : see :func:`rotaline.simulation.ideal.stripe_trace.trace_stripe`
    """
    poses = true_poses(rig, plan)
    captures = []
    for capture in plan.captures:
        detections: list[IdealDetection | None] = []
        frames, tables, angles_deg = [], [], []
        for shot, pose in zip(capture.shots, poses[capture.folder], strict=True):
            parts = [*(part.moved(pose) for part in shot.on_table), *shot.held]
            detections.append(None if shot.laser else _true_detection(rig, parts))
            if shot.laser:
                frames.append(parts)
                tables.append(pose)
                angles_deg.append(np.nan if shot.angle_deg is None else shot.angle_deg)
        scan = None
        if frames:
            scan = trace_frames(
                rig,
                frames,
                tables,
                angles_deg,
                spacing_px=spacing_px,
                edge_px=edge_px,
                min_intensity_dn=min_intensity_dn,
            )
        captures.append(IdealCapture(capture, tuple(detections), scan))
    return IdealSession(tuple(captures))


_FEWEST_POINTS = 4


def _true_detection(rig: Rig, parts_base: Sequence[Placed]) -> IdealDetection | None:
    """The points of the first plate that are in the image."""
    for part in parts_base:
        if isinstance(part.shape, Plate):
            points = (rig.camera_from_base * part.frame_from_part).apply(part.shape.points_true_board())
            uv = rig.camera.project(points)
            (ids,) = np.nonzero(np.all((uv >= 0) & (uv <= np.array(rig.camera.image_size) - 1), axis=1))
            return IdealDetection(part.shape.target, ids, uv[ids]) if len(ids) >= _FEWEST_POINTS else None
    return None
