"""The simulation that verifies the optimisation of the rotation axis (section 5.4 of the article).

Ideal feature points of a stepped cylinder; the axis disturbed by the five deviations of table 1; the mean distance from the
ideal circles before and after optimisation, with SQP as in the article and with least squares.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 5.4, table 1 and figure 12
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rotaline.calibration.artifact import ArtifactCapture, ArtifactOptions, optimise_axis
from rotaline.errors import OutputError
from rotaline.geometry.primitives import Line, SteppedCylinder, unit
from rotaline.io.report.reproduction import AxisCase
from rotaline.simulation.ideal.circles import TABLE_1, ideal_feature_points, ideal_rig, pose_on_table

ARTICLE_ARTIFACT = SteppedCylinder(23.051, 36.006, 22.003, 25.005)
ARTICLE_MEAN_DISTANCE_MM = 2.278e-7


@dataclass(frozen=True, eq=False)
class AxisVerification:
    """All cases of table 1."""

    cases: tuple[AxisCase, ...]


def verify_axis() -> AxisVerification:
    """Do the simulation of section 5.4 for T1 to T5 of table 1.

    The cylinder stands 5 mm off the rotation axis, tilted by a degree; 90 angles over a full turn; Pa on the table top, Pb at
    the height of the cylinder's top; the deviations of table 1 are added in the base frame, whose z is the rotation axis.
    """
    rig = ideal_rig(laser_azimuth_deg=-40.0)
    angles = np.radians(np.arange(0.0, 360.0, 4.0))
    features = ideal_feature_points(ARTICLE_ARTIFACT, rig, pose_on_table((3.0, 4.0), (0.6, -0.8)), angles)
    capture = ArtifactCapture("simulated", tuple(f"{i:04d}" for i in range(90)), angles, features, ("",) * 90)
    camera_from_base = rig.base_from_camera.inv()
    pa_base = np.zeros(3)
    pb_base = np.array([0.0, 0.0, ARTICLE_ARTIFACT.height_small + ARTICLE_ARTIFACT.height_large])
    ends_camera = camera_from_base.apply(np.stack([pa_base, pb_base]))

    cases = []
    for name, (delta_pa, delta_pb) in TABLE_1.items():
        disturbed = camera_from_base.apply(np.stack([pa_base + delta_pa, pb_base + delta_pb]))
        start = Line(disturbed[0], unit(disturbed[1] - disturbed[0]))
        sqp, squares = (
            optimise_axis(start, rig.turn_sense, [capture], ARTICLE_ARTIFACT, options)
            for options in (ArtifactOptions(method="sqp"), ArtifactOptions(method="least-squares"))
        )
        cases.append(
            AxisCase(
                name=name,
                delta_pa_mm=delta_pa,
                delta_pb_mm=delta_pb,
                mean_distance_before_mm=sqp.mean_distance_before_mm,
                sqp_mean_distance_mm=sqp.mean_distance_mm,
                sqp_iterations=sqp.n_iterations,
                sqp_converged=sqp.converged,
                sqp_axis_error_mm=float(sqp.axis_camera.distance_to(ends_camera).max()),
                sqp_history_mm=sqp.history_mm,
                least_squares_mean_distance_mm=squares.mean_distance_mm,
                least_squares_iterations=squares.n_iterations,
                least_squares_axis_error_mm=float(squares.axis_camera.distance_to(ends_camera).max()),
                least_squares_history_mm=squares.history_mm,
            )
        )
    return AxisVerification(tuple(cases))


def draw_convergence(verification: AxisVerification) -> Figure:
    """Convergence curves of all cases, as figure 12 of the article: mean distance after each iteration."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for case in verification.cases:
        for axes, history in ((left, case.sqp_history_mm), (right, case.least_squares_history_mm)):
            axes.semilogy(
                np.arange(len(history)), np.maximum(history, 1e-16), marker=".", markersize=4, label=case.name
            )
    left.axhline(ARTICLE_MEAN_DISTANCE_MM, color="0.5", linestyle="--", linewidth=1, label="article, 2.278e-7 mm")
    left.set_title("SQP on the mean distance, eq. (14)")
    right.set_title("Least squares")
    left.set_ylabel("mean distance from the ideal circles / mm")
    for axes in (left, right):
        axes.set_xlabel("iteration")
        axes.grid(True, alpha=0.3)
        axes.legend(frameon=False)
    return figure


def write_convergence_picture(verification: AxisVerification, path: Path) -> None:
    """Write the convergence curves as a PNG file.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    figure = draw_convergence(verification)
    FigureCanvasAgg(figure)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise OutputError(f"{path}: the picture cannot be written ({error.strerror}). Name another folder.") from error
