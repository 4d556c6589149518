"""What one frame shows of a target that a person holds: is it found, sharp, well exposed, where is it, how is it tilted.

The camera is not calibrated yet. A tilt is read from the plate's homography with a focal length that the plates seen so far give
(Zhang's closed form, :mod:`rotaline.calibration.zhang`), or a guess; some degrees are good enough to say which edge to move.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.special import erfinv

from rotaline.calibration.homography import fit_homography, map_homography, pose_from_homography
from rotaline.calibration.zhang import focal_from_homographies
from rotaline.errors import DetectionError, GeometryError
from rotaline.vision.images import Image, to_grey
from rotaline.vision.stripe.extract import extract_stripe
from rotaline.vision.targets.detect import TargetOptions, detect_target
from rotaline.vision.targets.model import CharucoBoard, DotGrid, Target, TargetDetection

PREVIEW_OPTIONS = TargetOptions(channel="grey", coarse_size_px=640)
"""Previews come several a second: a target is looked for once, in a small image, and measured in the whole one."""

DARK, SATURATED = 0.2, 0.05
"""White below this share of full scale is dark; more than this share of white at full scale is too bright."""

_GUESSED_FOCAL = 2.0
"""In units of the longer image side, until the plates tell."""
_STEPS = 41
_ROUND = 100.0
_MOST_EDGES = 400
_STRAIGHT = 0.7
"""Share of the points of a stripe on a plate that lie on one line; those around print do not."""

Edge = Literal["upper", "right", "lower", "left"]
EDGES: tuple[Edge, ...] = ("upper", "right", "lower", "left")


@dataclass(frozen=True)
class Blur:
    """How wide edges are: standard deviation (px) of the Gaussian blur that makes edges as steep, in the sharpest and the least sharp direction.

    ``pitch_px``: of the grid. A blur by motion over a length is as steep as a Gaussian one of ``length / sqrt(2 pi)``.
    """

    least_px: float
    most_px: float
    pitch_px: float

    @property
    def limit_px(self) -> float:
        """As much is harmless."""
        return max(1.5, 0.05 * self.pitch_px)

    @property
    def sharp(self) -> bool:
        """The points can be measured well."""
        return self.most_px <= self.limit_px

    @property
    def of_motion(self) -> bool:
        """Edges in one direction are much wider than in the other: it moved during the exposure."""
        return not self.sharp and self.most_px**2 - self.least_px**2 > 0.5 * self.most_px**2


@dataclass(frozen=True)
class Light:
    """Grey values of white, and the share of white that is at full scale; both as shares of 1."""

    white: float
    saturated: float


@dataclass(frozen=True, eq=False)
class Sighting:
    """What a frame shows. ``detection`` and ``blur`` are None where the target was not found; ``missing`` says why."""

    image_size: tuple[int, int]
    time_s: float
    light: Light
    detection: TargetDetection | None = None
    blur: Blur | None = None
    missing: str = ""


@dataclass(frozen=True, eq=False)
class View:
    """Where a target was seen: its points (px), its homography (px from mm), its centre (mm); of the stripe on it what is known, px."""

    uv: Float[np.ndarray, "n 2"]
    homography: Float[np.ndarray, "3 3"]
    centre_board: Float[np.ndarray, "1 2"]
    stripe_uv: Float[np.ndarray, "m 2"] | None = None

    @property
    def centre_uv(self) -> Float[np.ndarray, "2"]:
        """Image of the middle of the whole target, px."""
        return np.asarray(map_homography(self.homography, self.centre_board)[0])

    def with_stripe(self, stripe_uv: Float[np.ndarray, "m 2"] | None) -> "View":
        """The same with what was seen of the stripe."""
        return replace(self, stripe_uv=stripe_uv)


@dataclass(frozen=True, eq=False)
class Attitude:
    """How a target is held: its unit normal towards the camera (camera frame), and its distance, mm as far as the focal length is right."""

    normal_camera: Float[np.ndarray, "3"]
    distance_mm: float

    @property
    def tilt_deg(self) -> float:
        """Between its normal and the optical axis."""
        return math.degrees(math.acos(min(1.0, max(-1.0, -float(self.normal_camera[2])))))

    @property
    def nearest(self) -> Edge:
        """The edge, as it stands in the picture, that is nearest to the camera."""
        x, y, _ = self.normal_camera
        if abs(y) >= abs(x):
            return "upper" if y > 0 else "lower"
        return "left" if x > 0 else "right"


def look(image: Image, target: Target, time_s: float = 0.0, options: TargetOptions = PREVIEW_OPTIONS) -> Sighting:
    """What a frame shows of a target."""
    size = (image.shape[1], image.shape[0])
    grey = to_grey(image)
    full = float(np.iinfo(grey.dtype).max)
    try:
        detection = detect_target(image, target, options)
    except DetectionError as error:
        level = grey[::3, ::3]
        light = Light(float(np.quantile(level, 0.99)) / full, float(np.mean(level >= 0.995 * full)))
        return Sighting(size, time_s, light, missing=str(error))
    blur, light = _edges(grey, detection, full)
    return Sighting(size, time_s, light, detection, blur)


def view_of(detection: TargetDetection, stripe_uv: Float[np.ndarray, "m 2"] | None = None) -> View | None:
    """Where the target is; None where its points lie on a line."""
    centre = np.array([target_centre(detection.target)])
    try:
        homography = fit_homography(detection.points_board[:, :2], detection.uv)
    except GeometryError:
        return None
    return View(detection.uv, homography, centre, stripe_uv)


def target_centre(target: Target) -> tuple[float, float]:
    """The middle of a target's grid, mm, in the ``board`` frame."""
    columns, rows = target.grid_size
    return (columns - 1) * target.pitch / 2, (rows - 1) * target.pitch / 2


def focal_px(views: Sequence[View], image_size: tuple[int, int]) -> float:
    """The focal length that plates give, px; a guess where they do not."""
    camera = focal_from_homographies([v.homography for v in views], image_size) if views else None
    size = float(max(image_size))
    return float(np.clip(camera.fx, 0.6 * size, 8.0 * size)) if camera is not None else _GUESSED_FOCAL * size


def attitude_of(view: View, focal: float, image_size: tuple[int, int]) -> Attitude:
    """How the target is held, for a camera of this focal length (px) that looks through the middle of its image."""
    width, height = image_size
    to_normalised = np.array(
        [[1 / focal, 0.0, -(width - 1) / 2 / focal], [0.0, 1 / focal, -(height - 1) / 2 / focal], [0.0, 0.0, 1.0]]
    )
    try:
        camera_from_board = pose_from_homography(to_normalised @ view.homography)
    except GeometryError:
        return Attitude(np.array([0.0, 0.0, -1.0]), math.nan)
    normal = camera_from_board.rotation.as_matrix()[:, 2]
    centre = camera_from_board.apply(np.array([*view.centre_board[0], 0.0]))
    return Attitude(-normal if normal[2] > 0 else normal, float(np.linalg.norm(centre)))


def motion_px(before: Sighting, now: Sighting) -> float:
    """How far the points have moved, px (95 of 100 at most); inf where it cannot be told.

    Points are matched by place: the numbering of a symmetric target may change from frame to frame.
    """
    if before.detection is None or now.detection is None:
        return math.inf
    distance, _ = cKDTree(before.detection.uv).query(now.detection.uv)
    return float(np.quantile(distance, 0.8))  # points at the rim of the image come and go


def stripe_on(detection: TargetDetection, on: Image, off: Image) -> Float[np.ndarray, "m 2"]:
    """Points of the laser stripe (px) that lie on the target, between its outermost points; none where it does not run over it.

    The laser-off frame is a background only where the light of the room stays on with the laser; of both ways, that is taken which
    gives more of what a plane cuts out of a plate: a straight line.
    """
    try:
        hull = ConvexHull(detection.uv)
    except QhullError:
        return np.zeros((0, 2))
    best = np.zeros((0, 2))
    for background in (None, off):
        uv = extract_stripe(on, background).uv
        uv = uv[np.all(uv @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0.0, axis=1)]
        line = _on_a_line(uv, 0.004 * max(on.shape))
        if len(uv) and line.mean() >= _STRAIGHT and _extent(uv[line]) > _extent(best):
            best = uv[line]
    return np.asarray(best)


def _extent(uv: Float[np.ndarray, "n 2"]) -> float:
    return float(np.linalg.norm(np.ptp(uv, axis=0))) if len(uv) else 0.0


def _on_a_line(uv: Float[np.ndarray, "n 2"], tolerance_px: float) -> Bool[np.ndarray, " n"]:
    """The points near the line, of all lines through two of some, that has most of them near it."""
    some = uv[:: 1 + len(uv) // 40]
    best = np.zeros(len(uv), dtype=bool)
    for a, b in itertools.combinations(some, 2):
        along = b - a
        length = float(np.hypot(*along))
        if length > 10 * tolerance_px:
            near = np.abs((uv - a) @ np.array([-along[1], along[0]])) < tolerance_px * length
            if near.sum() > best.sum():
                best = near
    return best


def crosses(stripe_uv: Float[np.ndarray, "m 2"], detection: TargetDetection) -> bool:
    """Whether the stripe runs over a good part of the target: at least 40 % of its mean side."""
    if len(stripe_uv) < 10:
        return False
    return _extent(stripe_uv) >= 0.4 * math.sqrt(ConvexHull(detection.uv).volume)  # the "volume" in a plane is the area


def stripe_level(image: Image) -> float:
    """How bright the core of a stripe typically is, as a share of full scale; quick, for a picture that shows little else."""
    grey = image if image.ndim == 2 else image.max(axis=2)
    tops = [grey.max(axis=axis) for axis in (0, 1)]
    full = float(np.iinfo(image.dtype).max)
    return max(float(np.median(top[top >= 0.5 * top.max()])) for top in tops) / full


def _edges(grey: np.ndarray, detection: TargetDetection, full: float) -> tuple[Blur | None, Light]:
    """Blur and light of the edges between neighbouring points.

    From 1 px before an edge to 1 px behind it, a Gaussian blur lets the profile rise by ``erf(1 / (sqrt(2) sigma))`` of its contrast.
    """
    pitches, variances, normals, whites, saturated = [], [], [], [], []
    for step in _neighbours(detection.target):
        group = _samples(detection, step)
        if group is None:
            continue
        uv, unit, pitch = group
        lines = map_coordinates(grey, [uv[..., 1], uv[..., 0]], order=1, mode="nearest", output=np.float32)
        profile = lines.mean(axis=1)
        low, high = np.quantile(profile, (0.05, 0.95), axis=1)
        clear = high - low > 0.5 * np.median(high - low)
        if np.median(high - low) <= 0:
            continue
        step_px = np.linalg.norm(uv[clear, 0, 1] - uv[clear, 0, 0], axis=1)
        q = (profile[clear] - low[clear, None]) / (high - low)[clear, None]
        rise = np.clip(np.abs(_after(q, step_px, 1.0) - _after(q, step_px, -1.0)), 0.02, 0.998)
        variances.append(float(np.median(1.0 / (math.sqrt(2.0) * erfinv(rise)))) ** 2)
        normals.append(np.einsum("ea,eb->ab", unit[clear], unit[clear]) / len(q))
        pitches.append(pitch)
        whites.append(float(np.median(high)))
        saturated.append(float(np.mean(high >= 0.995 * full)))
    if not variances:
        return None, Light(0.0, 0.0)
    light = Light(float(np.median(whites)) / full, float(np.mean(saturated)))
    # n . C n = variance, C = mean (1 0, 0 1) + (d e, e -d); of two directions, the roundest blur that explains them
    rows = [[_ROUND, n[0, 0] - n[1, 1], 2 * n[0, 1]] for n in normals]
    mean, d, e = np.linalg.lstsq(np.array(rows), np.array(variances), rcond=None)[0]
    mean, apart = _ROUND * mean, math.hypot(d, e)
    least, most = math.sqrt(max(mean - apart, 0.0)), math.sqrt(max(mean + apart, 0.0))
    return Blur(least, most, float(np.median(pitches))), light


def _after(
    q: Float[np.ndarray, "e k"], step_px: Float[np.ndarray, " e"], distance_px: float
) -> Float[np.ndarray, " e"]:
    """Profiles at a distance from where they are nearest to a half."""
    middle = slice(_STEPS // 4, -(_STEPS // 4))
    at = np.argmin(np.abs(q[:, middle] - 0.5), axis=1) + _STEPS // 4 + distance_px / step_px
    before = np.clip(np.floor(at).astype(int), 0, _STEPS - 2)
    share = np.clip(at - before, 0.0, 1.0)
    rows = np.arange(len(q))
    return np.asarray((1 - share) * q[rows, before] + share * q[rows, before + 1])


def _neighbours(target: Target) -> tuple[tuple[int, int], ...]:
    """Steps (columns, rows) to the points towards which an edge is crossed or followed."""
    return ((1, 0), (0, 1), (1, 1), (1, -1)) if isinstance(target, DotGrid) else ((1, 0), (0, 1))


def _samples(
    detection: TargetDetection, step: tuple[int, int]
) -> tuple[Float[np.ndarray, "e 3 k 2"], Float[np.ndarray, "e 2"], float] | None:
    """Places of profiles across edges (three beside each other), their directions, and the mean pitch, px."""
    target = detection.target
    columns, rows = target.grid_size
    grid = np.full((rows, columns, 2), np.nan)
    grid.reshape(-1, 2)[detection.point_ids] = detection.uv
    dc, dr = step
    first = grid[max(0, -dr) : rows - max(0, dr), : columns - dc].reshape(-1, 2)
    second = grid[max(0, dr) : rows + min(0, dr) or rows, dc:].reshape(-1, 2)
    there = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
    first, second = first[there], second[there]
    if len(first) < 3:
        return None
    pick = slice(None, None, 1 + len(first) // _MOST_EDGES)
    first, second = first[pick], second[pick]
    along = second - first
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    pitch = length / math.hypot(dc, dr)
    if isinstance(target, DotGrid):  # across the rim of a dot, towards its neighbour
        radius = 0.5 * (target.diameter / target.pitch if target.diameter else 0.5) * pitch
        centre, normal, aside = first + unit * radius[:, None], unit, unit[:, ::-1] * [-1, 1]
        reach, spread = 0.8 * np.minimum(radius, length / 2 - radius), 0.15 * radius
    else:  # across the edge from corner to corner
        centre, normal, aside = (first + second) / 2, unit[:, ::-1] * [-1, 1], unit
        margin = 0.5 - 0.5 * target.marker / target.pitch if isinstance(target, CharucoBoard) else 0.4
        reach, spread = 0.9 * margin * pitch, 0.15 * pitch
    t = np.linspace(-1.0, 1.0, _STEPS)
    lines = centre[:, None] + np.array([-1.0, 0.0, 1.0])[None, :, None] * (spread[:, None] * aside)[:, None]
    uv = lines[:, :, None] + (t[None, :, None] * (reach[:, None] * normal)[:, None])[:, None]
    return uv, np.asarray(normal), float(np.median(pitch))
