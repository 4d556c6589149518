"""What the article prints: the figures to compare with.

Lengths in mm. Where the text of the article contradicts its own tables (section 6.2 gives an average error of the ball of 0.0059 mm
and a largest of 0.0136 mm, table 3 has 0.0043 and 0.0079), the tables count. In table 4 the first diameter, 38.0278, is 0.0238 from the
reference, the error beside it is 0.0258, and the relative error belongs to that; the printed error counts.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275
"""

from dataclasses import dataclass

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.pipeline.options import CalibrationOptions, Options

STEPWISE_OPTIONS = Options(calibration=CalibrationOptions(method="article"))
"""The article's stages with the defaults of this program."""

STEPPED_CYLINDER = SteppedCylinder(23.051, 36.006, 22.003, 25.005)
"""Section 5.5."""

N_CAMERA_VIEWS = 20
N_LASER_POSES = 10
AXIS_STEP_DEG, AXIS_RANGE_DEG = 2.0, 40.0
ARTIFACT_STEP_DEG = 4.0
"""Sections 5.2, 5.3 and 5.5."""

CAMERA_MEAN_ERROR_PX = 0.03
INTERVAL_RMSE_MM = (0.021, 0.003)
"""Section 5.2, figure 8: before and after the optimisation by cross-ratios."""

SIMULATED_MEAN_DISTANCE_MM = 2.278e-7
SIMULATED_BEFORE_MM = (0.08, 0.40)
"""Section 5.4, figure 12; the range of all five cases before."""

MEAN_DISTANCE_MM = (0.011, 0.012)
"""Section 5.5, figure 14b: range over the five mounts; 0.011 of the first."""


@dataclass(frozen=True)
class DiameterErrors:
    """Table 2, one cylinder: absolute errors before and after, and the reduction in per cent."""

    before_mm: tuple[float, ...]
    after_mm: tuple[float, ...]
    reduced_percent: tuple[float, ...]
    average_before_mm: float
    average_after_mm: float
    average_reduced_percent: float


SMALL_CYLINDER = DiameterErrors(
    (0.3260, 0.2693, 0.4149, 0.2796, 0.2843),
    (0.0322, 0.0314, 0.0480, 0.0197, 0.0248),
    (90.12, 88.34, 88.43, 92.95, 91.28),
    0.3148,
    0.0312,
    90.09,
)
LARGE_CYLINDER = DiameterErrors(
    (0.2334, 0.4420, 0.4498, 0.5203, 0.4565),
    (0.0084, 0.0431, 0.0542, 0.0045, 0.0229),
    (96.40, 90.25, 87.95, 99.15, 94.98),
    0.4204,
    0.0266,
    93.67,
)


@dataclass(frozen=True)
class PartTable:
    """One of the tables 3 to 5: a part measured in five positions; ``error_mm`` is without sign."""

    place: str
    title: str
    quantity: str
    reference_mm: float
    measured_mm: tuple[float, ...]
    error_mm: tuple[float, ...]
    relative_percent: tuple[float, ...]


BALL = PartTable(
    "Table 3",
    "Ceramic ball, diameter",
    "diameter",
    28.475,
    (28.4734, 28.4670, 28.4716, 28.4687, 28.4723),
    (0.0015, 0.0079, 0.0033, 0.0062, 0.0026),
    (0.0052, 0.0277, 0.0116, 0.0218, 0.0091),
)
CYLINDER = PartTable(
    "Table 4",
    "Cylinder, diameter",
    "diameter",
    38.004,
    (38.0278, 37.9893, 37.9761, 38.0282, 38.0218),
    (0.0258, 0.0147, 0.0279, 0.0242, 0.0178),
    (0.0679, 0.0387, 0.0734, 0.0637, 0.0469),
)
GROOVE = PartTable(
    "Table 5",
    "Trapezoidal groove, depth",
    "depth",
    12.003,
    (12.0172, 12.0204, 12.0090, 12.0151, 12.0005),
    (0.0142, 0.0175, 0.0060, 0.0121, 0.0025),
    (0.1183, 0.1458, 0.0500, 0.1008, 0.0208),
)
PART_TABLES = (BALL, CYLINDER, GROOVE)

CLAIMED_REDUCTION_PERCENT = 90.0
CLAIMED_RELATIVE_PERCENT = 0.15
"""The abstract: reduction by more than, relative errors less than."""
