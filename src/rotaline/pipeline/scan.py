"""Scanning: captures go range by range from images, or stored stripes, to files of points; a limited number of points is in memory."""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rotaline.calibration.model import SystemCalibration
from rotaline.io.clouds import CloudWriter
from rotaline.pipeline.capture_ranges import CaptureRanges
from rotaline.scanning.cloud import PointCloud

KEPT_CLOUDS = 2
"""So many times ``scan.max_points_in_memory`` points stay in memory for those who ask for them again."""


@dataclass(frozen=True)
class ScannedCapture:
    """What is known of a scan without its points.

    Attributes
    ----------
    folder : of the capture
    n_points : in the file
    n_frames : laser on
    n_frames_without_points : of these
    frames_without_stripe : names
    thinning : every so-many-th point is taken where points are needed in memory
    key : of the points themselves: they depend on the calibration, which may come from elsewhere
    """

    folder: str
    n_points: int
    n_frames: int
    n_frames_without_points: int
    frames_without_stripe: tuple[str, ...]
    thinning: int
    key: str


def scan_capture(folder: str, ranges: CaptureRanges, system: SystemCalibration, path: Path) -> ScannedCapture:
    """Write the points of a capture into a file, as the ranges of its frames come in."""
    digest = hashlib.sha256()
    n_points = n_seen = 0
    with CloudWriter(path) as writer:
        for result in ranges.results(system):
            cloud = result.cloud
            assert cloud is not None
            writer.append(cloud)
            digest.update(np.ascontiguousarray(cloud.points_table).tobytes())
            n_points += len(cloud)
            n_seen += len(np.unique(cloud.frame))
    names = ranges.frame_names
    empty = tuple(name for name, n in zip(names, ranges.points_per_frame(), strict=True) if n == 0)
    key = digest.hexdigest()[:16]
    return ScannedCapture(folder, n_points, len(names), len(names) - n_seen, empty, ranges.thinning(), key)


class Clouds(Mapping[str, PointCloud]):
    """The clouds of captures; each is made from stored stripes when it is asked for, and few stay in memory."""

    def __init__(
        self, scanned: Mapping[str, ScannedCapture], load: Callable[[str], PointCloud], most_points: int
    ) -> None:
        self.scanned = dict(scanned)
        self._load = load
        self._most_points = most_points
        self._kept: OrderedDict[str, PointCloud] = OrderedDict()

    def __getitem__(self, folder: str) -> PointCloud:
        """The points of a capture, in memory."""
        if folder not in self.scanned:
            raise KeyError(folder)
        cloud = self._kept.pop(folder, None)
        if cloud is None:
            cloud = self._load(folder)
        self._kept[folder] = cloud
        while len(self._kept) > 1 and sum(len(kept) for kept in self._kept.values()) > self._most_points:
            self._kept.popitem(last=False)
        return cloud

    def __contains__(self, folder: object) -> bool:
        """There is such a capture."""
        return folder in self.scanned

    def __iter__(self) -> Iterator[str]:
        """The folders of the captures."""
        return iter(self.scanned)

    def __len__(self) -> int:
        """The number of captures."""
        return len(self.scanned)
