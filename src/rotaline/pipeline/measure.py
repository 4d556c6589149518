"""Measuring the features of all captures, with the final and with the initial axis, as stored stages."""

from collections.abc import Callable, Sequence

import numpy as np

from rotaline.calibration.model import SystemCalibration
from rotaline.io.results import MeasurementEntry
from rotaline.io.session_file import MeasurementRequest
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.parts import measure_request
from rotaline.pipeline.scan import Clouds
from rotaline.pipeline.store import StageStore, key_of
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.triangulation import move_to_axis


def measure_captures(
    requests: Sequence[MeasurementRequest],
    clouds: Clouds,
    system: SystemCalibration | None,
    initial: SystemCalibration | None,
    options: Options,
    store: StageStore,
    observer: Observer,
) -> tuple[tuple[MeasurementEntry, ...], tuple[MeasurementEntry, ...]]:
    """The features asked for with the system that the clouds were made with, and as the initial axis would have had them.

    The second is empty where there is no initial axis, and the first one again where it is the same.
    """

    def entries(
        name: str, title: str, used: SystemCalibration | None, cloud_of: Callable[[str], PointCloud | None]
    ) -> tuple[MeasurementEntry, ...]:
        def compute() -> tuple[MeasurementEntry, ...]:
            with observer.work("features", len(requests)) as count:
                found = []
                for request in requests:
                    found.append(measure_request(request, cloud_of(request.capture), options.measure, used))
                    count()
                return tuple(found)

        if not requests:
            return ()
        points = {folder: (scanned.key, scanned.thinning) for folder, scanned in clouds.scanned.items()}
        asked = [r.model_dump(mode="json") for r in requests]
        # the points say which system they were made with, but not how well it is known
        known = None if system is None else (system.covariance, system.line_sigma_mm, system.stripe_blur_px)
        moved_to = None if used is system else used
        return store.get(name, title, key_of(asked, points, known, moved_to, options.measure), compute)

    def moved(capture: str) -> PointCloud | None:
        cloud = clouds.get(capture)
        return None if cloud is None or system is None or initial is None else move_to_axis(cloud, system, initial)

    final_entries = entries("measure", "Measurement", system, clouds.get)
    if system is None or initial is None:
        return final_entries, () if initial is None else final_entries
    if not _differ(system, initial):
        return final_entries, final_entries
    return final_entries, entries("measure-initial-axis", "Measurement with the initial axis", initial, moved)


def _differ(a: SystemCalibration, b: SystemCalibration) -> bool:
    first, second = a.rotation_axis_camera, b.rotation_axis_camera
    return not (np.allclose(first.point, second.point) and np.allclose(first.direction, second.direction))
