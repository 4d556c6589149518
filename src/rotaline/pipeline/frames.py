"""Work on frames side by side: target detection and stripe extraction, a few frames in memory at a time."""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.errors import DetectionError
from rotaline.io.frame_images import read_source
from rotaline.io.session import Capture, Frame
from rotaline.pipeline.observer import Observer
from rotaline.vision.background import shows_same_scene
from rotaline.vision.images import one_thread_per_image
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.detect import TargetOptions, detect_target
from rotaline.vision.targets.model import Target, TargetDetection

A = TypeVar("A")
B = TypeVar("B")


def work_side_by_side(function: Callable[[A], B], items: Sequence[A], observer: Observer, label: str) -> Iterator[B]:
    """``function`` of every item, in order, on all cores; no more than a few items are under way at a time."""
    one_thread_per_image()
    workers = os.cpu_count() or 1
    waiting: deque[Future[B]] = deque()
    with observer.work(label, len(items)) as count, ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
                    count()
            while waiting:
                yield waiting.popleft().result()
                count()
        finally:
            for future in waiting:
                future.cancel()


@dataclass(frozen=True, eq=False)
class DetectedFrame:
    """A frame and the target in it; ``failure`` says why there is none."""

    name: str
    angle_rad: float | None
    pose: str | None
    laser_on: bool
    detection: TargetDetection | None
    failure: str


def detect_frames(
    frames: Sequence[Frame], target: Target, options: TargetOptions, observer: Observer, label: str
) -> tuple[DetectedFrame, ...]:
    """The target in each frame, in order."""

    def detect(frame: Frame) -> DetectedFrame:
        try:
            detection, failure = detect_target(read_source(frame.source), target, options), ""
        except DetectionError as error:
            detection, failure = None, str(error)
        return DetectedFrame(frame.name, frame.angle_rad, frame.pose, frame.laser_on, detection, failure)

    return tuple(work_side_by_side(detect, frames, observer, label))


@dataclass(frozen=True, eq=False)
class CaptureStripes:
    """The stripes of a capture's frames, one after another; ``frame`` says which frame a point belongs to."""

    frame_names: tuple[str, ...]
    angles_rad: Float[np.ndarray, " f"]
    poses: tuple[str | None, ...]
    frame: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    width_px: Float[np.ndarray, " n"]
    intensity: Float[np.ndarray, " n"]
    u_normal_px: Float[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]
    segment: Int[np.ndarray, " n"]

    def stripes(self) -> tuple[StripePoints, ...]:
        """The stripe of each frame; empty where there is none."""
        starts = np.searchsorted(self.frame, np.arange(len(self.frame_names) + 1))
        return tuple(
            StripePoints(
                self.uv[a:b],
                self.normal[a:b].astype(float),
                self.width_px[a:b].astype(float),
                self.intensity[a:b].astype(float),
                self.u_normal_px[a:b].astype(float),
                self.saturated[a:b],
                self.segment[a:b].astype(int),
            )
            for a, b in pairwise(starts)
        )


def extract_capture(capture: Capture, options: StripeOptions, observer: Observer, label: str) -> CaptureStripes:
    """The stripe in every laser-on frame of a capture; laser-off frames of the same angle or pose are background."""

    def extract(frame: Frame) -> StripePoints:
        image = read_source(frame.source)
        off = capture.background_of(frame)
        background = read_source(off.source) if off is not None else None
        if background is not None and not shows_same_scene(image, background):
            background = None
        return extract_stripe(image, background, options)

    frames = capture.on_frames
    stripes = list(work_side_by_side(extract, frames, observer, label))
    small = np.float32
    return CaptureStripes(
        frame_names=tuple(f.name for f in frames),
        angles_rad=np.array([np.nan if f.angle_rad is None else f.angle_rad for f in frames]),
        poses=tuple(f.pose for f in frames),
        frame=np.repeat(np.arange(len(stripes), dtype=np.int32), [len(s) for s in stripes]),
        uv=np.concatenate([s.uv for s in stripes]),
        normal=np.concatenate([s.normal for s in stripes]).astype(small),
        width_px=np.concatenate([s.width_px for s in stripes]).astype(small),
        intensity=np.concatenate([s.intensity for s in stripes]).astype(small),
        u_normal_px=np.concatenate([s.u_normal_px for s in stripes]).astype(small),
        saturated=np.concatenate([s.saturated for s in stripes]),
        segment=np.concatenate([s.segment for s in stripes]).astype(np.int32),
    )
