"""Distances of turned feature points from the ideal circles of stepped cylinders, and their derivatives.

The unknowns are, in mm: the changes ``(dxa, dya, dza, dxb, dyb, dzb)`` of two points Pa and Pb of the rotation axis (section
4.2 of [1]_), then for each mount the centre of the cylinder's bottom and, as the displacement of a point one lever arm above
it, the direction of the cylinder's axis. All are small numbers in the base frame of the start axis, where Pa = (0, 0, 0) and
Pb = (0, 0, lever).

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (11)-(14)
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.geometry.primitives import Line, SteppedCylinder

N_AXIS = 6
N_POSE = 5


@dataclass(frozen=True, eq=False)
class CircleModel:
    """Feature points of all mounts in one list, with all that their distances depend on.

    Attributes
    ----------
    points : (n, 3)   mm, base frame of the start axis, as measured (not turned back)
    turn_rad : (n,)   angle that turns a point back to angle 0, right-handed about the axis
    mount, frame, circle : (n,)   where a point belongs; frames are numbered through all mounts
    radii, heights : (4,)   of the ideal circles, mm
    lever : float   distance of Pa and Pb, mm
    """

    points: Float[np.ndarray, "n 3"]
    turn_rad: Float[np.ndarray, " n"]
    mount: Int[np.ndarray, " n"]
    frame: Int[np.ndarray, " n"]
    circle: Int[np.ndarray, " n"]
    radii: Float[np.ndarray, "4"]
    heights: Float[np.ndarray, "4"]
    lever: float

    @property
    def n_mounts(self) -> int:
        """Number of mounts."""
        return int(self.mount.max()) + 1

    @property
    def n_unknowns(self) -> int:
        """Six of the axis and five a mount."""
        return N_AXIS + N_POSE * self.n_mounts

    def select(self, keep: Bool[np.ndarray, " n"]) -> "CircleModel":
        """The same model with fewer points."""
        return CircleModel(
            self.points[keep],
            self.turn_rad[keep],
            self.mount[keep],
            self.frame[keep],
            self.circle[keep],
            self.radii,
            self.heights,
            self.lever,
        )

    def axis(self, unknowns: Float[np.ndarray, " p"]) -> Line:
        """The rotation axis, in the base frame of the start axis."""
        pa = unknowns[:3]
        span = unknowns[3:6] - pa + np.array([0.0, 0.0, self.lever])
        return Line(pa.copy(), span / np.linalg.norm(span))

    def pose(self, unknowns: Float[np.ndarray, " p"], mount: int) -> Line:
        """A cylinder's axis at angle 0, its point in the bottom plane, in the base frame of the start axis."""
        q = unknowns[N_AXIS + N_POSE * mount :][:N_POSE]
        direction = np.array([q[3], q[4], self.lever])
        return Line(q[:3].copy(), direction / np.linalg.norm(direction))

    def turned(self, unknowns: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n 3"]:
        """The points turned back to angle 0 about the axis, eq. (11)."""
        return self._turned_with_slopes(unknowns)[0]

    def _turned_with_slopes(
        self, unknowns: Float[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 6"]]:
        pa = unknowns[:3]
        span = unknowns[3:6] - pa + np.array([0.0, 0.0, self.lever])
        length = float(np.linalg.norm(span))
        axis = span / length
        w = self.points - pa
        cos, sin = np.cos(self.turn_rad)[:, None], np.sin(self.turn_rad)[:, None]
        along = w @ axis
        turned = w * cos + np.cross(axis, w) * sin + along[:, None] * axis * (1 - cos) + pa

        eye = np.eye(3)
        cross_axis = _cross_matrices(axis[None])[0]
        rotation = cos[..., None] * eye + sin[..., None] * cross_axis + (1 - cos)[..., None] * np.outer(axis, axis)
        by_axis = -sin[..., None] * _cross_matrices(w) + (1 - cos)[..., None] * (
            along[:, None, None] * eye + axis[:, None] * w[:, None, :]
        )
        by_span = by_axis @ (eye - np.outer(axis, axis)) / length
        return turned, np.concatenate([eye - rotation - by_span, by_span], axis=2)

    def residuals(self, unknowns: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n 2"]:
        """Radial and axial distance of each turned point from its ideal circle, mm."""
        return self.residuals_with_slopes(unknowns)[0]

    def residuals_with_slopes(
        self, unknowns: Float[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 p"]]:
        """Radial and axial distances, and their derivatives with respect to the unknowns.

        With q the arm from the bottom centre and Vs the cylinder's axis: axial ``q . Vs - height``, radial ``|PcM| - r``
        with ``PcM = q - (q . Vs) Vs``, eq. (12); together they make the distance d of eq. (13).
        """
        turned, by_axis_unknowns = self._turned_with_slopes(unknowns)
        residuals, by_point, by_pose = self._at_poses(turned, unknowns)
        return residuals, np.concatenate([by_point @ by_axis_unknowns, by_pose], axis=2)

    def pose_residuals_with_slopes(
        self, turned: Float[np.ndarray, "n 3"], unknowns: Float[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 q"]]:
        """The same for points that are turned back already, with the derivatives by the poses only."""
        residuals, _, by_pose = self._at_poses(turned, unknowns)
        return residuals, by_pose

    def _at_poses(
        self, turned: Float[np.ndarray, "n 3"], unknowns: Float[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 q"]]:
        """Radial and axial distances, and their derivatives by the turned points and by the poses of all mounts."""
        poses = unknowns[N_AXIS:].reshape(-1, N_POSE)
        spans = np.column_stack([poses[:, 3:5], np.full(len(poses), self.lever)])
        lengths = np.linalg.norm(spans, axis=1)
        directions = spans / lengths[:, None]

        direction = directions[self.mount]
        arm = turned - poses[self.mount, :3]
        axial = np.sum(arm * direction, axis=1)
        across = arm - axial[:, None] * direction
        distance = np.linalg.norm(across, axis=1)
        outward = across / np.maximum(distance, 1e-12)[:, None]
        residuals = np.column_stack([distance - self.radii[self.circle], axial - self.heights[self.circle]])

        by_point = np.stack([outward, direction], axis=1)
        by_direction = np.stack([-axial[:, None] * outward, across], axis=1)  # the part along the direction is idle
        project = (np.eye(3) - directions[:, :, None] * directions[:, None, :]) / lengths[:, None, None]
        block = np.concatenate([-by_point, (by_direction @ project[self.mount])[:, :, :2]], axis=2)
        by_pose = np.zeros((len(turned), 2, len(poses), N_POSE))
        by_pose[np.arange(len(turned)), :, self.mount] = block
        return residuals, by_point, by_pose.reshape(len(turned), 2, -1)

    def mean_distance_with_slope(self, unknowns: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        """Objective (14), the mean of eq. (13) over all points, and its gradient."""
        residuals, slopes = self.residuals_with_slopes(unknowns)
        distances = np.linalg.norm(residuals, axis=1)
        towards = residuals / np.where(distances > 0, distances, 1.0)[:, None]
        return float(distances.mean()), np.einsum("na,nap->p", towards, slopes) / len(distances)


def circle_model(
    points: Float[np.ndarray, "n 3"],
    turn_rad: Float[np.ndarray, " n"],
    mount: Int[np.ndarray, " n"],
    frame: Int[np.ndarray, " n"],
    circle: Int[np.ndarray, " n"],
    artifact: SteppedCylinder,
) -> CircleModel:
    """The model of one artefact; the lever arm is the artefact's height."""
    circles = artifact.edge_circles_part()
    return CircleModel(
        points,
        turn_rad,
        mount,
        frame,
        circle,
        np.array([c.radius for c in circles]),
        np.array([c.centre[2] for c in circles]),
        float(artifact.height_small + artifact.height_large),
    )


def _cross_matrices(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Matrices with ``matrix @ x = vector x x``."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2] = -z, y
    matrices[:, 1, 0], matrices[:, 1, 2] = z, -x
    matrices[:, 2, 0], matrices[:, 2, 1] = -y, x
    return matrices
