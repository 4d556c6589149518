"""What limits the method: one error of the rig at a time, and the setting of it that alone gives the article's figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rotaline.errors import CalibrationError, GeometryError
from rotaline.io.report.reproduction import Budget, BudgetLevel, BudgetSource
from rotaline.io.rig_file import RigFile
from rotaline.io.rig_values import shape_of
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import ARTICLE_OPTIONS
from rotaline.pipeline.reproduce.article import (
    LARGE_CYLINDER,
    MEAN_DISTANCE_MM,
    PART_TABLES,
    SMALL_CYLINDER,
    STEPPED_CYLINDER,
)
from rotaline.pipeline.reproduce.budget_sources import (
    BASE_LINE_WIDTH_MM,
    BASE_NOISE_PX,
    SOURCES,
    Conditions,
    Source,
    ideal_conditions,
)
from rotaline.pipeline.reproduce.plan import PARTS, Effort, board_on_table
from rotaline.pipeline.reproduce.sessions import render_session
from rotaline.pipeline.reproduce.virtual_rig import (
    TITLES,
    Noise,
    PartScan,
    SensorAndAxis,
    observe_capture,
    observe_sensor_and_axis,
    resulting_figures,
)
from rotaline.pipeline.reproduce.workbench import Workbench
from rotaline.pipeline.store import StageStore, key_of
from rotaline.simulation.plan import (
    CapturePlan,
    SessionPlan,
    camera_capture,
    full_turn,
    laser_capture,
    mount,
    scan_capture,
)
from rotaline.simulation.rig import Rig
from rotaline.vision.stripe.model import StripePoints

_HARDLY = 1.2
_ASTRAY_MM = 1.0
"""A larger mean distance means that no axis was found."""
_STEPPED_AT_MM, _PARTS_AT_MM = (-3.1, 2.9), (2.4, -1.3)


@dataclass(frozen=True, eq=False)
class BudgetBench:
    """What a level of the budget is worked out with."""

    rig_file: RigFile
    effort: Effort
    seed: int
    folder: Path
    store: StageStore
    observer: Observer


def make_budget(bench: BudgetBench) -> Budget:
    """Vary every source of :data:`SOURCES`, one at a time.

    Raises
    ------
    OutputError
        If rendered sessions cannot be written.
    """
    ideal = ideal_conditions(bench.rig_file)
    effort = bench.effort.budget
    chosen = [source for source in SOURCES if effort.with_images or not source.from_images]
    levels = {source.key: tuple(source.levels[i] for i in (0, *effort.levels)) for source in chosen}
    found: dict[tuple[bool | str, float], dict[str, float]] = {}
    with bench.observer.work("levels", sum(len(v) for v in levels.values())) as count:
        for source in chosen:
            for level in levels[source.key]:
                # without an error all sources are the same
                name = (source.from_images, 0.0) if level == source.levels[0] else (source.key, level)
                if name not in found:
                    found[name] = _figures(bench, source, level, source.apply(ideal, level))
                count()
    article = article_figures()
    sources = []
    for source in chosen:
        results = tuple(
            BudgetLevel(x, found[(source.from_images, 0.0) if x == source.levels[0] else (source.key, x)])
            for x in levels[source.key]
        )
        settings = {key: reproducing_setting(results, key, value) for key, value in article.items()}
        text = describe(source, results, settings, article)
        sources.append(BudgetSource(source.key, source.title, source.unit, source.from_images, results, settings, text))
    width, height = ideal.rig.camera.image_size
    text = (
        f"By the article's method, images of {width} x {height} px, one mount 4 mm off centre. All else is ideal: no mechanical errors, perfect targets, "
        f"no speckle, no read-out noise, all in focus, a line of {BASE_LINE_WIDTH_MM:g} mm. Errors of turntable, targets and laser are worked out from "
        f"observed points with a noise of {BASE_NOISE_PX:g} px. "
    )
    text += (
        "Errors that only images show, from rendered frames with the true camera, laser plane and initial axis."
        if effort.with_images
        else "Errors that only images show (speckle, noise, line width, focus, chamfer) are left out of the quick run."
    )
    return Budget(TITLES, article, tuple(sources), f"{text} {conclusion(sources, article)}")


def article_figures() -> dict[str, float]:
    """The article's figures with the keys of :data:`rotaline.pipeline.reproduce.virtual_rig.TITLES`, mm."""
    diameters = float(np.mean([SMALL_CYLINDER.average_after_mm, LARGE_CYLINDER.average_after_mm]))
    parts = {part.name: float(np.mean(table.error_mm)) for part, table in zip(PARTS, PART_TABLES, strict=True)}
    before = float(np.mean([SMALL_CYLINDER.average_before_mm, LARGE_CYLINDER.average_before_mm]))
    return {"mean_distance": MEAN_DISTANCE_MM[0], "diameters": diameters, "diameters_before": before} | parts


def reproducing_setting(levels: Sequence[BudgetLevel], key: str, target_mm: float) -> float | None:
    """The smallest setting at which a figure reaches the target; None: not within the levels, or already without the error.

    Between two levels the square of the figure is taken to grow with the square of the setting, as independent errors add.
    """
    known = [(level.setting, level.figures[key]) for level in levels if np.isfinite(level.figures.get(key, np.nan))]
    if not known or known[0][0] != levels[0].setting or known[0][1] >= target_mm:
        return None
    for (x0, y0), (x1, y1) in pairwise(known):
        if y0 < target_mm <= y1:
            return float(np.sqrt(x0**2 + (target_mm**2 - y0**2) / (y1**2 - y0**2) * (x1**2 - x0**2)))
    return None


def describe(
    source: Source, levels: Sequence[BudgetLevel], settings: Mapping[str, float | None], article: Mapping[str, float]
) -> str:
    """In words, for each figure of the article: the setting that gives it, or what the largest level does."""
    last = levels[-1]
    at_last = f"at {last.setting:g} {source.unit}".rstrip()
    parts = []
    for key, target in article.items():
        if key not in levels[0].figures:
            continue
        title, first, end, setting = TITLES[key], levels[0].figures[key], last.figures.get(key, np.nan), settings[key]
        if setting is not None:
            parts.append(f"{title} of {target:.4f} mm at {_two_digits(setting)} {source.unit}".rstrip())
        elif first >= target:
            parts.append(f"{title}: {first:.4f} mm already without it")
        elif not np.isfinite(end):
            parts.append(f"{title}: not determined any more {at_last}")
        elif end <= _HARDLY * first:
            parts.append(f"{title}: no effect, {end:.4f} mm {at_last}")
        else:
            parts.append(f"{title}: not reached, {end:.4f} mm {at_last}")
    return "; ".join(parts) + "."


def _two_digits(value: float | None) -> str:
    return "" if value is None else f"{float(f'{value:.2g}'):g}"


def conclusion(sources: Sequence[BudgetSource], article: Mapping[str, float]) -> str:
    """Which errors alone can give each of the article's figures, in words."""
    sentences = []
    for key, target in article.items():
        if not any(key in source.levels[0].figures for source in sources):
            continue
        found = [
            f"{source.title} ({_two_digits(source.reproducing[key])} {source.unit}".rstrip() + ")"
            for source in sources
            if source.reproducing[key] is not None
        ]
        sentences.append(
            f"{TITLES[key][0].upper()}{TITLES[key][1:]} of {target:.4f} mm: {', '.join(found) or 'none of them within its levels'}."
        )
    return f"What alone gives the article's figures: {' '.join(sentences)}"


def _figures(bench: BudgetBench, source: Source, level: float, conditions: Conditions) -> dict[str, float]:
    key = key_of("budget", bench.effort, bench.seed, bench.rig_file.tables.model_dump(mode="json"), source.key, level)
    title = f"Budget, {source.title} {level:g} {source.unit}".rstrip()

    def compute() -> dict[str, float]:
        name = f"budget-{source.key}-{level:g}"
        try:
            figures = (
                _from_images(bench, name, conditions) if source.from_images else _from_observations(bench, conditions)
            )
        except (CalibrationError, GeometryError):
            figures = {}
        astray = figures.get("mean_distance", np.inf) > _ASTRAY_MM
        return dict.fromkeys(TITLES, float("nan")) if astray else figures

    return bench.store.get(f"budget-{source.key}-{level:g}", title, key, compute)


def _captures(bench: BudgetBench, conditions: Conditions) -> list[CapturePlan]:
    """The stepped cylinder and the parts of the budget, one stand each."""
    rig, effort = conditions.rig, bench.effort
    stand = mount(*_STEPPED_AT_MM, tilt_deg=conditions.tilt_deg)
    captures = [
        scan_capture(
            rig,
            conditions.stepped,
            stand,
            full_turn(effort.budget.n_stepped_frames),
            folder="stepped",
            role="artifact",
            target="stepped-cylinder",
        )
    ]
    for part in PARTS:
        if part.name in effort.budget.parts:
            shape = shape_of(bench.rig_file.tables.parts[part.in_rig_file])
            captures.append(
                scan_capture(rig, shape, mount(*_PARTS_AT_MM), full_turn(effort.budget.n_part_frames), folder=part.name)
            )
    return captures


def _scans(captures: Sequence[CapturePlan], stripes: Sequence[tuple[StripePoints, ...]]) -> tuple[PartScan, ...]:
    """All captures but the first, with what is measured in them."""
    tables = {part.name: (part, table) for part, table in zip(PARTS, PART_TABLES, strict=True)}
    scans = []
    for capture, found in zip(captures[1:], stripes[1:], strict=True):
        part, table = tables[capture.folder]
        scans.append(PartScan(part.name, part.feature, part.key, table.reference_mm, found, _angles_rad(capture)))
    return tuple(scans)


def _angles_rad(capture: CapturePlan) -> Float[np.ndarray, " f"]:
    return np.radians([float(shot.angle_deg or 0.0) for shot in capture.shots])


def _from_observations(bench: BudgetBench, conditions: Conditions) -> dict[str, float]:
    rig, effort, seed = conditions.rig, bench.effort, bench.seed
    noise = Noise(conditions.noise_px, seed)
    boards = conditions.plates
    known = observe_sensor_and_axis(
        rig,
        camera_capture(rig, boards["checkerboard"], "checkerboard", effort.n_camera_views, seed),
        laser_capture(rig, boards["dots"], "dots", effort.n_laser_poses, seed),
        board_on_table(rig, boards["checkerboard"], "axis", effort, 0, seed),
        noise,
        ARTICLE_OPTIONS,
    )
    captures = _captures(bench, conditions)
    rig = conditions.rig_when_scanning()
    stripes = [observe_capture(rig, capture, noise, i) for i, capture in enumerate(captures)]
    return resulting_figures(known, stripes[0], _angles_rad(captures[0]), _scans(captures, stripes), ARTICLE_OPTIONS)


def _from_images(bench: BudgetBench, name: str, conditions: Conditions) -> dict[str, float]:
    rig = conditions.rig
    captures = _captures(bench, conditions)
    plan = SessionPlan({"stepped-cylinder": STEPPED_CYLINDER}, tuple(captures), seed=bench.seed)
    session = render_session(bench.folder, name, rig, plan, bench.observer)
    work = Workbench(session, bench.store, bench.observer)
    stripes = [work.stripes(capture.folder, ARTICLE_OPTIONS)[0].stripes() for capture in captures]
    figures = resulting_figures(
        true_knowledge(rig), stripes[0], _angles_rad(captures[0]), _scans(captures, stripes), ARTICLE_OPTIONS
    )
    return {key: value for key, value in figures.items() if not key.endswith("before")}


def true_knowledge(rig: Rig) -> SensorAndAxis:
    """Camera, laser plane and axis as the rig was made with."""
    return SensorAndAxis(rig.camera, rig.laser_plane_camera, rig.rotation_axis_camera, rig.turn_sense)
