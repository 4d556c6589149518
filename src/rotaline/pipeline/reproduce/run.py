"""The whole reproduction: render what is missing, process, compare; everything that is done is kept in the folder."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from rotaline.errors import CalibrationError, DetectionError, GeometryError, MeasurementError
from rotaline.io.report.reproduction import Reproduction, ReproductionInfo
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import ARTICLE_OPTIONS
from rotaline.pipeline.reproduce.article import STEPWISE_OPTIONS
from rotaline.pipeline.reproduce.budget import BudgetBench, make_budget
from rotaline.pipeline.reproduce.complex import complex_parts_section
from rotaline.pipeline.reproduce.experiments import (
    calibrate_all,
    initial_axis_section,
    mounts_section,
    sensor_section,
    simulation_section,
    system_of,
)
from rotaline.pipeline.reproduce.measured import claims_table, disturbed_table, parts_section, stepped_table
from rotaline.pipeline.reproduce.plan import FULL, QUICK, article_rig, complex_plans, session_plans
from rotaline.pipeline.reproduce.rows import RULE, changed_options
from rotaline.pipeline.reproduce.sessions import joined, render_session
from rotaline.pipeline.reproduce.workbench import QuietObserver, Workbench
from rotaline.pipeline.store import StageStore, check_writable
from rotaline.pipeline.summary import machine, versions
from rotaline.simulation.parts.complex_parts import complex_parts

T = TypeVar("T")


def reproduce(folder: Path, observer: Observer, *, quick: bool = False, seed: int = 1) -> Reproduction:
    """Do the article's experiments with a rendered rig.

    Parameters
    ----------
    folder : Path   sessions and stages are kept in it; a second call goes on where the first one stopped
    observer : Observer
    quick : bool   smaller images and fewer frames
    seed : int   of poses, mounts and noise

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    start = time.perf_counter()
    check_writable(folder)
    effort = QUICK if quick else FULL
    rig_file = article_rig(effort.small_images)
    rig = rig_file.rig()
    shapes = complex_parts()
    complex_sessions = complex_plans(rig, shapes, effort, seed)
    plans = {**session_plans(rig_file, effort, seed), **complex_sessions}
    sessions = {name: render_session(folder / "sessions", name, rig, plan, observer) for name, plan in plans.items()}
    store = StageStore(folder / "stages", QuietObserver(observer), keep_variants=True)
    bench = Workbench(joined(sessions), store, observer)
    attempts = _Attempts(observer, [])
    found = attempts.do("Calibration", lambda: calibrate_all(bench))
    sensor = attempts.do("Section 5.2", lambda: sensor_section(bench, rig))
    initial = mounts = stepped = disturbed = parts = complex_section = None
    if found is not None:
        initial = attempts.do("Section 5.3", lambda: initial_axis_section(bench, rig, found))
        mounts = attempts.do("Section 5.5", lambda: mounts_section(bench, rig, found))
        stepped = attempts.do("Table 2", lambda: stepped_table(bench, found))
        disturbed = attempts.do("Table 2, disturbed", lambda: disturbed_table(bench, found, rig))
        parts = attempts.do("Tables 3 to 5", lambda: parts_section(bench, found))
        final = system_of(found.together)
        complex_section = attempts.do(
            "Figure 16",
            lambda: complex_parts_section(bench, store, complex_sessions, shapes, final, rig, STEPWISE_OPTIONS),
        )
    simulation = simulation_section()
    claims = claims_table(sensor, mounts.table if mounts else None, stepped, disturbed, parts)
    limits = BudgetBench(article_rig(small_images=True), effort, seed, folder / "sessions", store, observer)
    budget = attempts.do("Budget", lambda: make_budget(limits))
    store.forget_unused()
    info = ReproductionInfo(
        quick=quick,
        rig="article",
        image_size=rig.camera.image_size,
        seeds={"poses, mounts and noise": seed, "search of features": STEPWISE_OPTIONS.measure.seed},
        rule=RULE,
        changed_options=changed_options(ARTICLE_OPTIONS, STEPWISE_OPTIONS),
        finished_at=datetime.now().astimezone().isoformat(timespec="seconds"),
        seconds=time.perf_counter() - start,
        versions=versions(),
        machine=machine(),
        n_frames=sum(plan.n_frames for plan in plans.values()),
        warnings=tuple(attempts.failures),
    )
    return Reproduction(
        info, claims, sensor, initial, simulation, mounts, stepped, disturbed, parts, complex_section, budget
    )


@dataclass(frozen=True)
class _Attempts:
    """Does one section after another; one that fails is named in ``failures``, and the others go on."""

    observer: Observer
    failures: list[str]

    def do(self, title: str, compute: Callable[[], T]) -> T | None:
        self.observer.stage(title, stored=False)
        try:
            return compute()
        except (CalibrationError, DetectionError, GeometryError, MeasurementError) as error:
            self.failures.append(f"{title}: {error}")
            self.observer.warning(self.failures[-1])
            return None
