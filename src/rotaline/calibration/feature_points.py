"""Feature points of a stepped cylinder: where neighbouring pieces of the stripe meet.

The stripe goes into the laser plane, its points are sorted into the pieces of the staircase
(:mod:`rotaline.calibration.stepped_profile`), a line is fitted to each piece (RANSAC, then robust least squares), and
neighbouring lines are cut: B1 top / small side, B2 small side / step, B3 step / large side, B4 large side / table. Near the
edges the stripe is bent, half lit and blurred; these points are left out and the lines drawn through.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 4.2, figures 5 and 13
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.calibration.stepped_profile import (
    LARGE_SIDE,
    PIECES,
    SMALL_SIDE,
    STEP,
    TABLE,
    TOP,
    IdentifiedProfile,
    Staircase,
    identify_profile,
)
from rotaline.errors import GeometryError
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder, unit
from rotaline.geometry.robust import CAUCHY, mad_scale, ransac_line_2d
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

_N_FIRST = 12
"""Frames of a mount that are searched without knowing up and the height of the top."""


_MAX_REWEIGHTS = 12
_STEEP_SINE = 0.02


@dataclass(frozen=True)
class FeatureOptions:
    """How the feature points of the stepped cylinder are found."""

    edge_margin_widths: float = field(
        default=3.0,
        metadata={"help": "stripe points nearer to an edge than this many stripe widths (FWHM) are left out"},
    )
    min_points: int = field(default=6, metadata={"help": "fewest stripe points on a piece"})


@dataclass(frozen=True, eq=False)
class FeaturePoints:
    """Feature points B1 ... B4 of one frame.

    Attributes
    ----------
    points_camera : (4, 3)   mm; NaN where a point was not found
    u_mm : (4,)   standard uncertainty of a point within the laser plane, larger direction, from the scatter of the stripe
    piece : (n,)   piece of each stripe point (index into ``PIECES``), -1 if it was not used
    reason : str   what was not found and why; empty if all four are there
    """

    points_camera: Float[np.ndarray, "4 3"]
    u_mm: Float[np.ndarray, "4"]
    piece: Int[np.ndarray, " n"]
    reason: str


def extract_feature_points(
    stripe: StripePoints,
    camera: CameraModel,
    laser_plane_camera: Plane,
    artifact: SteppedCylinder,
    axis_camera: Line | None = None,
    options: FeatureOptions | None = None,
) -> FeaturePoints:
    """Feature points of one frame; :func:`extract_mount_features` finds more where parts of the artefact are hidden.

    Parameters
    ----------
    stripe : StripePoints
    camera : CameraModel
    laser_plane_camera : Plane
    artifact : SteppedCylinder   its known sizes
    axis_camera : Line or None   rough rotation axis (direction up), if known: tells up, and the bend of the sides
    options : FeatureOptions
    """
    return extract_mount_features([stripe], camera, laser_plane_camera, artifact, axis_camera, options)[0]


def extract_mount_features(
    stripes: Sequence[StripePoints],
    camera: CameraModel,
    laser_plane_camera: Plane,
    artifact: SteppedCylinder,
    axis_camera: Line | None = None,
    options: FeatureOptions | None = None,
) -> tuple[FeaturePoints, ...]:
    """Feature points of all frames of one mount.

    Frames that show enough of the artefact tell where up is and how high it stands; with this, also frames that show
    only a part of it are used.
    """
    options = options or FeatureOptions()
    frame = _PlaneFrame.of(laser_plane_camera, axis_camera)
    profiles = [_Profile.of(stripe, camera, frame) for stripe in stripes]
    up_rad = np.pi / 2 if axis_camera is not None else None
    some = np.unique(np.linspace(0, len(profiles) - 1, min(len(profiles), _N_FIRST)).astype(int))
    known = _consensus([profiles[f].identify(artifact, up_rad, None) for f in some])
    if known is None and len(profiles) > len(some):
        known = _consensus([p.identify(artifact, up_rad, None) for p in profiles])
    found = [p.identify(artifact, up_rad, known) for p in profiles]
    sine = 0.0 if axis_camera is None else float(laser_plane_camera.normal @ axis_camera.direction)
    return tuple(
        _corners(profile, identified, frame, artifact, sine, options)
        for profile, identified in zip(profiles, found, strict=True)
    )


@dataclass(frozen=True, eq=False)
class _PlaneFrame:
    """Coordinates in the laser plane: x and y axes in the camera frame; y is up if that is known, else up in the image."""

    origin: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "2 3"]
    plane: Plane

    @staticmethod
    def of(plane: Plane, axis_camera: Line | None) -> "_PlaneFrame":
        normal = plane.normal
        upwards = np.array([0.0, -1.0, 0.0]) if axis_camera is None else axis_camera.direction
        if np.linalg.norm(np.cross(upwards, normal)) < 0.05:
            upwards = np.array([1.0, 0.0, 0.0])
        y = unit(upwards - (upwards @ normal) * normal)
        origin = -plane.offset * normal if axis_camera is None else axis_camera.point
        origin = origin - float(plane.normal @ origin + plane.offset) * normal
        return _PlaneFrame(origin, np.stack([np.cross(y, normal), y]), plane)

    def from_pixels(self, camera: CameraModel, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Pixels to the laser plane, mm; NaN where the ray does not meet it in front of the camera."""
        rays = camera.rays(uv)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -self.plane.offset / (rays @ self.plane.normal)
        depth[~(depth > 0)] = np.nan
        return (rays * depth[:, None] - self.origin) @ self.axes.T

    def to_camera(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        return np.asarray(self.origin + xy @ self.axes)


@dataclass(frozen=True, eq=False)
class _Profile:
    """A stripe in the laser plane: points, direction, and how long its width (FWHM, seen along the stripe) and a pixel are."""

    xy: Float[np.ndarray, "n 2"]
    tangent_rad: Float[np.ndarray, " n"]
    width_mm: Float[np.ndarray, " n"]
    pixel_mm: Float[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]

    @staticmethod
    def of(stripe: StripePoints, camera: CameraModel, frame: _PlaneFrame) -> "_Profile":
        along_px = np.stack([-stripe.normal[:, 1], stripe.normal[:, 0]], axis=1)
        xy = frame.from_pixels(camera, stripe.uv)
        step = frame.from_pixels(camera, stripe.uv + 0.5 * along_px) - frame.from_pixels(
            camera, stripe.uv - 0.5 * along_px
        )
        pixel = np.linalg.norm(step, axis=1)
        valid = np.isfinite(xy).all(axis=1) & np.isfinite(pixel)
        return _Profile(xy, np.arctan2(step[:, 1], step[:, 0]), 2.355 * stripe.width_px * pixel, pixel, valid)

    def tolerance(self, artifact: SteppedCylinder) -> float:
        """How far points may lie from the template, mm: a few per cent of the artefact, at least some pixels."""
        size = min(artifact.height_small, artifact.height_large)
        pixel = float(np.median(self.pixel_mm[self.valid])) if self.valid.any() else 0.0
        return max(0.04 * size, 3.0 * pixel)

    def identify(
        self, artifact: SteppedCylinder, up_rad: float | None, known: Staircase | None
    ) -> IdentifiedProfile | None:
        found = identify_profile(
            self.xy[self.valid], self.tangent_rad[self.valid], artifact, self.tolerance(artifact), up_rad, known
        )
        if found is None:
            return None
        piece = np.full(len(self.xy), -1)
        piece[self.valid] = found.piece
        return IdentifiedProfile(found.staircase, piece, found.score)


def _consensus(found: Sequence[IdentifiedProfile | None]) -> Staircase | None:
    """Up, outward and top that the well-seen frames share; None if there is only one frame."""
    good = [f.staircase for f in found if f is not None and f.n_pieces >= 4]
    if len(found) < 2 or not good:
        return None

    def alike(s: Staircase) -> list[Staircase]:
        return [t for t in good if t.outward == s.outward and np.cos(t.up_rad - s.up_rad) > np.cos(np.radians(3.0))]

    best = max((alike(s) for s in good), key=len)
    up = float(np.angle(np.mean(np.exp(1j * np.array([s.up_rad for s in best])))))
    return Staircase(up, best[0].outward, float(np.median([s.top for s in best])), None, None)


@dataclass(frozen=True, eq=False)
class _FittedLine:
    """A line in the laser plane: centroid, unit direction, and standard uncertainties of offset (mm) and direction (rad)."""

    centre: Float[np.ndarray, "2"]
    direction: Float[np.ndarray, "2"]
    u_offset: float
    u_direction: float

    def offset(self, point: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Along and across coordinates of a point."""
        arm = point - self.centre
        return np.array([arm @ self.direction, self.direction[0] * arm[1] - self.direction[1] * arm[0]])

    def u_at(self, point: Float[np.ndarray, "2"]) -> float:
        """Standard uncertainty of the line across itself, at a point."""
        return float(np.hypot(self.u_offset, self.u_direction * self.offset(point)[0]))


def _corners(
    profile: _Profile,
    identified: IdentifiedProfile | None,
    frame: _PlaneFrame,
    artifact: SteppedCylinder,
    sine: float,
    options: FeatureOptions,
) -> FeaturePoints:
    """Lines of the pieces, cut."""
    nothing = FeaturePoints(np.full((4, 3), np.nan), np.full(4, np.nan), np.full(len(profile.xy), -1), "")
    if identified is None:
        seen = f"{len(profile.xy)} stripe points" if len(profile.xy) else "no stripe"
        return _with_reason(nothing, f"the pieces of the stepped cylinder were not found ({seen})")
    piece = identified.piece.copy()
    rough = [_rough_line(profile, piece == k, options) for k in range(5)]
    edges = [_cut(rough[k], rough[k + 1]) for k in range(4)]
    for k in range(5):
        piece[
            (piece == k) & ~_clear_of_edges(profile, piece == k, rough[k], edges[max(k - 1, 0) : k + 1], options)
        ] = -1
    bends = _side_bends(rough, edges, identified.staircase, artifact, sine)
    lines = _fit_lines(profile, piece, rough, bends, options)
    if abs(sine) > _STEEP_SINE:  # the bends were taken from straight lines
        better = [_cut(lines[k], lines[k + 1], bends[k], bends[k + 1]) for k in range(4)]
        bends = _side_bends(lines, better, identified.staircase, artifact, sine)
        lines = _fit_lines(profile, piece, rough, bends, options)

    xy, u = np.full((4, 2), np.nan), np.full(4, np.nan)
    missing = []
    for k in range(4):
        corner = _cut(lines[k], lines[k + 1], bends[k], bends[k + 1])
        first, second = lines[k], lines[k + 1]
        if corner is None or first is None or second is None:
            lost = [PIECES[j] for j in (k, k + 1) if lines[j] is None]
            missing.append(f"B{k + 1} ({' and '.join(lost) or 'lines do not meet'} not seen)")
            continue
        xy[k] = corner
        u[k] = max(first.u_at(corner), second.u_at(corner))
    points = np.full((4, 3), np.nan)
    there = np.isfinite(xy[:, 0])
    points[there] = frame.to_camera(xy[there])
    return FeaturePoints(points, u, piece, "; ".join(missing))


def _with_reason(features: FeaturePoints, reason: str) -> FeaturePoints:
    return FeaturePoints(features.points_camera, features.u_mm, features.piece, reason)


def _rough_line(profile: _Profile, mine: Bool[np.ndarray, " n"], options: FeatureOptions) -> _FittedLine | None:
    """The line that most points of a piece lie on (RANSAC)."""
    if np.count_nonzero(mine) < options.min_points:
        return None
    threshold = float(np.median(profile.width_mm[mine])) / 2
    try:
        fit, _ = ransac_line_2d(profile.xy[mine], threshold, np.random.default_rng(0), options.min_points)
    except GeometryError:
        return None
    return _FittedLine(fit.point, fit.direction, 0.0, 0.0)


def _cut(
    first: _FittedLine | None, second: _FittedLine | None, bend_first: float = 0.0, bend_second: float = 0.0
) -> Float[np.ndarray, "2"] | None:
    """Where two lines meet; a bent line is a parabola with the given second derivative."""
    if first is None or second is None:
        return None
    normals = np.array([[-line.direction[1], line.direction[0]] for line in (first, second)])
    if abs(np.linalg.det(normals)) < 0.3:
        return None
    right = np.array([normals[0] @ first.centre, normals[1] @ second.centre])
    point = np.linalg.solve(normals, right)
    for _ in range(3 if bend_first or bend_second else 0):
        along = np.array([first.offset(point)[0], second.offset(point)[0]])
        point = np.linalg.solve(normals, right + 0.5 * np.array([bend_first, bend_second]) * along**2)
    return np.asarray(point)


def _clear_of_edges(
    profile: _Profile,
    mine: Bool[np.ndarray, " n"],
    line: _FittedLine | None,
    edges: Sequence[Float[np.ndarray, "2"] | None],
    options: FeatureOptions,
) -> Bool[np.ndarray, " n"]:
    """Points of a piece that lie between its edges, far enough from them and from the ends of what is seen."""
    clear = mine.copy()
    if line is None:
        return clear
    along = (profile.xy - line.centre) @ line.direction
    margin = options.edge_margin_widths * float(np.median(profile.width_mm[mine]))
    middle = float(np.median(along[mine]))
    for edge in edges:
        if edge is not None:
            position = float(line.offset(edge)[0])
            clear &= (along > position + margin) if middle > position else (along < position - margin)
    first, last = float(along[mine].min()), float(along[mine].max())
    clear &= (along > first + margin) & (along < last - margin)
    if np.count_nonzero(clear) >= options.min_points:
        return clear
    # a piece shorter than its margins: its middle half is the best there is
    return mine & (np.abs(along - (first + last) / 2) <= (last - first) / 4)


def _side_bends(
    lines: Sequence[_FittedLine | None],
    edges: Sequence[Float[np.ndarray, "2"] | None],
    staircase: Staircase,
    artifact: SteppedCylinder,
    sine: float,
) -> list[float]:
    """Second derivative of each piece's line, 1/mm: a plane inclined to the cylinder's axis cuts the sides in ellipses.

    At the distance a of the plane from the axis a side of radius r lies at x = sqrt(r^2 - a^2); a changes with height by the
    sine of the inclination, so x'' = -sine^2 r^2 / x^3. The width of the step tells x.
    """
    bends = [0.0] * 5
    if sine == 0.0 or edges[1] is None or edges[2] is None:
        return bends
    r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
    edge = staircase.coordinates(np.stack([edges[1], edges[2]]))[:, 0]
    width = float(edge[1] - edge[0])
    if width <= 0:
        return bends
    axis = float(edge[0]) - float(np.clip((r2**2 - r1**2 - width**2) / (2 * width), 0.2 * r1, r1))
    outward = staircase.coordinates(np.eye(2))[:, 0]
    for k, radius in ((SMALL_SIDE, r1), (LARGE_SIDE, r2)):
        line = lines[k]
        if line is not None:
            across = np.array([-line.direction[1], line.direction[0]])
            x = float(np.clip(line.centre @ outward - axis, 0.2 * radius, radius))
            bends[k] = -(sine**2) * radius**2 / x**3 * float(np.sign(across @ outward))
    return bends


def _fit_lines(
    profile: _Profile,
    piece: Int[np.ndarray, " n"],
    rough: Sequence[_FittedLine | None],
    bends: Sequence[float],
    options: FeatureOptions,
) -> list[_FittedLine | None]:
    """Robust lines of all pieces; top and step, cut by one plane from two parallel discs, share their direction."""
    lines: list[_FittedLine | None] = [None] * 5
    for group in ((TOP, STEP), (SMALL_SIDE,), (LARGE_SIDE,), (TABLE,)):
        parts = []
        for k in group:
            line = rough[k]
            if line is not None and np.count_nonzero(piece == k) >= options.min_points:
                parts.append((k, profile.xy[piece == k], line))
        fitted = _fit_parallel([xy for _, xy, _ in parts], [line for _, _, line in parts], [bends[k] for k in group])
        for (k, _, _), line in zip(parts, fitted, strict=True):
            lines[k] = line
    return lines


def _fit_parallel(
    pieces: Sequence[Float[np.ndarray, "_ 2"]], starts: Sequence[_FittedLine], bends: Sequence[float]
) -> list[_FittedLine]:
    """Parallel lines through sets of points, orthogonal least squares with Cauchy weights."""
    if not pieces:
        return []
    longest = int(np.argmax([len(xy) for xy in pieces]))
    direction = starts[longest].direction
    centres = [start.centre for start in starts]
    weights = [np.ones(len(xy)) for xy in pieces]
    across = [np.zeros(len(xy)) for xy in pieces]
    for _ in range(_MAX_REWEIGHTS):
        normal = np.array([-direction[1], direction[0]])
        straight = [
            xy - 0.5 * bend * (((xy - centre) @ direction) ** 2)[:, None] * normal
            for xy, centre, bend in zip(pieces, centres, bends, strict=False)
        ]
        centres = [np.average(xy, axis=0, weights=w) for xy, w in zip(straight, weights, strict=True)]
        arms = [xy - centre for xy, centre in zip(straight, centres, strict=True)]
        scatter = sum((arm * w[:, None]).T @ arm for arm, w in zip(arms, weights, strict=True))
        last, direction = direction, np.linalg.eigh(scatter)[1][:, 1]
        direction = direction * np.sign(direction @ last)
        normal = np.array([-direction[1], direction[0]])
        across = [arm @ normal for arm in arms]
        scales = [max(CAUCHY * mad_scale(a), 1e-9) for a in across]
        weights = [1.0 / (1.0 + (a / scale) ** 2) for a, scale in zip(across, scales, strict=True)]
        if np.abs(direction - last).max() < 1e-6:
            break

    power = sum(float(w @ (arm @ direction) ** 2) for arm, w in zip(arms, weights, strict=True))
    spread = float(np.sqrt(np.average(np.concatenate(across) ** 2, weights=np.concatenate(weights))))
    lines = []
    for centre, a, w in zip(centres, across, weights, strict=True):
        sigma = float(np.sqrt(np.average(a**2, weights=w))) * _correlation_factor(a)
        u_offset = sigma / np.sqrt(max(w.sum() - 2, 1.0))
        lines.append(_FittedLine(centre, direction, float(u_offset), spread * _correlation_factor(a) / np.sqrt(power)))
    return lines


def _correlation_factor(residuals: Float[np.ndarray, " n"]) -> float:
    """How much neighbouring points that err alike enlarge the uncertainty of their mean."""
    power = float(residuals @ residuals)
    if len(residuals) < 8 or power == 0.0:
        return 1.0
    rho = float(np.clip(residuals[1:] @ residuals[:-1] / power, 0.0, 0.9))
    return float(np.sqrt((1 + rho) / (1 - rho)))
