"""The ranges of a capture: from the store where they are done, worked on and stored where they are missing."""

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from functools import cached_property

import numpy as np
from jaxtyping import Int

from rotaline.calibration.model import SystemCalibration
from rotaline.errors import SessionError, WorkError
from rotaline.io.frame_images import read_source
from rotaline.io.session import Capture
from rotaline.pipeline.compiling import compile_if_missing, kernels_missing
from rotaline.pipeline.frames import CaptureStripes, join_stripes
from rotaline.pipeline.observer import LOG, Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.ranges import (
    RangeResult,
    RangeTask,
    backgrounds_of,
    process_range,
    program,
    range_cloud,
    spans,
)
from rotaline.pipeline.store import StageResult, StageStore, key_of, sources_key
from rotaline.scanning.cloud import PointCloud
from rotaline.vision.background import shows_same_scene
from rotaline.vision.stripe.model import StripePoints


def ranges_of(capture: Capture, options: Options, store: StageStore, observer: Observer) -> "CaptureRanges":
    """The ranges of a capture with these options; the same value as long as the store is open."""
    name = (capture.folder, options.stripe, options.scan)
    if name not in store.opened:
        store.opened[name] = CaptureRanges(capture, options, store, observer)
    ranges = store.opened[name]
    assert isinstance(ranges, CaptureRanges)
    return ranges


class CaptureRanges:
    """The stripes of a capture, range by range; an interruption loses no more than the ranges under way."""

    def __init__(self, capture: Capture, options: Options, store: StageStore, observer: Observer) -> None:
        self._folder = capture.folder
        self._frames = capture.on_frames
        self._backgrounds = backgrounds_of(capture.frames)
        self._spans = spans(len(self._frames))
        self._options = options
        self._store = store
        self._observer = observer
        self._name = f"stripes-{capture.folder}"
        self.key = key_of(
            sources_key(f.source for f in capture.frames),
            options.stripe,
            [(f.angle_rad, f.u_angle_rad) for f in capture.frames],
        )
        self._pieces = store.pieces(self._name, self.key)
        self._counts: dict[int, Int[np.ndarray, " f"]] = {}

    def results(self, system: SystemCalibration | None = None) -> Iterator[RangeResult]:
        """Every range in order, with its points if there is a ``system``; what is missing is worked on and stored.

        Raises
        ------
        WorkError
            If those who work are gone; the ranges that are done stay.
        """
        missing = {span for span in self._spans if not self._pieces.has(span[0])}
        done = len(self._spans) - len(missing)
        stripes_title = f"Stripes in {self._folder}"
        title = stripes_title if system is None else f"Scan of {self._folder}"
        self._observer.stage(title, stored=not missing)
        if missing and done:
            self._observer.note(f"{done} of {len(self._spans)} ranges of frames are there from before")
        begin = last_result = time.perf_counter()
        if missing and kernels_missing():
            self._compile()
        earlier = 0.0
        fresh = self._store.workers.run(process_range, (self._task(s, system) for s in self._spans if s in missing))
        with self._observer.work(self._folder, len(self._frames)) as count:
            try:
                for span in self._spans:
                    if span in missing:
                        result = next(fresh)
                        now = time.perf_counter()
                        self._pieces.write(span[0], StageResult(now - last_result, result.stripes))
                        last_result = now
                        done += 1
                    else:
                        result, seconds = self._stored(span, system)
                        earlier += seconds
                    self._counts[span[0]] = result.stripes.points_per_frame()
                    for _ in range(*span):
                        count()
                    yield result
            except WorkError as error:
                raise WorkError(
                    f"{error}\n{done} of {len(self._spans)} ranges of frames of {self._folder} are done and stay; "
                    "start the same command again to go on from there."
                ) from error
            finally:
                fresh.close()
        if missing:
            self._store.pieces_complete(self._name, self.key)
        if missing or system is not None:
            counted = stripes_title in self._store.seconds
            self._store.took(title, time.perf_counter() - begin, 0.0 if counted else earlier)
        else:
            self._store.seconds[title] = earlier

    def complete(self) -> None:
        """See to it that every range is there."""
        if len(self._counts) < len(self._spans):
            for _ in self.results():
                pass

    @cached_property
    def joined(self) -> CaptureStripes:
        """The stripes of all frames, in memory from now on: for captures that a calibration needs as a whole."""
        return join_stripes([result.stripes for result in self.results()])

    @property
    def frame_names(self) -> tuple[str, ...]:
        """The laser-on frames."""
        return tuple(f.name for f in self._frames)

    def points_per_frame(self) -> Int[np.ndarray, " f"]:
        """Number of stripe points in each laser-on frame."""
        self.complete()
        return np.concatenate([self._counts[first] for first, _ in self._spans])

    def stripe(self, frame: int) -> StripePoints:
        """The stripe of one laser-on frame."""
        span = next(s for s in self._spans if s[0] <= frame < s[1])
        return self._stored(span, None)[0].stripes.stripes()[frame - span[0]]

    def thinning(self) -> int:
        """Every how many points one is taken into memory: 1 unless there are more than ``scan.max_points_in_memory``."""
        most = max(1, self._options.scan.max_points_in_memory)
        return max(1, -(-int(self.points_per_frame().sum()) // most))

    def cloud(self, system: SystemCalibration) -> PointCloud:
        """The points of the capture in memory; of very many, every n-th along the stripes, through all frames."""
        step, seen = self.thinning(), 0
        clouds = []
        for span in self._spans:
            stripes = self._stored(span, None)[0].stripes
            n = len(stripes.frame)
            if step > 1:
                stripes = stripes.select((seen + np.arange(n)) % step == 0)
            seen += n
            clouds.append(range_cloud(stripes, span[0], system, self._options.scan.max_u_mm))
        names = [field.name for field in fields(PointCloud)]
        return PointCloud(*(np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in names))

    def _compile(self) -> None:
        """Compile what frames like the first one need."""
        with suppress(SessionError):  # it is named when its turn comes
            image, off = read_source(self._frames[0].source), self._backgrounds[0]
            has_background = off is not None and shows_same_scene(image, read_source(off))
            compile_if_missing(self._observer.note, image, has_background, self._options.stripe)

    def _stored(self, span: tuple[int, int], system: SystemCalibration | None) -> tuple[RangeResult, float]:
        """A range that is in the store, and the seconds that it took; one that is damaged is done again."""
        first = span[0]
        try:
            piece = self._pieces.read(first)
        except SessionError as error:
            LOG.warning("%s", error)
            start = time.perf_counter()
            result = process_range(self._task(span, None))
            piece = StageResult(time.perf_counter() - start, result.stripes)
            self._pieces.write(first, piece)
        stripes: CaptureStripes = piece.value
        cloud = None if system is None else range_cloud(stripes, first, system, self._options.scan.max_u_mm)
        return RangeResult(first, stripes, cloud), piece.seconds

    def _task(self, span: tuple[int, int], system: SystemCalibration | None) -> RangeTask:
        part = slice(*span)
        return RangeTask(
            label=self._folder,
            first_frame=span[0],
            frames=self._frames[part],
            backgrounds=self._backgrounds[part],
            options=self._options.stripe,
            system=system,
            max_u_mm=self._options.scan.max_u_mm,
            program=program(),
        )
