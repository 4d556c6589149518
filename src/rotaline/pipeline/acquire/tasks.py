"""What a capture of a plan consists of, frame by frame; complete before anything is taken. And what of it is still missing."""

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

from rotaline.io.plan_file import TURNING, angles_of, poses_of
from rotaline.io.plan_tables import PlanCapture


@dataclass(frozen=True)
class FrameTask:
    """One frame: its file, where the table stands, whether the laser is on, at which factor of the exposure.

    ``angle_deg`` is what the table is told; None: it plays no part. ``pose`` is what ``frames.csv`` says.
    """

    image: str
    laser: bool
    angle_deg: float | None = None
    pose: str = ""
    factor: float = 1.0


@dataclass(frozen=True)
class Stop:
    """Frames that are taken one after the other while nothing moves: at one angle, or in one pose of a target."""

    index: int
    tasks: tuple[FrameTask, ...]

    @property
    def angle_deg(self) -> float | None:
        """Where the table stands."""
        return self.tasks[0].angle_deg


def stops_of(capture: PlanCapture) -> tuple[Stop, ...]:
    """All frames of a capture, stop by stop, in the order in which they are taken and listed."""
    stops: list[Stop] = []
    n = 0
    for index, (angle, pose) in enumerate(_places(capture)):
        tasks = []
        for laser, factor in _exposures(capture):
            tasks.append(FrameTask(f"{n:04d}.png", laser, angle, pose, factor))
            n += 1
        stops.append(Stop(index, tuple(tasks)))
    return tuple(stops)


def _places(capture: PlanCapture) -> list[tuple[float | None, str]]:
    if angles := angles_of(capture):
        return [(angle, "") for angle in angles]
    named = capture.role == "laser-plane"  # frames of one pose share a value
    return [(None, str(i) if named else "") for i in range(poses_of(capture))]


def _exposures(capture: PlanCapture) -> list[tuple[bool, float]]:
    off = [(False, 1.0)]
    on = [(True, factor) for factor in capture.bracket]
    if capture.role in ("camera", "axis"):
        return off
    if capture.role == "laser-plane" or capture.laser_off_frames:
        return off + on
    return on


def n_frames(capture: PlanCapture) -> int:
    """Frames of a capture."""
    return sum(len(stop.tasks) for stop in stops_of(capture))


def missing_stops(capture: PlanCapture, listed: Sequence[str], whole: Collection[str]) -> list[Stop]:
    """What has to be taken yet.

    A frame that is listed, but whose image is gone, comes again under another name: rows are never changed. The table finds an angle
    again, so single frames are taken of a stop that is not complete. Nobody holds a pose once more, so a new pose takes the place of one
    that is not complete, with all its frames and a name of its own.

    Parameters
    ----------
    capture : PlanCapture
    listed : names of the images that the table lists, in its order
    whole : names of those that are there

    Examples
    --------
    >>> ball = PlanCapture(folder="ball", role="scan", frames=4)
    >>> [stop.tasks[0].image for stop in missing_stops(ball, ["0000.png", "0001.png"], {"0000.png"})]
    ['0001-2.png', '0002.png', '0003.png']
    """
    known = set(listed)
    left = []
    for stop in stops_of(capture):
        tasks = [task for group in _groups(capture, stop) for task in _again(group, known, whole)]
        if tasks:
            left.append(replace(stop, tasks=tuple(tasks)))
    return left


def wanted_images(capture: PlanCapture, listed: Collection[str], whole: Collection[str]) -> set[str]:
    """The images that are there and are those of the plan: what was lost and taken again counts once, half a pose does not count.

    Parameters
    ----------
    capture : PlanCapture
    listed : names of the images that the table lists
    whole : names of those that are there

    Examples
    --------
    >>> plane = PlanCapture(folder="laser", role="laser-plane", poses=1)
    >>> sorted(wanted_images(plane, ["0000.png", "0001.png", "0000-2.png", "0001-2.png"], ["0001.png", "0000-2.png", "0001-2.png"]))
    ['0000-2.png', '0001-2.png']
    """
    if capture.mode == "continuous":  # frames are numbered as they come
        return set(whole)
    known = set(listed)
    return {
        task.image for stop in stops_of(capture) for g in _groups(capture, stop) for task in _there(g, known, whole)
    }


def _groups(capture: PlanCapture, stop: Stop) -> list[tuple[FrameTask, ...]]:
    """The frames of a stop that have to be taken together."""
    return [(task,) for task in stop.tasks] if capture.role in TURNING else [stop.tasks]


def _attempts(tasks: tuple[FrameTask, ...], listed: Collection[str]) -> Iterator[tuple[FrameTask, ...]]:
    """Frames that belong together under the names that they have had, and last under names that are not taken."""
    for attempt in itertools.count(1):
        these = tasks if attempt == 1 else tuple(_renamed(task, attempt) for task in tasks)
        yield these
        if not any(task.image in listed for task in these):
            return


def _there(tasks: tuple[FrameTask, ...], listed: Collection[str], whole: Collection[str]) -> tuple[FrameTask, ...]:
    """Frames that belong together, under the first names under which all are there; none if there are none."""
    return next((these for these in _attempts(tasks, listed) if all(task.image in whole for task in these)), ())


def _again(tasks: tuple[FrameTask, ...], listed: Collection[str], whole: Collection[str]) -> tuple[FrameTask, ...]:
    """Frames that belong together, under names that are not taken; none if they are there under one of their names."""
    return () if _there(tasks, listed, whole) else list(_attempts(tasks, listed))[-1]


def _renamed(task: FrameTask, attempt: int) -> FrameTask:
    image = task.image.replace(".png", f"-{attempt}.png")
    return replace(task, image=image, pose=f"{task.pose}-{attempt}" if task.pose else "")


def unfinished_pose(capture: PlanCapture, listed: Sequence[str]) -> tuple[int, int]:
    """A pose that was interrupted: its index, and how many of the last rows of the table belong to it; (0, 0): there is none."""
    if capture.role in TURNING or not listed:
        return 0, 0
    stem, _, attempt = listed[-1].removesuffix(".png").partition("-")
    for stop in stops_of(capture):
        tasks = stop.tasks if not attempt else tuple(_renamed(task, int(attempt)) for task in stop.tasks)
        names = [task.image for task in tasks]
        if f"{stem}.png" in {task.image for task in stop.tasks}:
            there = [name for name in listed if name in names]
            unfinished = len(there) < len(names) and list(listed[-len(there) :]) == there
            return (stop.index, len(there)) if unfinished else (0, 0)
    return 0, 0
