"""What is seen in the images of a session: detected targets and extracted stripes, from the store where they are still valid."""

from functools import cached_property

from rotaline.calibration.model import TargetView
from rotaline.calibration.observations import MountObservation
from rotaline.calibration.stripe_on_board import StripeView
from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.session import Capture, Session
from rotaline.pipeline.capture_ranges import ranges_of
from rotaline.pipeline.frames import CaptureStripes, DetectedFrame, detect_frames
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.stage_runner import StoredStageRunner
from rotaline.pipeline.store import StageStore, key_of, sources_key
from rotaline.vision.targets.ordering import order_sequence


class SessionSource:
    """The observations of a session folder, part by part: images are read when a stage asks for what is in them.

    The parts are those of :class:`rotaline.calibration.observations.SessionObservations`. The key of each part, and of the stripes
    of each mount (``mounts/<folder>``), goes to the runner of the stages, and what could not be seen as warnings too.
    """

    def __init__(
        self, session: Session, options: Options, store: StageStore, observer: Observer, runner: StoredStageRunner
    ) -> None:
        self._session = session
        self._options = options
        self._store = store
        self._observer = observer
        self._runner = runner

    @property
    def image_size(self) -> tuple[int, int]:
        """Width, height, px."""
        return self._session.image_size

    @property
    def roles(self) -> frozenset[str]:
        """Roles of the captures, also of those in which nothing is seen."""
        return frozenset(c.role for c in self._session.captures)

    @property
    def preferred_folders(self) -> frozenset[str]:
        """Folders of the captures that see the stripes on plates."""
        return frozenset(c.folder for c in self._session.in_role("laser-plane"))

    @cached_property
    def camera_views(self) -> tuple[TargetView, ...]:
        """Targets in role camera; a frame that is in several captures counts once."""
        views: list[TargetView] = []
        keys = []
        seen: set[str] = set()
        for capture in self._session.in_role("camera"):
            detected, key = self._detections(capture, "camera")
            keys.append(key)
            views += [
                TargetView(d.name, d.detection) for d in detected if d.detection is not None and d.name not in seen
            ]
            seen |= {d.name for d in detected}
        self._runner.keys["camera_views"] = key_of(keys)
        return tuple(views)

    @cached_property
    def plate_views(self) -> tuple[StripeView, ...]:
        """Targets with the stripe on them."""
        views: list[StripeView] = []
        keys = []
        for capture in self._session.in_role("laser-plane"):
            detected, key = self._detections(capture, "laser-plane")
            stripes, stripe_key = self._stripes(capture)
            keys += [key, stripe_key]
            views += self._stripe_views(detected, stripes)
        self._runner.keys["plate_views"] = key_of(keys)
        return tuple(views)

    @cached_property
    def table_views(self) -> tuple[TargetView, ...]:
        """The target on the turntable, its points numbered alike in all frames."""
        captures = self._session.in_role("axis")
        if not captures:
            return ()
        if len(captures) > 1:
            self._runner.warn("axis", f"only the first axis capture ({captures[0].folder}) is used of {len(captures)}.")
        detected, key = self._detections(captures[0], "axis")
        angles = [float(d.angle_rad) for d in detected if d.angle_rad is not None]
        ordered = order_sequence([d.detection for d in detected], angles)
        self._runner.keys["table_views"] = key
        return tuple(
            TargetView(d.name, detection, d.angle_rad, d.u_angle_rad)
            for d, detection in zip(detected, ordered, strict=True)
            if detection is not None
        )

    @cached_property
    def mounts(self) -> tuple[MountObservation, ...]:
        """The artefacts on the turntable."""
        mounts = []
        keys = []
        for capture in self._session.in_role("artifact"):
            artifact = capture.target
            assert isinstance(artifact, SteppedCylinder | KnownCylinder | KnownSphere)
            stripes, key = self._stripes(capture)
            self._runner.keys[f"mounts/{capture.folder}"] = key_of(key, artifact)
            keys.append(self._runner.keys[f"mounts/{capture.folder}"])
            mounts.append(
                MountObservation(
                    capture.folder,
                    artifact,
                    stripes.frame_names,
                    stripes.angles_rad,
                    stripes.stripes(),
                    stripes.u_angles_rad,
                )
            )
        self._runner.keys["mounts"] = key_of(keys)
        return tuple(mounts)

    def _detections(self, capture: Capture, stage: str) -> tuple[tuple[DetectedFrame, ...], str]:
        """The target in the frames of a capture that give its pose: the laser-off ones, and lone laser-on ones."""
        target = capture.target
        assert target is not None
        assert not isinstance(target, SteppedCylinder | KnownCylinder | KnownSphere)
        frames = capture.off_frames
        if capture.role == "laser-plane":
            posed = {f.pose for f in frames}
            frames = frames + tuple(f for f in capture.on_frames if f.pose is None or f.pose not in posed)
        listed = [(f.angle_rad, f.u_angle_rad, f.pose, f.laser_on) for f in frames]
        key = key_of(sources_key(f.source for f in frames), listed, target, self._options.targets)
        kind = "off" if len(frames) == len(capture.off_frames) else "all"
        detected = self._store.get(
            f"detect-{capture.folder}-{capture.target_name}-{kind}",
            f"Targets in {capture.folder}",
            key,
            lambda: detect_frames(frames, target, self._options.targets, self._observer, capture.folder),
        )
        lost = [d for d in detected if d.detection is None]
        if lost:
            reasons = "; ".join(f"{d.name}: {d.failure}" for d in lost[:3])
            more = f"; and {len(lost) - 3} more" if len(lost) > 3 else ""
            self._runner.warn(
                stage, f"no target in {len(lost)} of {len(detected)} frames of {capture.folder}: {reasons}{more}"
            )
        return detected, key

    def _stripe_views(self, detected: tuple[DetectedFrame, ...], stripes: CaptureStripes) -> list[StripeView]:
        by_pose = {d.pose: d for d in detected if d.pose is not None}
        by_name = {d.name: d for d in detected}
        views = []
        for name, pose, stripe in zip(stripes.frame_names, stripes.poses, stripes.stripes(), strict=True):
            match = by_name.get(name) or by_pose.get(pose or "")
            if match is None or match.detection is None:
                continue
            if len(stripe) == 0:
                self._runner.warn("laser-plane", f"no stripe in {name}.")
                continue
            views.append(StripeView(name, match.detection, stripe, match.name))
        return views

    def _stripes(self, capture: Capture) -> tuple[CaptureStripes, str]:
        return stored_stripes(capture, self._options, self._store, self._observer)


def stored_stripes(
    capture: Capture, options: Options, store: StageStore, observer: Observer
) -> tuple[CaptureStripes, str]:
    """The stripes of a capture as a whole, from the store or extracted, and their key."""
    ranges = ranges_of(capture, options, store, observer)
    return ranges.joined, ranges.key
