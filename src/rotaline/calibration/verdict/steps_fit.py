"""How the stripes on the mounts of a stepped cylinder depend on everything that may be wrong: one state, and one Jacobian about it.

The state holds changes of the laser plane, of the rotation axis, of the sizes of the artefact, of the angles, and of the camera's
place between two mounts, beside the poses of the mounts. Gauss-Newton with weak expectations frees all of them at once; so whatever is
wrong, the state comes to where the stripes fit, and the Jacobian there is good for comparing explanations
(:mod:`rotaline.calibration.verdict.explanations`).

All unknowns are in mm: turns times ``LEVER_MM``, factors and angles times what they do at the outer radius.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from rotaline.calibration.verdict.steps_seen import LARGE_SIDE, SMALL_SIDE, STEP, TABLE, TOP, SeenSteps
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder, unit
from rotaline.geometry.robust import mad_scale
from rotaline.geometry.transforms import base_axes

LEVER_MM = 25.0
"""Length over which turns count."""
N_SHARED = 3 + 4 + 3 + 1 + 2 + 2
PLANE, AXIS, SIZES = slice(0, 3), slice(3, 7), slice(7, 10)
ANGLE_SCALE, ANGLE_HARMONIC, RUN_OUT = slice(10, 11), slice(11, 13), slice(13, 15)
N_MOVE, N_POSE = 6, 5
_WEAK_MM = np.array([0.5, 0.5, 0.02, 20.0, 20.0, 2.0, 2.0, 20.0, 20.0, 20.0, 5.0, 0.5, 0.5, 0.3, 0.3])
"""Expectations of the shared unknowns that keep the state where stripes still lie on their pieces."""
_WEAK_MOVE_MM, _WEAK_POSE_MM = 1.0, 20.0
_ROUNDS = 12
_SETTLED = 0.5
"""Gain in the weighted sum of squares below which the state stays."""


@dataclass(frozen=True, eq=False)
class FittedSteps:
    """The state that fits the stripes, and how the means of the groups depend on it.

    Attributes
    ----------
    state : (p,)   mm
    residuals_mm : (g,)   mean distance from the surface of each group
    jacobian : (g, p)
    weights : (g,)   robust
    sigma_mm : of a group, from the residuals
    clusters : groups of one frame count as this many times less than independent ones
    mount, piece, frame : (g,)   of each group; frames are numbered over all mounts
    rms_mm : of the residuals
    start_sizes : (3,)   small and large radius, upper height, to which those of the state are added, mm
    centres_mm : (m, 3)   of the artefact at the height of its step, in the table frame
    pivot_camera : (3,)   on the axis, about which plane and axis turn
    """

    state: Float[np.ndarray, " p"]
    residuals_mm: Float[np.ndarray, " g"]
    jacobian: Float[np.ndarray, "g p"]
    weights: Float[np.ndarray, " g"]
    sigma_mm: float
    clusters: float
    mount: Int[np.ndarray, " g"]
    piece: Int[np.ndarray, " g"]
    frame: Int[np.ndarray, " g"]
    rms_mm: float
    start_sizes: Float[np.ndarray, "3"]
    centres_mm: Float[np.ndarray, "m 3"]
    pivot_camera: Float[np.ndarray, "3"]

    @property
    def n_mounts(self) -> int:
        """Mounts in the state."""
        return int(self.mount.max()) + 1

    def move(self, mount: int) -> slice:
        """Columns of the camera's move before a mount (1 or later)."""
        first = N_SHARED + N_MOVE * (mount - 1)
        return slice(first, first + N_MOVE)

    @property
    def poses(self) -> slice:
        """Columns of all poses."""
        return slice(N_SHARED + N_MOVE * (self.n_mounts - 1), len(self.state))


@dataclass(frozen=True, eq=False)
class _Model:
    """Points of all mounts in one row of arrays, one mount after another.

    ``in_plane``, ``across_axis``: two directions each, along which the plane and the axis are turned and moved.
    """

    plane: Plane
    axis: Line
    in_plane: Float[np.ndarray, "2 3"]
    across_axis: Float[np.ndarray, "2 3"]
    pivot: Float[np.ndarray, "3"]
    sense: Float[np.ndarray, " n"]
    rays: Float[np.ndarray, "n 3"]
    read: Float[np.ndarray, " n"]
    piece: Int[np.ndarray, " n"]
    mount: Int[np.ndarray, " n"]
    group: Int[np.ndarray, " n"]
    sizes: tuple[float, float, float]
    starts: Float[np.ndarray, "m 3"]

    def distances(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        """Signed distance of every point from the surface that it lies on, mm."""
        d = np.empty(len(self.rays))
        n_mounts = len(self.starts)
        r1, r2, h1 = np.array(self.sizes) + x[SIZES]
        for k in range(n_mounts):
            plane, axis = self._moved(x, k)
            mine = slice(*np.searchsorted(self.mount, [k, k + 1]))
            rays, piece, read = self.rays[mine], self.piece[mine], self.read[mine]
            points = rays * (-plane.offset / (rays @ plane.normal))[:, None]
            base = (points - axis.point) @ base_axes(axis).T
            a = read * (1 + x[10] / (np.pi * r2))
            a = a + (x[11] * np.cos(read) + x[12] * np.sin(read)) / r2
            a = self.sense[mine] * a
            cos, sin = np.cos(a), np.sin(a)
            base_x = base[:, 0] - (x[13] * cos + x[14] * sin)
            base_y = base[:, 1] - (x[14] * cos - x[13] * sin)
            table = np.stack([cos * base_x + sin * base_y, -sin * base_x + cos * base_y, base[:, 2]], axis=1)
            pose = _pose_of(x, k, n_mounts)
            centre = self.starts[k] + pose[:3]  # on the artefact's axis, at the height of the step
            direction = unit(np.array([pose[3] / LEVER_MM, pose[4] / LEVER_MM, 1.0]))
            arm = table - centre
            height = arm @ direction
            radius = np.linalg.norm(arm - height[:, None] * direction, axis=1)
            d[mine] = np.select(
                [piece == TOP, piece == SMALL_SIDE, piece == STEP], [height - h1, radius - r1, height], radius - r2
            )
        return d

    def _moved(self, x: Float[np.ndarray, " p"], mount: int) -> tuple[Plane, Line]:
        """Plane and axis as the camera sees them when it looks at a mount."""
        normal = unit(self.plane.normal + (x[0:2] / LEVER_MM) @ self.in_plane)
        on_plane = (
            self.pivot
            - self.plane.signed_distance_to(self.pivot[None])[0] * self.plane.normal
            + x[2] * self.plane.normal
        )
        point = self.pivot + x[3:5] @ self.across_axis
        direction = unit(self.axis.direction + (x[5:7] / LEVER_MM) @ self.across_axis)
        for k in range(1, mount + 1):
            move = x[N_SHARED + N_MOVE * (k - 1) :][:N_MOVE]
            turn = Rotation.from_rotvec(move[3:] / LEVER_MM).as_matrix()
            normal, direction = turn @ normal, turn @ direction
            on_plane = turn @ (on_plane - self.pivot) + self.pivot + move[:3]
            point = turn @ (point - self.pivot) + self.pivot + move[:3]
        return Plane(normal, -float(normal @ on_plane)), Line(point, direction)

    def means(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " g"]:
        """Mean distance of each group."""
        return np.asarray(np.bincount(self.group, self.distances(x)) / np.bincount(self.group))

    def jacobian(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "g p"]:
        """Of the means, by differences of 1e-4 mm."""
        here = self.means(x)
        return np.stack([(self.means(x + s) - here) / 1e-4 for s in 1e-4 * np.eye(len(x))], axis=1)


def fit_steps(
    plane_camera: Plane,
    axis_camera: Line,
    senses: Sequence[int],
    angle_scale: float,
    seen: Sequence[SeenSteps],
    artifact: SteppedCylinder,
) -> FittedSteps:
    """Free everything, and go to where the stripes fit.

    Parameters
    ----------
    plane_camera, axis_camera : as calibrated
    senses : of the turntable, for each mount
    angle_scale : by which the angles of all mounts are multiplied beforehand
    seen : the mounts
    artifact : whose sizes the state starts with, if they are near what is seen
    """
    model = _model(plane_camera, axis_camera, senses, angle_scale, seen, artifact)
    n_mounts = len(seen)
    n = N_SHARED + N_MOVE * (n_mounts - 1) + N_POSE * n_mounts
    expected = np.concatenate(
        [_WEAK_MM, np.full(N_MOVE * (n_mounts - 1), _WEAK_MOVE_MM), np.full(N_POSE * n_mounts, _WEAK_POSE_MM)]
    )
    x, weight = np.zeros(n), np.ones(int(model.group.max()) + 1)
    damping, residual = 1e-3, model.means(x)
    for _ in range(_ROUNDS):
        jacobian = model.jacobian(x)
        sigma = max(mad_scale(residual), 1e-5)
        weight = 1 / (1 + (residual / (2.4 * sigma)) ** 2)
        root = np.sqrt(weight) / sigma

        def cost(r: np.ndarray, at: np.ndarray, root: np.ndarray = root) -> float:
            return float(np.sum((root * r) ** 2) + np.sum((at / expected) ** 2))

        for _ in range(6):
            rows = np.vstack(
                [root[:, None] * jacobian, np.diag(1 / expected), np.diag(np.sqrt(damping) / expected * 1e2)]
            )
            right = np.concatenate([-root * residual, -x / expected, np.zeros(n)])
            step = np.linalg.lstsq(rows, right, rcond=None)[0]
            new = model.means(x + step)
            gain = cost(residual, x) - cost(new, x + step)
            if gain >= 0:
                break
            damping = max(damping, 1e-6) * 10
        else:
            break
        damping *= 0.1
        x, residual = x + step, new
        if gain < _SETTLED:
            break
    sigma = float(np.sqrt(np.sum(weight * residual**2) / max(np.sum(weight) - n, 1)))
    sizes = np.bincount(model.group)
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    frames = np.concatenate([s.frame + sum(len(t.angles_rad) for t in seen[:k]) for k, s in enumerate(seen)])[
        _used(seen)
    ]
    return FittedSteps(
        x,
        residual,
        model.jacobian(x),
        weight,
        max(sigma, 1e-6),
        _clusters(residual, weight, frames[first]),
        model.mount[first],
        model.piece[first],
        frames[first],
        float(np.sqrt(np.mean(residual**2))),
        np.array(model.sizes),
        model.starts + np.stack([_pose_of(x, k, n_mounts)[:3] for k in range(n_mounts)]),
        model.pivot,
    )


def _pose_of(x: Float[np.ndarray, " p"], mount: int, n_mounts: int) -> Float[np.ndarray, "5"]:
    return x[N_SHARED + N_MOVE * (n_mounts - 1) + N_POSE * mount :][:N_POSE]


def _used(seen: Sequence[SeenSteps]) -> Int[np.ndarray, " n"]:
    """Points that are not on the table."""
    return np.flatnonzero(np.concatenate([s.piece for s in seen]) != TABLE)


def seen_sizes(
    plane_camera: Plane, axis_camera: Line, senses: Sequence[int], angle_scale: float, seen: Sequence[SeenSteps]
) -> Float[np.ndarray, "3"]:
    """Small and large radius and upper height as the turned-back stripes show them at once, mm: to some hundredths."""
    nothing = SteppedCylinder(1e-6, 2e-6, 1e-6, 1e-6)
    return np.array(_model(plane_camera, axis_camera, senses, angle_scale, seen, nothing).sizes)


def roundness_mm(plane_camera: Plane, axis_camera: Line, sense: int, angle_scale: float, seen: SeenSteps) -> float:
    """RMS distance of the turned-back points on the sides of one mount from concentric circles, mm."""
    model = _model(plane_camera, axis_camera, [sense], angle_scale, [seen], SteppedCylinder(1e-6, 2e-6, 1e-6, 1e-6))
    n = N_SHARED + N_POSE
    distances = model.distances(np.zeros(n))
    sides = (model.piece == SMALL_SIDE) | (model.piece == LARGE_SIDE)
    return float(np.sqrt(np.mean(distances[sides] ** 2)))


def _model(
    plane: Plane,
    axis: Line,
    senses: Sequence[int],
    angle_scale: float,
    seen: Sequence[SeenSteps],
    artifact: SteppedCylinder,
) -> _Model:
    rays = np.concatenate([s.rays_camera for s in seen])
    piece = np.concatenate([s.piece for s in seen])
    mount = np.concatenate([np.full(len(s.piece), k) for k, s in enumerate(seen)])
    read = np.concatenate([angle_scale * s.angles_rad[s.frame] for s in seen])
    group = np.concatenate([s.group + 1000000 * k for k, s in enumerate(seen)])
    keep = np.flatnonzero(piece != TABLE)
    rays, piece, mount, read = rays[keep], piece[keep], mount[keep], read[keep]
    group = np.unique(group[keep], return_inverse=True)[1]
    sense = np.array(senses, dtype=float)[mount]
    points = rays * (-plane.offset / (rays @ plane.normal))[:, None]
    height = (points - axis.point) @ axis.direction
    pivot = axis.point + float(np.median(height)) * axis.direction
    axes = base_axes(Line(pivot, axis.direction))
    base = (points - pivot) @ axes.T
    turned = Rotation.from_rotvec(np.outer(-sense * read, [0.0, 0.0, 1.0])).apply(base)
    starts, radii, heights = [], [], []
    for k in range(len(seen)):
        step = float(np.median(turned[(mount == k) & (piece == STEP), 2]))
        heights.append(float(np.median(turned[(mount == k) & (piece == TOP), 2])) - step)
        small, large = (turned[(mount == k) & (piece == p), :2] for p in (SMALL_SIDE, LARGE_SIDE))
        centre, r1, r2 = _concentric(small, large)
        starts.append([*centre, step])
        radii.append((r1, r2))
    r1, r2 = np.median(radii, axis=0)
    sizes = (float(r1), float(r2), float(np.median(heights)))
    stated = (artifact.diameter_small / 2, artifact.diameter_large / 2, artifact.height_small)
    if all(abs(a / b - 1) < 0.05 for a, b in zip(sizes, stated, strict=True)):
        sizes = stated
    in_plane = np.linalg.svd(plane.normal[None])[2][1:]
    return _Model(
        plane, axis, in_plane, axes[:2], pivot, sense, rays, read, piece, mount, group, sizes, np.array(starts)
    )


def _concentric(
    small: Float[np.ndarray, "a 2"], large: Float[np.ndarray, "b 2"]
) -> tuple[Float[np.ndarray, "2"], float, float]:
    """Circles about one centre, algebraic."""
    rows = np.vstack(
        [
            np.column_stack([2 * small, np.ones(len(small)), np.zeros(len(small))]),
            np.column_stack([2 * large, np.zeros(len(large)), np.ones(len(large))]),
        ]
    )
    x = np.linalg.lstsq(rows, np.concatenate([np.sum(small**2, axis=1), np.sum(large**2, axis=1)]), rcond=None)[0]
    square = float(x[:2] @ x[:2])
    return x[:2], float(np.sqrt(max(x[2] + square, 0.0))), float(np.sqrt(max(x[3] + square, 0.0)))


def _clusters(
    residuals: Float[np.ndarray, " g"], weights: Float[np.ndarray, " g"], frame: Int[np.ndarray, " g"]
) -> float:
    """How much more the mean of a frame scatters than that of independent groups, in variance; at least 1."""
    index = np.unique(frame, return_inverse=True)[1]
    sums = np.bincount(index, weights * residuals)
    squares = float(np.sum((weights * residuals) ** 2))
    return max(1.0, float(np.sum(sums**2)) / squares) if squares > 0 else 1.0
