"""What is found in frames: targets, which are detected side by side, and the stripes of a row of frames as one value."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.errors import DetectionError
from rotaline.io.frame_images import read_source
from rotaline.io.session import Frame
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.workers import ThreadWorkers
from rotaline.vision.images import one_thread_per_image
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.detect import TargetOptions, detect_target
from rotaline.vision.targets.model import Target, TargetDetection

A = TypeVar("A")
B = TypeVar("B")


def work_side_by_side(function: Callable[[A], B], items: Sequence[A], observer: Observer, label: str) -> Iterator[B]:
    """``function`` of every item, in order, on all cores; no more than a few items are under way at a time."""
    one_thread_per_image()
    with observer.work(label, len(items)) as count:
        for result in ThreadWorkers().run(function, items):
            yield result
            count()


@dataclass(frozen=True, eq=False)
class DetectedFrame:
    """A frame and the target in it; ``failure`` says why there is none."""

    name: str
    angle_rad: float | None
    pose: str | None
    laser_on: bool
    detection: TargetDetection | None
    failure: str
    u_angle_rad: float = 0.0


def detect_frames(
    frames: Sequence[Frame], target: Target, options: TargetOptions, observer: Observer, label: str
) -> tuple[DetectedFrame, ...]:
    """The target in each frame, in order."""

    def detect(frame: Frame) -> DetectedFrame:
        try:
            detection, failure = detect_target(read_source(frame.source), target, options), ""
        except DetectionError as error:
            detection, failure = None, str(error)
        u_angle = frame.u_angle_rad or 0.0
        return DetectedFrame(frame.name, frame.angle_rad, frame.pose, frame.laser_on, detection, failure, u_angle)

    return tuple(work_side_by_side(detect, frames, observer, label))


@dataclass(frozen=True, eq=False)
class CaptureStripes:
    """The stripes of frames of a capture, one after another; ``frame`` says which frame a point belongs to, counted from the first of them.

    ``u_angles_rad`` are standard uncertainties of the angles, 0 where none is stated.
    """

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
    u_angles_rad: Float[np.ndarray, " f"]

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

    def points_per_frame(self) -> Int[np.ndarray, " f"]:
        """Number of points in each frame."""
        return np.bincount(self.frame, minlength=len(self.frame_names))

    def select(self, keep: Bool[np.ndarray, " n"]) -> "CaptureStripes":
        """The same frames with the points for which ``keep`` is true."""
        columns = {name: getattr(self, name)[keep] for name in _COLUMNS}
        return replace(self, **columns)


_COLUMNS = tuple(f.name for f in fields(CaptureStripes))[3:-1]


def pack_stripes(frames: Sequence[Frame], stripes: Sequence[StripePoints]) -> CaptureStripes:
    """The stripes of frames as one value; what need not be exact takes half the memory."""
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
        u_angles_rad=np.array([f.u_angle_rad or 0.0 for f in frames]),
    )


def join_stripes(parts: Sequence[CaptureStripes]) -> CaptureStripes:
    """The stripes of ranges of frames, one after the other, as those of one range."""
    first = np.cumsum([0, *(len(part.frame_names) for part in parts)])
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS[1:]}
    return CaptureStripes(
        frame_names=tuple(name for part in parts for name in part.frame_names),
        angles_rad=np.concatenate([part.angles_rad for part in parts]),
        poses=tuple(pose for part in parts for pose in part.poses),
        frame=np.concatenate([part.frame + np.int32(n) for part, n in zip(parts, first[:-1], strict=True)]),
        u_angles_rad=np.concatenate([part.u_angles_rad for part in parts]),
        **columns,
    )
