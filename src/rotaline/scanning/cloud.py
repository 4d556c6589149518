"""A cloud of measured points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the ``table`` frame (z on the rotation axis, up).

    Attributes
    ----------
    points_table : (n, 3)   mm
    viewpoints_table : (n, 3)   the camera's projection centre when the point was taken, mm
    intensity : (n,)   grey values
    angle_rad : (n,)   table angle, right-handed about z
    frame : (n,)   index of the frame in the capture
    u_mm : (n,)   standard uncertainty of the point from the stripe's noise, along the ray
    """

    points_table: Float[np.ndarray, "n 3"]
    viewpoints_table: Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]
    angle_rad: Float[np.ndarray, " n"]
    frame: Int[np.ndarray, " n"]
    u_mm: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points_table)

    def select(self, keep: Bool[np.ndarray, " n"]) -> "PointCloud":
        """The points for which ``keep`` is true."""
        return PointCloud(
            self.points_table[keep],
            self.viewpoints_table[keep],
            self.intensity[keep],
            self.angle_rad[keep],
            self.frame[keep],
            self.u_mm[keep],
        )
