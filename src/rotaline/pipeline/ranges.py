"""One function from a range of frames to stripes and points: what runs, wherever it runs.

A capture is cut into ranges of the same number of frames, whoever works on them. So results are the same, bit for bit, by threads, processes
and on a cluster, and each range is a piece of a stage that is stored on its own.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from platform import python_version

import numpy as np

from rotaline import __version__
from rotaline.calibration.model import SystemCalibration
from rotaline.errors import WorkError
from rotaline.io.frame_images import ImageSource, read_sources
from rotaline.io.session import Frame
from rotaline.pipeline.frames import CaptureStripes, pack_stripes
from rotaline.pipeline.store import program_key
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.triangulation import scan_points
from rotaline.vision.background import shows_same_scene
from rotaline.vision.images import Image, one_thread_per_image
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe
from rotaline.vision.stripe.model import StripePoints

FRAMES_A_RANGE = 32
_SAME_ANGLE_RAD = 1e-9
_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless")


@cache
def program() -> str:
    """The program and the libraries that its numbers depend on, to the last bit."""
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return f"rotaline {__version__} (source {program_key()[:12]}), python {python_version()}, {libraries}"


@dataclass(frozen=True, eq=False)
class RangeTask:
    """Frames to work on.

    Attributes
    ----------
    label : of the capture
    first_frame : number of the first frame among the laser-on frames of the capture
    frames : laser on
    backgrounds : for each, the same view with the laser off, or None
    options : how stripes are found and measured
    system : with which points are made; None: stripes only
    max_u_mm : points with a larger standard uncertainty are left out; None: all are kept
    program : :func:`program` of who asks
    """

    label: str
    first_frame: int
    frames: tuple[Frame, ...]
    backgrounds: tuple[ImageSource | None, ...]
    options: StripeOptions
    system: SystemCalibration | None
    max_u_mm: float | None
    program: str

    def __str__(self) -> str:
        """The frames, for messages."""
        n = len(self.frames)
        return f"{self.label}, frames {self.first_frame + 1} to {self.first_frame + n} ({self.frames[0].name} to {self.frames[-1].name})"


@dataclass(frozen=True, eq=False)
class RangeResult:
    """What was found in a range of frames; ``cloud`` is None where no points were asked for."""

    first_frame: int
    stripes: CaptureStripes
    cloud: PointCloud | None


def process_range(task: RangeTask) -> RangeResult:
    """Decode and extract, some frames at a time, and triangulate.

    Raises
    ------
    SessionError
        If an image cannot be read.
    WorkError
        If this program is another one than that of who asks: results would not be the same.
    """
    if program() != task.program:
        raise WorkError(
            f"{task}: a worker runs another program than this one, so that results would differ.\n"
            f"here: {task.program}\nthere: {program()}\nInstall the same versions on all machines and start the workers again."
        )
    one_thread_per_image()
    stripes = pack_stripes(task.frames, list(_stripes(task)))
    cloud = None if task.system is None else range_cloud(stripes, task.first_frame, task.system, task.max_u_mm)
    return RangeResult(task.first_frame, stripes, cloud)


def _stripes(task: RangeTask) -> Iterator[StripePoints]:
    images = read_sources([frame.source for frame in task.frames])
    backgrounds = read_sources([source for source in task.backgrounds if source is not None])
    for image, source in zip(images, task.backgrounds, strict=True):
        background: Image | None = None if source is None else next(backgrounds)
        if background is not None and not shows_same_scene(image, background):
            background = None
        yield extract_stripe(image, background, task.options)


def range_cloud(
    stripes: CaptureStripes, first_frame: int, system: SystemCalibration, max_u_mm: float | None
) -> PointCloud:
    """The points of the frames of a range, numbered as in their capture."""
    cloud = scan_points(stripes.stripes(), stripes.angles_rad, system, first_frame, stripes.u_angles_rad)
    return cloud if max_u_mm is None else cloud.select(cloud.u_mm <= max_u_mm)


def spans(n_frames: int) -> tuple[tuple[int, int], ...]:
    """First frame, and the one after the last, of each range."""
    return tuple((a, min(a + FRAMES_A_RANGE, n_frames)) for a in range(0, n_frames, FRAMES_A_RANGE))


def backgrounds_of(frames: Sequence[Frame]) -> tuple[ImageSource | None, ...]:
    """For each laser-on frame the image of the first laser-off frame with the same angle or pose, or None."""
    off = [f for f in frames if not f.laser_on]
    by_pose: dict[str, int] = {}
    for i, frame in enumerate(off):
        if frame.pose is not None:
            by_pose.setdefault(frame.pose, i)
    turned = sorted((f.angle_rad, i) for i, f in enumerate(off) if f.angle_rad is not None)
    angles = np.array([angle for angle, _ in turned])

    def background(frame: Frame) -> ImageSource | None:
        found = [by_pose[frame.pose]] if frame.pose in by_pose else []
        if frame.angle_rad is not None:
            low, high = np.searchsorted(angles, (frame.angle_rad - _SAME_ANGLE_RAD, frame.angle_rad + _SAME_ANGLE_RAD))
            found += [i for _, i in turned[low:high]]
        return off[min(found)].source if found else None

    return tuple(background(f) for f in frames if f.laser_on)
