"""A session of the twin at the level of observations: all that calibrates a rig, and its scans, without any image.

As with scans, geometry and noise are apart: :func:`trace_twin` once, :meth:`TracedTwin.observed` many times.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import TargetView
from rotaline.calibration.observations import MountObservation, SessionObservations
from rotaline.calibration.stripe_on_board import StripeView
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.simulation.ideal.observed_session import IdealSession, ObservedFrame, trace_session
from rotaline.simulation.plan import CapturePlan, SessionPlan
from rotaline.simulation.rig import Rig
from rotaline.simulation.truth import image_name
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import Target, TargetDetection


@dataclass(frozen=True, eq=False)
class ScanObservation:
    """The stripes of a capture of the turning table, of a part or of an artefact.

    Attributes
    ----------
    angles_rad : (f,)   as read
    stripes : (f,)   empty where nothing was seen
    frame_names : (f,)   ``folder/image``
    """

    angles_rad: Float[np.ndarray, " f"]
    stripes: tuple[StripePoints, ...]
    frame_names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class TwinSession:
    """What calibrates the rig, and the scans by folder (mounts of artefacts among them)."""

    observations: SessionObservations
    scans: dict[str, ScanObservation]


@dataclass(frozen=True, eq=False)
class TracedTwin:
    """A plan with its true observations."""

    rig: Rig
    plan: SessionPlan
    ideal: IdealSession

    def observed(self, target_px: float, stripe_px: float, seed: int, **stripe_noise: float) -> TwinSession:
        """What detectors would return.

        Parameters
        ----------
        target_px : standard deviation of the points of plates, in u and in v
        stripe_px : standard deviation of the stripe's centres along its normal
        seed : the same seed gives the same noise
        stripe_noise : correlated noise and outliers, see :meth:`rotaline.simulation.ideal.observed_scan.IdealScan.observed`
        """
        frames = self.ideal.observed(target_px, stripe_px, seed, **stripe_noise)
        captures = [_Observed(c, self.plan, frames[c.folder]) for c in self.plan.captures]
        plates = [c for c in captures if c.plan.role == "laser-plane"]
        mounts = [c for c in captures if c.plan.role == "artifact"]
        observations = SessionObservations(
            image_size=self.rig.camera.image_size,
            camera_views=tuple(v for c in captures if c.plan.role == "camera" for v in c.views()),
            preferred_folders=frozenset(c.plan.folder for c in plates),
            plate_views=tuple(v for c in plates for v in c.stripe_views()),
            table_views=next((c.views() for c in captures if c.plan.role == "axis"), ()),
            mounts=tuple(c.mount() for c in mounts),
        )
        scans = {c.plan.folder: c.scan() for c in captures if c.plan.role in ("artifact", "scan")}
        return TwinSession(observations, scans)


def trace_twin(
    rig: Rig, plan: SessionPlan, *, spacing_px: float = 1.0, edge_px: float = 3.0, min_intensity_dn: float = 2.0
) -> TracedTwin:
    """The true observations of a plan; for the parameters see :func:`rotaline.simulation.ideal.observed_session.trace_session`.

    The errors of the turntable are part of it: they are those of a session rendered from the same plan, and change with its seed.
    """
    ideal = trace_session(rig, plan, spacing_px=spacing_px, edge_px=edge_px, min_intensity_dn=min_intensity_dn)
    return TracedTwin(rig, plan, ideal)


@dataclass(frozen=True, eq=False)
class _Observed:
    """The frames of one capture, under the names of a session folder."""

    plan: CapturePlan
    session: SessionPlan
    frames: Sequence[ObservedFrame]

    def name(self, index: int) -> str:
        return f"{self.plan.folder}/{image_name(index, self.session.image_format)}"

    def stated(self) -> Target | Artifact:
        return self.session.targets[str(self.plan.target)]

    def detection(self, found: TargetDetection) -> TargetDetection:
        """On the target as the session states it."""
        target = self.stated()
        assert not isinstance(target, SteppedCylinder | KnownCylinder | KnownSphere)
        return replace(found, target=target)

    def views(self) -> tuple[TargetView, ...]:
        return tuple(
            TargetView(
                self.name(i),
                self.detection(frame.detection),
                None if frame.angle_deg is None else float(np.radians(frame.angle_deg)),
            )
            for i, frame in enumerate(self.frames)
            if frame.detection is not None
        )

    def stripe_views(self) -> tuple[StripeView, ...]:
        posed = {frame.pose: i for i, frame in enumerate(self.frames) if frame.detection is not None}
        views = []
        for i, frame in enumerate(self.frames):
            off = posed.get(frame.pose)
            if off is None or frame.stripe is None or not len(frame.stripe):
                continue
            found = self.frames[off].detection
            assert found is not None
            views.append(StripeView(self.name(i), self.detection(found), frame.stripe, self.name(off)))
        return tuple(views)

    def scan(self) -> ScanObservation:
        lit = [(i, frame) for i, frame in enumerate(self.frames) if frame.stripe is not None]
        return ScanObservation(
            np.radians([np.nan if frame.angle_deg is None else frame.angle_deg for _, frame in lit]),
            tuple(frame.stripe for _, frame in lit if frame.stripe is not None),
            tuple(self.name(i) for i, _ in lit),
        )

    def mount(self) -> MountObservation:
        scan, artifact = self.scan(), self.stated()
        assert isinstance(artifact, SteppedCylinder | KnownCylinder | KnownSphere)
        return MountObservation(self.plan.folder, artifact, scan.frame_names, scan.angles_rad, scan.stripes)
