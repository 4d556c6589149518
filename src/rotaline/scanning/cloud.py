"""A cloud of measured points."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.calibration.model import AngleError


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the ``table`` frame (z on the rotation axis, up).

    Attributes
    ----------
    points_table : (n, 3)   mm
    viewpoints_table : (n, 3)   the camera's projection centre when the point was taken, mm
    intensity : (n,)   grey values
    angle_rad : (n,)   how far the table had turned, right-handed about z (sense and error of the read-out are applied)
    frame : (n,)   index of the frame in the capture
    u_mm : (n,)   standard uncertainty of the point from what is new in each frame: the stripe's noise, along the ray, and the noise of the
        frame's angle, about the axis
    u_calibration_mm : (n,)   standard uncertainty from the calibration: common to neighbouring points, so that it does not average
        out (:func:`rotaline.scanning.propagation.calibration_uncertainty`); NaN where the calibration has no covariance
    """

    points_table: Float[np.ndarray, "n 3"]
    viewpoints_table: Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]
    angle_rad: Float[np.ndarray, " n"]
    frame: Int[np.ndarray, " n"]
    u_mm: Float[np.ndarray, " n"]
    u_calibration_mm: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points_table)

    def select(self, keep: Bool[np.ndarray, " n"]) -> "PointCloud":
        """The points for which ``keep`` is true."""
        return PointCloud(*(getattr(self, field.name)[keep] for field in fields(self)))


def read_angles_rad(
    angle_rad: Float[np.ndarray, " n"], turn_sense: int, angle_error: AngleError
) -> Float[np.ndarray, " n"]:
    """What the rig read when the table had turned by ``angle_rad`` of a cloud: Newton's method on :class:`AngleError`."""
    turned = angle_rad * turn_sense
    read = turned
    for _ in range(3):
        slope = 1.0 - angle_error.cos_rad * np.sin(read) + angle_error.sin_rad * np.cos(read)
        read = read - (angle_error.turned_rad(read) - turned) / slope
    return read
