"""What ``rotaline reproduce`` found: the article's tables and figures beside ours, as plain values.

Every figure of ours comes twice: by the method of the article, and by the default method of this program, from the same images.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from rotaline.calibration.model import (
    ArtifactCalibration,
    AxisCalibration,
    CameraCalibration,
    CrossRatioResult,
    LaserPlaneCalibration,
)
from rotaline.geometry.primitives import Line, SteppedCylinder
from rotaline.io.report.contents import FittedPoints, FrameOverlay
from rotaline.io.results import MeasurementEntry

Verdict = Literal["better", "equal", "worse", "none"]
"""``none``: there is nothing to compare, in the article or here."""


@dataclass(frozen=True)
class Comparison:
    """One figure: the article's, and ours by both methods; None where there is none.

    ``unit`` is "mm", "px", "%", or empty. ``digits``: decimals that are worth showing, None: in powers of ten. The verdicts follow
    ``ReproductionInfo.rule``.
    """

    quantity: str
    unit: str
    article: float | None
    by_article_method: float | None
    by_default_method: float | None
    verdict_article_method: Verdict = "none"
    verdict_default_method: Verdict = "none"
    digits: int | None = 4
    note: str = ""


@dataclass(frozen=True)
class TableRow:
    """A row of a table: its name, and a comparison for each column."""

    name: str
    cells: tuple[Comparison, ...]


@dataclass(frozen=True)
class ComparisonTable:
    """A table or a figure of the article with ours beside it.

    ``place`` is where it stands there ("Table 2", "Section 5.2, figure 8"); ``columns`` are titles, one a cell. ``text`` says what was
    done, and how it differs from the article.
    """

    place: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    text: str = ""

    def comparisons(self) -> Iterator[Comparison]:
        """All cells, row by row."""
        for row in self.rows:
            yield from row.cells


@dataclass(frozen=True)
class ReproductionInfo:
    """How it was made. ``seeds`` by what they fix; ``changed_options`` are those in which the article's method differs from the defaults."""

    quick: bool
    rig: str
    image_size: tuple[int, int]
    seeds: dict[str, int]
    rule: str
    changed_options: dict[str, tuple[str, str]]
    finished_at: str
    seconds: float
    versions: dict[str, str]
    machine: str
    n_frames: int
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class SensorSection:
    """Section 5.2, figure 8: camera, laser plane, its optimisation by cross-ratios; first by the article's, then by the default method."""

    table: ComparisonTable
    camera: CameraCalibration
    laser_plane: LaserPlaneCalibration
    cross_ratio: CrossRatioResult
    laser_plane_default: LaserPlaneCalibration
    cross_ratio_default: CrossRatioResult


@dataclass(frozen=True, eq=False)
class InitialAxisSection:
    """Section 5.3, figures 9 and 10: the target at several angles, the circles of its corners, and the axis through their centres.

    ``axis`` is by the article's method; ``true_axis_camera`` is what the rig was rendered with.
    """

    table: ComparisonTable
    frames: tuple[FrameOverlay, ...]
    axis: AxisCalibration
    true_axis_camera: Line


@dataclass(frozen=True, eq=False)
class AxisCase:
    """One row of table 1: the disturbed axis before and after optimisation.

    ``axis_error_mm`` is the distance of the optimised axis from the true one, the larger at Pa and Pb.
    """

    name: str
    delta_pa_mm: tuple[float, float, float]
    delta_pb_mm: tuple[float, float, float]
    mean_distance_before_mm: float
    sqp_mean_distance_mm: float
    sqp_iterations: int
    sqp_converged: bool
    sqp_axis_error_mm: float
    sqp_history_mm: Float[np.ndarray, " k"]
    least_squares_mean_distance_mm: float
    least_squares_iterations: int
    least_squares_axis_error_mm: float
    least_squares_history_mm: Float[np.ndarray, " j"]


@dataclass(frozen=True, eq=False)
class SimulationSection:
    """Section 5.4, table 1 and figure 12: T1 to T5."""

    table: ComparisonTable
    cases: tuple[AxisCase, ...]


@dataclass(frozen=True, eq=False)
class MountResult:
    """One mount W1 to W5 with the initial axis of its own checkerboard capture, by the article's method.

    ``axis_error_*_mm``: distance of the axis from the true one, the larger at the bottom and at the top of the stepped cylinder.
    """

    name: str
    calibration: ArtifactCalibration
    axis_error_before_mm: float
    axis_error_after_mm: float


@dataclass(frozen=True, eq=False)
class MountsSection:
    """Section 5.5, figure 14: ``mounts[0].calibration.mounts[0]`` has the feature points of 14a, the ``history_mm`` of all are 14b.

    ``together`` is the calibration by the default method: all mounts share one axis, ``together_axis_error_mm`` from the true one.
    ``frames``: the stepped cylinder with the stripe's centres, as in figure 13.
    """

    table: ComparisonTable
    artifact: SteppedCylinder
    mounts: tuple[MountResult, ...]
    together: ArtifactCalibration
    together_axis_error_mm: float
    frames: tuple[FrameOverlay, ...]


@dataclass(frozen=True, eq=False)
class PartsSection:
    """Section 6.2, tables 3 to 5 and figure 15: ball, cylinder, groove, five positions each.

    ``entries`` are the measurements of the first position by the default method, ``fitted`` their points.
    """

    tables: tuple[ComparisonTable, ...]
    entries: tuple[MeasurementEntry, ...]
    fitted: tuple[FittedPoints, ...]


@dataclass(frozen=True, eq=False)
class DetailResult:
    """A small feature of a complex part, in the table frame.

    ``height_mm`` is how far the true surface stands out of its surroundings there (negative: a hollow), ``measured_height_mm`` the same of
    the measured surface (NaN: no surface there). ``rms_mm`` is the deviation of the measured surface within ``radius_mm``.
    """

    name: str
    position_table: Float[np.ndarray, "3"]
    direction_table: Float[np.ndarray, "3"]
    radius_mm: float
    height_mm: float
    measured_height_mm: float
    rms_mm: float
    resolved: bool
    text: str


@dataclass(frozen=True, eq=False)
class ComplexPartResult:
    """A part of figure 16: a frame with the light on, the cloud, the surface with its deviation from the true mesh.

    ``points_table`` may be thinned, ``n_points`` counts all. ``deviation_mm`` (NaN where there is nothing to compare) is signed, positive
    outside the true surface, one a vertex. ``coverage`` is the fraction of the true surface above the table that has a measured point near.
    """

    name: str
    title: str
    photo: UInt8[np.ndarray, "h w 3"]
    points_table: Float[np.ndarray, "n 3"]
    n_points: int
    vertices_table: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    deviation_mm: Float[np.ndarray, " v"]
    rms_mm: float
    p95_mm: float
    coverage: float
    details: tuple[DetailResult, ...]


@dataclass(frozen=True, eq=False)
class ComplexPartsSection:
    """Section 6.3, figure 16. ``resolved_rule`` says when a detail counts as resolved."""

    resolved_rule: str
    parts: tuple[ComplexPartResult, ...]


@dataclass(frozen=True)
class BudgetLevel:
    """The resulting figures (by key of ``Budget.titles``; NaN: could not be determined) of one setting of one error source."""

    setting: float
    figures: dict[str, float]


@dataclass(frozen=True)
class BudgetSource:
    """One error of the rig, alone, at several levels; the first level is none of it.

    ``reproducing`` says, for each key of ``Budget.article``, at which setting it alone gives the article's figure; None where it does not
    within the levels.
    """

    key: str
    title: str
    unit: str
    from_images: bool
    levels: tuple[BudgetLevel, ...]
    reproducing: dict[str, float | None]
    text: str


@dataclass(frozen=True)
class Budget:
    """Which error of the rig does what. ``titles`` of the figures (mm) by key; ``article`` the article's values of those that it gives."""

    titles: dict[str, str]
    article: dict[str, float]
    sources: tuple[BudgetSource, ...]
    text: str


@dataclass(frozen=True, eq=False)
class Reproduction:
    """The article, reproduced. Sections that could not be done are None; ``info.warnings`` say why.

    ``stepped`` is table 2, ``stepped_disturbed`` the same with the initial axis disturbed as in table 1.
    """

    info: ReproductionInfo
    claims: ComparisonTable
    sensor: SensorSection | None
    initial_axis: InitialAxisSection | None
    simulation: SimulationSection
    mounts: MountsSection | None
    stepped: ComparisonTable | None
    stepped_disturbed: ComparisonTable | None
    parts: PartsSection | None
    complex_parts: ComplexPartsSection | None
    budget: Budget | None

    def tables(self) -> tuple[ComparisonTable, ...]:
        """All tables, in the order of the article."""
        first = (self.sensor, self.initial_axis, self.simulation, self.mounts)
        return (
            self.claims,
            *(section.table for section in first if section is not None),
            *(table for table in (self.stepped, self.stepped_disturbed) if table is not None),
            *(self.parts.tables if self.parts is not None else ()),
        )

    def verdicts(self) -> dict[str, int]:
        """How many figures by the default method are better, equal and worse than the article's."""
        found = [c.verdict_default_method for table in self.tables() for c in table.comparisons()]
        return {verdict: found.count(verdict) for verdict in ("better", "equal", "worse")}


def reproduction_document(reproduction: Reproduction) -> dict[str, Any]:
    """What ``reproduction.json`` holds: how it was made, every table, the details of the complex parts, the budget."""
    complex_parts = reproduction.complex_parts
    return {
        "info": asdict(reproduction.info),
        "verdicts": reproduction.verdicts(),
        "tables": [asdict(table) for table in reproduction.tables()],
        "complex_parts": None
        if complex_parts is None
        else {
            "resolved_rule": complex_parts.resolved_rule,
            "parts": [
                {
                    "name": part.name,
                    "title": part.title,
                    "n_points": part.n_points,
                    "rms_mm": part.rms_mm,
                    "p95_mm": part.p95_mm,
                    "coverage": part.coverage,
                    "details": [asdict(detail) for detail in part.details],
                }
                for part in complex_parts.parts
            ],
        },
        "budget": None if reproduction.budget is None else asdict(reproduction.budget),
    }
