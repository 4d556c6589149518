"""Processing of captures chosen from a joined session, with stored results: calibration, clouds, measured features."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace

from rotaline.calibration.model import SystemCalibration
from rotaline.io.report.contents import FrameOverlay
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Capture, Session
from rotaline.io.session_file import MeasurementRequest
from rotaline.pipeline.calibrate import CalibrationParts, calibrate_session
from rotaline.pipeline.frames import CaptureStripes
from rotaline.pipeline.observe import stored_stripes
from rotaline.pipeline.observer import Observer, Silent
from rotaline.pipeline.options import Options
from rotaline.pipeline.parts import make_cloud, measure_request, system_at_optical_axis
from rotaline.pipeline.store import StageStore, key_of
from rotaline.pipeline.summary import frame_overlays
from rotaline.scanning.cloud import PointCloud


class QuietObserver(Silent):
    """Passes on the progress of long work; stages, notes and warnings of single stages go to the log only."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer

    def work(self, label: str, total: int) -> AbstractContextManager[Callable[[], None]]:
        """Show the work's progress."""
        return self._observer.work(label, total)


class Workbench:
    """A joined session; every call gives a value, from the store where it is still valid."""

    def __init__(self, session: Session, store: StageStore, observer: Observer) -> None:
        self._session = session
        self._store = store
        self._observer = QuietObserver(observer)

    @property
    def session(self) -> Session:
        """The joined session."""
        return self._session

    def capture(self, name: str) -> Capture:
        """The capture of this name."""
        return next(c for c in self._session.captures if c.folder == name)

    def calibrate(self, captures: Sequence[str], options: Options) -> CalibrationParts:
        """The calibration from some of the captures only."""
        chosen = replace(self._session, captures=tuple(self.capture(name) for name in captures))
        return calibrate_session(chosen, options, self._store, self._observer)

    def overlays(self, capture: str, options: Options) -> tuple[FrameOverlay, ...]:
        """Example frames of a capture, with what was found in them."""
        alone = replace(self._session, captures=(self.capture(capture),))
        return frame_overlays(alone, self._store, options, self._observer)

    def stripes(self, capture: str, options: Options) -> tuple[CaptureStripes, str]:
        """The stripes of a capture, and their key."""
        return stored_stripes(self.capture(capture), options, self._store, self._observer)

    def cloud(self, capture: str, system: SystemCalibration, options: Options) -> PointCloud:
        """The cloud of a capture in the table frame of ``system``."""
        return make_cloud(self.stripes(capture, options)[0], system_at_optical_axis(system), options.scan)

    def measure(
        self,
        capture: str,
        feature: str,
        reference: dict[str, float],
        system: SystemCalibration,
        options: Options,
        by: str,
    ) -> MeasurementEntry:
        """One feature in the cloud of a capture; ``by`` names the system, for the store."""
        stripes, stripe_key = self.stripes(capture, options)
        nominal = reference if feature == "stepped-cylinder" else {}
        request = MeasurementRequest.model_validate(
            {"capture": capture, "feature": feature, "reference": reference, "nominal": nominal}
        )
        key = key_of(stripe_key, system, request.model_dump(mode="json"), options.measure, options.scan)

        def compute() -> MeasurementEntry:
            cloud = make_cloud(stripes, system_at_optical_axis(system), options.scan)
            return measure_request(request, cloud, options.measure)

        return self._store.get(f"measure-{capture}-{by}", f"{feature} in {capture}, {by}", key, compute)
