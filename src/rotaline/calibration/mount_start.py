"""Where an artefact stands on the turntable, well enough for the joint estimate to start there.

The stripes of all frames, turned back to angle 0 about the start axis, are a cloud of the artefact's surface, with the table and
whatever holds the artefact in it. A body of revolution stands nearly upright: seen along the axis, every point of a side votes for
the centres of the circles of known radius through it, and the centre of most votes is the artefact's axis; the height follows from
the discs and the ends of the sides. A sphere of known radius is found by sampling. Then the pose is fitted to the points near the surfaces, robustly,
with the points assigned anew in each step. No piece of a single stripe has to be recognised, so a few frames, broken stripes and
inclined laser planes do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.artifact import ArtifactCapture, ArtifactOptions, find_axis_from_artifact
from rotaline.calibration.feature_points import extract_mount_features
from rotaline.calibration.joint.model import MountStart
from rotaline.calibration.observations import MountObservation
from rotaline.errors import CalibrationError, GeometryError
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, Line, Plane, SteppedCylinder
from rotaline.geometry.robust import cauchy_weights, mad_scale
from rotaline.geometry.sampling import sample_consensus
from rotaline.geometry.transforms import base_from_axis
from rotaline.vision.camera import CameraModel

MAX_POINTS = 6000
"""Points of a mount that are looked at."""
MIN_POINTS = 60
MIN_FRAMES = 4
N_FEATURE_FRAMES = 36
"""Frames of a mount whose feature points show the axis where nothing else does."""

_N_VOTERS = 2500
_N_DIRECTIONS = 180
_MAX_TILT_RAD = np.radians(15.0)
_NEAR = 0.04
"""Points this near to a surface belong to it, as a share of the artefact's radius."""
_REACH = 20.0
"""Points further than this from the middle of all are left out, in radii of the artefact."""
_LEAST_SHARE = 0.6
"""Of the points in the place of the artefact, those that lie on it."""


@dataclass(frozen=True)
class _Outline:
    """The surfaces of a body of revolution in its ``part`` frame, mm: ``sides`` radius, lower and upper end; ``discs`` height, inner and outer radius."""

    sides: tuple[tuple[float, float, float], ...]
    discs: tuple[tuple[float, float, float], ...]

    @staticmethod
    def of(artifact: SteppedCylinder | KnownCylinder) -> "_Outline":
        if isinstance(artifact, KnownCylinder):
            radius, height = artifact.diameter / 2, artifact.height
            if height is None:
                return _Outline(((radius, -np.inf, np.inf),), ())
            return _Outline(((radius, 0.0, height),), ((height, 0.0, radius),))
        r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
        step, top = artifact.height_large, artifact.height_large + artifact.height_small
        return _Outline(((r1, step, top), (r2, 0.0, step)), ((top, 0.0, r1), (step, r1, r2)))

    @property
    def radius(self) -> float:
        return max(radius for radius, _, _ in self.sides)


def start_mounts(
    camera: CameraModel,
    plane_camera: Plane,
    axis_camera: Line,
    turn_sense: int,
    mounts: Sequence[MountObservation],
) -> tuple[tuple[MountStart, ...], tuple[str, ...]]:
    """Poses of all mounts whose artefact is found in its stripes.

    Parameters
    ----------
    camera : CameraModel
    plane_camera : Plane   mm
    axis_camera : Line   start of the rotation axis, mm, direction up
    turn_sense : int   +1 if the turntable's angle is right-handed about the axis, else -1
    mounts : sequence of MountObservation

    Returns
    -------
    starts : of the mounts that were found, in their order; in the table frame of ``base_from_axis(axis_camera)``. The turn of the
        artefact about its own axis is arbitrary, and so is the height of a cylinder without a stated one: its lowest points are its bottom.
    warnings : a text for each mount that was not found, and why
    """
    starts, warnings = [], []
    for mount in mounts:
        cloud = _turned_back(camera, plane_camera, axis_camera, turn_sense, mount)
        try:
            pose = _place(cloud, mount.artifact)
        except (CalibrationError, GeometryError) as error:
            other = _turned_back(camera, plane_camera, axis_camera, -turn_sense, mount)
            warnings.append(
                f"{mount.name}: {error} It is left out of the calibration. {_advice(other, mount.artifact)}"
            )
        else:
            starts.append(MountStart(mount.name, pose))
    return tuple(starts), tuple(warnings)


def start_from_artifact(
    camera: CameraModel, plane_camera: Plane, mounts: Sequence[MountObservation], assumed_turn_sense: int
) -> tuple[Line, int]:
    """A start axis from stepped cylinders alone, see :func:`rotaline.calibration.artifact.find_axis_from_artifact`.

    Returns
    -------
    axis_camera : Line   mm, direction up
    turn_sense : int   the assumed one: nothing shows it (:data:`rotaline.calibration.artifact.SENSE_ASSUMED`)

    Raises
    ------
    CalibrationError
        If no artefact is a stepped cylinder, or its feature points do not lead to an axis.
    """
    stepped = [mount for mount in mounts if isinstance(mount.artifact, SteppedCylinder)]
    if not stepped:
        raise CalibrationError(
            "Without a target on the turntable only a stepped cylinder shows where the rotation axis is, and no artefact is "
            "one. Add an axis capture: a board on the turntable."
        )
    artifact = stepped[0].artifact
    assert isinstance(artifact, SteppedCylinder)
    captures = [_features(camera, plane_camera, mount, artifact) for mount in stepped if mount.artifact == artifact]
    return find_axis_from_artifact(
        captures, artifact, ArtifactOptions(assumed_turn_sense=1 if assumed_turn_sense > 0 else -1)
    )


def _features(
    camera: CameraModel, plane_camera: Plane, mount: MountObservation, artifact: SteppedCylinder
) -> ArtifactCapture:
    """Feature points of frames that are spread over the turn."""
    order = np.argsort(np.mod(mount.angles_rad, 2 * np.pi), kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(len(order), N_FEATURE_FRAMES)).astype(int))]
    found = extract_mount_features([mount.stripes[i] for i in chosen], camera, plane_camera, artifact)
    return ArtifactCapture(
        mount.name,
        tuple(mount.frame_names[i] for i in chosen),
        mount.angles_rad[chosen],
        np.array([f.points_camera for f in found]).reshape(-1, 4, 3),
        tuple(f.reason for f in found),
    )


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points of a mount in the table frame of the start axis, mm, and the frame that each comes from."""

    points_table: Float[np.ndarray, "n 3"]
    frame: Int[np.ndarray, " n"]

    def within(self, reach: float) -> "_Cloud":
        """Without stray points far from all others: a stripe seen on the wall may be metres away."""
        near = np.all(np.abs(self.points_table - np.median(self.points_table, axis=0)) < reach, axis=1)
        return _Cloud(self.points_table[near], self.frame[near])


def _turned_back(
    camera: CameraModel, plane_camera: Plane, axis_camera: Line, turn_sense: int, mount: MountObservation
) -> _Cloud:
    """Every n-th stripe point of a mount, so that ``MAX_POINTS`` remain, turned back to angle 0."""
    step = max(1, -(-sum(len(stripe) for stripe in mount.stripes) // MAX_POINTS))
    frame = np.repeat(np.arange(len(mount.stripes)), [len(stripe) for stripe in mount.stripes])[::step]
    uv = np.concatenate([np.empty((0, 2)), *(stripe.uv for stripe in mount.stripes)])[::step]
    points_camera = intersect_rays_with_plane(camera.rays(uv), plane_camera)
    met = np.isfinite(points_camera).all(axis=1)
    x, y, z = base_from_axis(axis_camera).apply(points_camera[met]).T
    cos, sin = np.cos(turn_sense * mount.angles_rad[frame[met]]), np.sin(turn_sense * mount.angles_rad[frame[met]])
    return _Cloud(np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1), frame[met])


def _place(cloud: _Cloud, artifact: Artifact) -> RigidTransform:
    """``table_from_part`` of an artefact.

    Raises
    ------
    CalibrationError, GeometryError
        If the points do not show it; the message says how far they do.
    """
    if len(cloud.points_table) < MIN_POINTS or len(np.unique(cloud.frame)) < MIN_FRAMES:
        raise CalibrationError(
            f"there are {len(cloud.points_table)} stripe points in {len(np.unique(cloud.frame))} frames; at least {MIN_POINTS} "
            f"in {MIN_FRAMES} frames are needed."
        )
    if isinstance(artifact, KnownSphere):
        radius = artifact.diameter / 2
        return _place_sphere(cloud.within(_REACH * radius), radius)
    outline = _Outline.of(artifact)
    return _place_outline(cloud.within(_REACH * outline.radius), outline)


def _advice(other_sense: _Cloud, artifact: Artifact) -> str:
    """What to check where an artefact was not found."""
    try:
        _place(other_sense, artifact)
    except (CalibrationError, GeometryError):
        return (
            "Check that session.toml names the right artefact with its sizes in the right order, that it was not moved, that "
            "angle_deg covers a good part of the turn, and exposure."
        )
    return "If the table turned the other way, it would be found: check the sign of angle_deg in this capture and in the axis capture."


def _place_outline(cloud: _Cloud, outline: _Outline) -> RigidTransform:
    near = _NEAR * outline.radius
    x, y = _circle_centre(cloud.points_table[:, :2], [radius for radius, _, _ in outline.sides])
    rho = np.hypot(cloud.points_table[:, 0] - x, cloud.points_table[:, 1] - y)
    z = _bottom(rho, cloud.points_table[:, 2], outline, near)
    pose = RigidTransform.from_translation([x, y, z])
    for tolerance in (3 * near, 2 * near, near, near, near):
        pose = _improved(pose, cloud.points_table, outline, tolerance)
    tilt = float(np.arccos(np.clip(pose.rotation.as_matrix()[2, 2], -1.0, 1.0)))
    if tilt > _MAX_TILT_RAD:
        raise CalibrationError(
            f"the artefact seems to lean by {np.degrees(tilt):.0f} deg; expected one that stands on the table."
        )
    part = pose.inv().apply(cloud.points_table)
    distance, _, on_side = _nearest(part, outline)
    on_surface, rho = np.abs(distance) < near, np.hypot(part[:, 0], part[:, 1])
    endless = not np.isfinite(outline.sides[-1][1])
    low, below, above = np.quantile(part[on_surface, 2], [0.01, 0.1, 0.9]) if on_surface.any() else np.zeros(3)
    if endless:  # a top disc and the table may be seen beyond the ends of what is known
        within = (np.abs(rho - outline.radius) < 4 * near) & (part[:, 2] > below) & (part[:, 2] < above)
    else:
        within = (rho < outline.radius + near) & (part[:, 2] > -near)
    _require(on_surface & within, on_side & on_surface, within, cloud.frame)
    return pose * RigidTransform.from_translation([0.0, 0.0, float(low)]) if endless else pose


def _require(
    on_surface: Bool[np.ndarray, " n"],
    on_round: Bool[np.ndarray, " n"],
    within: Bool[np.ndarray, " n"],
    frame: Int[np.ndarray, " n"],
) -> None:
    """The artefact must explain most of the points in its place, and its round surfaces must be seen in frames enough."""
    share = float(on_surface.sum()) / max(float(within.sum()), 1.0)
    n_frames = len(np.unique(frame[on_round]))
    if share < _LEAST_SHARE or n_frames < MIN_FRAMES or np.count_nonzero(on_round) < MIN_POINTS:
        raise CalibrationError(
            f"the artefact with the stated sizes was not found in its stripes: where it fits best, {100 * share:.0f} % of the points "
            f"there lie on it, its round surfaces are seen in {n_frames} frames; expected at least {100 * _LEAST_SHARE:.0f} % and "
            f"{MIN_FRAMES} frames."
        )


def _circle_centre(xy: Float[np.ndarray, "n 2"], radii: Sequence[float]) -> tuple[float, float]:
    """The point that most circles of the given radii through the points have in common (Hough), mm."""
    voters = xy[:: -(-len(xy) // _N_VOTERS)]
    cell = 2 * np.pi * max(radii) / _N_DIRECTIONS
    angles = np.linspace(0.0, 2 * np.pi, _N_DIRECTIONS, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    centres = np.concatenate([(voters[:, None] + radius * ring).reshape(-1, 2) for radius in radii])
    low = centres.min(axis=0)
    index = ((centres - low) / cell).astype(int)
    shape = (int(index[:, 0].max()) + 1, int(index[:, 1].max()) + 1)
    votes = np.bincount(np.ravel_multi_index((index[:, 0], index[:, 1]), shape), minlength=shape[0] * shape[1])
    smooth = gaussian_filter(votes.reshape(shape).astype(float), 1.0, mode="constant")
    best = low + cell * (np.array(np.unravel_index(int(np.argmax(smooth)), shape)) + 0.5)
    return float(best[0]), float(best[1])


def _bottom(rho: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"], outline: _Outline, near: float) -> float:
    """Height of the bottom at which most points lie on the outline, mm; 0 where nothing shows it."""
    if not np.isfinite(outline.sides[-1][1]):
        return 0.0
    tallest = max(high for _, _, high in outline.sides)
    cell = near / 4
    start = float(z.min()) - tallest
    votes = np.zeros(int((z.max() - start) / cell) + 2)

    def vote(lowest: Float[np.ndarray, " m"], highest: Float[np.ndarray, " m"]) -> None:
        """Each point allows a range of heights of the bottom."""
        for ends, sign in ((lowest, 1.0), (highest, -1.0)):
            np.add.at(votes, np.clip(((ends - start) / cell).astype(int), 0, len(votes) - 1), sign)

    for radius, low, high in outline.sides:
        mine = z[np.abs(rho - radius) < near]
        vote(mine - high, mine - low)
    for height, inner, outer in outline.discs:
        mine = z[(rho > inner + near * (inner > 0)) & (rho < outer - near)]
        vote(mine - height - near / 2, mine - height + near / 2)
    votes = np.cumsum(votes)
    best = np.flatnonzero(votes >= votes.max() - 1e-9)
    return start + cell * (float(best.mean()) + 0.5)


def _nearest(
    part: Float[np.ndarray, "n 3"], outline: _Outline
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Signed distance of each point from the surface that is nearest to it, its normal there, and whether that is a side; inf where none is."""
    rho, z = np.hypot(part[:, 0], part[:, 1]), part[:, 2]
    distance, on_side = np.full(len(part), np.inf), np.zeros(len(part), dtype=bool)
    for radius, low, high in outline.sides:
        mine = (z > low) & (z < high) & (np.abs(rho - radius) < np.abs(distance))
        distance[mine], on_side[mine] = (rho - radius)[mine], True
    for height, inner, outer in outline.discs:
        mine = (rho >= inner) & (rho <= outer) & (np.abs(z - height) < np.abs(distance))
        distance[mine], on_side[mine] = (z - height)[mine], False
    outward = part[:, :2] / np.where(rho > 0, rho, 1.0)[:, None]
    normal = np.column_stack([outward * on_side[:, None], ~on_side])
    return distance, normal, on_side


def _improved(
    pose: RigidTransform, points_table: Float[np.ndarray, "n 3"], outline: _Outline, tolerance: float
) -> RigidTransform:
    """One robust step of least squares over position and tilt, from the points within the tolerance of their surface."""
    part = pose.inv().apply(points_table)
    distance, normal, _ = _nearest(part, outline)
    near = np.abs(distance) < tolerance
    if np.count_nonzero(near) < MIN_POINTS:
        return pose
    return pose * _step(part[near], normal[near], distance[near], n_turns=2)


def _step(
    part: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], distance: Float[np.ndarray, " n"], n_turns: int
) -> RigidTransform:
    """The small motion of the part that takes its surfaces to the points; ``n_turns`` 2: about x and y too, 0: shift only.

    A part moved by a shift t and a turn w sees its points move by -(t + w x p): the distances change by -(n . t + (p x n) . w).
    """
    weight = np.sqrt(cauchy_weights(distance, mad_scale(distance)))
    rows = np.column_stack([normal, np.cross(part, normal)[:, :n_turns]]) * weight[:, None]
    lengths = np.linalg.norm(rows, axis=0)
    scale = np.where(lengths > 0, lengths, 1.0)
    motion = np.linalg.lstsq(rows / scale, distance * weight, rcond=1e-6)[0] / scale
    turn = np.append(motion[3:], np.zeros(6 - len(motion)))
    return RigidTransform.from_components(motion[:3], Rotation.from_rotvec(turn))


def _place_sphere(cloud: _Cloud, radius: float) -> RigidTransform:
    points, near = cloud.points_table, _NEAR * radius

    def propose(samples: np.ndarray) -> np.ndarray:
        """Both spheres of the radius through three points: their centres lie above and below the middle of the circle."""
        a, b, c = (points[samples[:, k]] for k in range(3))
        u, v = b - a, c - a
        w = np.cross(u, v)
        with np.errstate(divide="ignore", invalid="ignore"):
            arm = np.cross(np.sum(u**2, axis=1)[:, None] * v - np.sum(v**2, axis=1)[:, None] * u, w)
            arm = arm / (2 * np.sum(w**2, axis=1))[:, None]
            lift = np.sqrt((radius**2 - np.sum(arm**2, axis=1)) / np.sum(w**2, axis=1))
        return np.concatenate([a + arm + lift[:, None] * w, a + arm - lift[:, None] * w])

    def score(models: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        return np.abs(np.linalg.norm(points[chosen][None] - models[:, None], axis=2) - radius)

    centre, _ = sample_consensus(len(points), 3, near, np.random.default_rng(0), propose, score, 3, "sphere")
    pose = RigidTransform.from_translation(centre)
    for _ in range(5):
        part = pose.inv().apply(points)
        length = np.linalg.norm(part, axis=1)
        mine = np.abs(length - radius) < near
        normal = part / np.where(length > 0, length, 1.0)[:, None]
        if np.count_nonzero(mine) < MIN_POINTS:
            break
        pose = pose * _step(part[mine], normal[mine], (length - radius)[mine], n_turns=0)
    length = np.linalg.norm(pose.inv().apply(points), axis=1)
    on_sphere = np.abs(length - radius) < near
    _require(on_sphere, on_sphere, length < radius + near, cloud.frame)
    return pose
