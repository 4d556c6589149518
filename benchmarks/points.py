"""Nanoseconds a point from stripe centres to the columns of a cloud, step by step.

A rig like that of the article, with curved sheet, angle error, moving axis and a full covariance: the most that a point can cost.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance, TableMotion
from rotaline.geometry.primitives import Line, Plane, SheetCurvature, unit
from rotaline.io.clouds import write_cloud
from rotaline.scanning.propagation import calibration_uncertainty, combination_uncertainty, point_sensitivities
from rotaline.scanning.triangulation import move_to_axis, scan_points, triangulate
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

POINTS_A_FRAME = 1000
PLAIN_POINTS = 20_000
SIZES = {
    **{"fx": 0.5, "fy": 0.5, "cx": 0.6, "cy": 0.6, "k1": 1e-3, "k2": 1e-2, "p1": 2e-5, "p2": 2e-5},
    **{"plane_turn_1": 1e-5, "plane_turn_2": 1e-5, "plane_offset": 1e-3},
    **dict.fromkeys(("curvature_uu", "curvature_uv", "curvature_vv"), 1e-7),
    **{"axis_turn_x": 3e-5, "axis_turn_y": 3e-5, "axis_shift_x": 1e-3, "axis_shift_y": 1e-3},
    **dict.fromkeys(("angle_cos", "angle_sin"), 1e-5),
    **{"run_out_x": 5e-4, "run_out_y": 5e-4, "wobble_x": 1e-5, "wobble_y": 1e-5},
}
"""Standard uncertainties as a calibration finds them."""


def example_system() -> SystemCalibration:
    """A calibrated rig with all that can be estimated."""
    axis = Line(np.array([2.0, 20.0, 290.0]), unit(np.array([0.02, -0.8, -0.6])))
    normal = unit(np.array([0.8, -0.3, 0.5]))
    mixing = np.array(list(SIZES.values()))[:, None] * np.random.default_rng(0).normal(size=(len(SIZES), len(SIZES)))
    return SystemCalibration(
        CameraModel((1280, 960), 2400.0, 2400.0, 640.0, 480.0, -0.11, 0.09, 6e-4, -4e-4),
        Plane(normal, float(-normal @ axis.point)),
        axis,
        -1,
        True,
        SheetCurvature(axis.point, (1e-5, -3e-6, 5e-6)),
        AngleError(3e-4, -2e-4),
        TableMotion((0.002, -0.001), (2e-5, 3e-5), axis.point),
        SystemCovariance(tuple(SIZES), mixing @ mixing.T / len(SIZES), axis.point, axis.point),
    )


def example_stripes(n_points: int) -> tuple[list[StripePoints], np.ndarray]:
    """Stripes of frames over a turn, ``POINTS_A_FRAME`` each, and the angles."""
    rng = np.random.default_rng(1)
    v = np.linspace(20.0, 940.0, POINTS_A_FRAME)
    full = np.ones(POINTS_A_FRAME)
    normal = np.tile(unit(np.array([1.0, 0.1])), (POINTS_A_FRAME, 1))
    stripes = [
        StripePoints(
            np.column_stack([640.0 + rng.normal(0, 60) + 20 * np.sin(v / 90), v]),
            normal,
            2 * full,
            90 * full,
            0.05 * full,
            np.zeros(POINTS_A_FRAME, bool),
            np.zeros(POINTS_A_FRAME, int),
        )
        for _ in range(max(1, n_points // POINTS_A_FRAME))
    ]
    return stripes, np.linspace(0, 2 * np.pi, len(stripes), endpoint=False)


def measure(n_points: int = 100_000, repeats: int = 7) -> dict[str, float]:
    """Median seconds of processor time a point for each step, one thread.

    Parameters
    ----------
    n_points : of the compiled steps; the plain ones, for comparison, take at most ``PLAIN_POINTS``
    repeats : of each, in turns, so that what else the machine does hits all alike
    """
    system = example_system()
    stripes, angles_rad = example_stripes(n_points)
    cloud = scan_points(stripes, angles_rad, system)
    uv = np.concatenate([stripe.uv for stripe in stripes])
    flat = replace(system, laser_curvature=None, table_motion=None, covariance=None)
    other = replace(system, rotation_axis_camera=Line(system.rotation_axis_camera.point + 0.1, unit(np.ones(3))))
    few = slice(0, PLAIN_POINTS)
    weights = np.ones((3, len(cloud), 3))
    with TemporaryDirectory() as folder:
        steps: dict[str, tuple[Callable[[], object], int]] = {
            "scan, all columns": (lambda: scan_points(stripes, angles_rad, system), len(cloud)),
            "scan, ranges of 32 frames": (lambda: _by_ranges(stripes, angles_rad, system), len(cloud)),
            "scan without covariance": (lambda: scan_points(stripes, angles_rad, flat), len(cloud)),
            "undistortion": (lambda: system.camera.rays(uv), len(uv)),
            "uncertainty from the calibration": (
                lambda: calibration_uncertainty(cloud.points_table, cloud.angle_rad, system),
                len(cloud),
            ),
            "uncertainty of three features": (
                lambda: combination_uncertainty(weights, cloud.points_table, cloud.angle_rad, system),
                len(cloud),
            ),
            "to another axis": (lambda: move_to_axis(cloud, system, other), len(cloud)),
            "writing": (lambda: write_cloud(Path(folder) / "cloud.ply", cloud), len(cloud)),
            "plain NumPy: points": (
                lambda: triangulate(uv[few], system.camera, system.laser_plane_camera, system.laser_curvature),
                len(uv[few]),
            ),
            "plain NumPy: uncertainty from the calibration": (
                lambda: _plain_uncertainty(cloud.points_table[few], cloud.angle_rad[few], system),
                len(cloud.points_table[few]),
            ),
        }
        times: dict[str, list[float]] = {name: [] for name in steps}
        for _ in range(repeats + 1):
            for name, (step, n) in steps.items():
                start = time.process_time()
                step()
                times[name].append((time.process_time() - start) / n)
    return {name: float(np.median(values[1:])) for name, values in times.items()}


def _by_ranges(stripes: list[StripePoints], angles_rad: np.ndarray, system: SystemCalibration) -> None:
    """As a pipeline goes through a capture."""
    for k in range(0, len(stripes), 32):
        scan_points(stripes[k : k + 32], angles_rad[k : k + 32], system, k)


def _plain_uncertainty(points_table: np.ndarray, angle_rad: np.ndarray, system: SystemCalibration) -> np.ndarray:
    """All derivatives at once, then ``J C J^T``."""
    assert system.covariance is not None
    jacobian = point_sensitivities(points_table, angle_rad, system)
    return np.asarray(np.sqrt(np.sum((jacobian @ system.covariance.matrix) * jacobian, axis=(1, 2))))


def main() -> None:
    """Print the table."""
    numbers = (100_000, 1_000_000, 10_000_000)
    columns = [measure(n, 7 if n < 1e7 else 3) for n in numbers]
    print(f"{'ns a point':<48}" + "".join(f"{n:>12,}" for n in numbers))
    for name in columns[0]:
        print(f"{name:<48}" + "".join(f"{1e9 * column[name]:>12.1f}" for column in columns))


if __name__ == "__main__":
    main()
