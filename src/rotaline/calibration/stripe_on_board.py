"""Stripe points on a flat target: which lie on it, away from its print and on one straight line, and where in space.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 3.1 (viewing rays meet the plane of the target)
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.calibration.pose import BoardPose, estimate_board_pose
from rotaline.errors import DetectionError, GeometryError
from rotaline.geometry.fitting_lines import Line2DFit, fit_line_2d
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import Plane
from rotaline.geometry.robust import mad_scale, ransac_line_2d
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import FLAT, CharucoBoard, DotGrid, Target, TargetDetection, target_height

MIN_POINTS = 6
_ASSUMED_DIAMETER = 0.5
"""Diameter of a dot, in units of the pitch, where the target does not state it."""


@dataclass(frozen=True, eq=False)
class StripeView:
    """A target in one pose and the laser stripe on it.

    ``name`` is ``folder/image`` of the frame with the stripe, ``detection_name`` of the one with the target.
    """

    name: str
    detection: TargetDetection
    stripe: StripePoints
    detection_name: str = ""


@dataclass(frozen=True, eq=False)
class PlacedStripe:
    """Points of a stripe on a target, on one straight line and clear of the print.

    Attributes
    ----------
    pose : BoardPose   of the target
    pivot_camera : (3,)   centre of the target's points, mm, about which ``pose.cov_pose`` counts rotations
    plane_camera : Plane   of the target, normal away from the camera
    uv : (n, 2)   px
    xy_undistorted : (n, 2)   normalised coordinates without distortion
    points_camera : (n, 3)   mm, ordered along the stripe
    xy_board : (n, 2)   mm, in the ``board`` frame
    line_board : Line2DFit   of ``xy_board``; the weights of the fit are those of the points
    u_mm : (n,)   standard uncertainty of a point across the stripe on the board, as the extractor states it
    """

    pose: BoardPose
    pivot_camera: Float[np.ndarray, "3"]
    plane_camera: Plane
    uv: Float[np.ndarray, "n 2"]
    xy_undistorted: Float[np.ndarray, "n 2"]
    points_camera: Float[np.ndarray, "n 3"]
    xy_board: Float[np.ndarray, "n 2"]
    line_board: Line2DFit
    u_mm: Float[np.ndarray, " n"]


def place_stripe_on_board(camera: CameraModel, view: StripeView, clearance_widths: float) -> PlacedStripe:
    """Pose of the target and points of the stripe on it.

    Points off the target, near printed edges (where one half of the profile is darker than the other) and off the straight
    line that most of them form are left out. If too few are clear of the print, the distance asked for is reduced.

    Parameters
    ----------
    camera : CameraModel
    view : StripeView
    clearance_widths : distance from printed edges, in standard deviations of the stripe's profile

    Raises
    ------
    DetectionError
        If the pose or the stripe cannot be found; the message says why.
    """
    detection, stripe = view.detection, view.stripe
    if len(stripe) < MIN_POINTS:
        raise DetectionError(f"the stripe has {len(stripe)} points, at least {MIN_POINTS} are needed")
    try:
        pose = estimate_board_pose(camera, detection.points_board, detection.uv)
    except GeometryError as error:
        raise DetectionError(f"the target has no pose: {error}") from error
    plane = board_plane(pose)
    rays = camera.rays(stripe.uv)
    points = _meet_target(rays, plane, pose, detection.target)
    xy = pose.camera_from_board.inv().apply(np.nan_to_num(points))[:, :2]
    on_board = np.isfinite(points).all(axis=1) & _inside(detection.target, xy)
    if on_board.sum() < MIN_POINTS:
        raise DetectionError(
            f"only {int(on_board.sum())} of {len(stripe)} stripe points lie on the target, at least {MIN_POINTS} are needed"
        )
    mm_per_px = np.nan_to_num(points[:, 2]) / np.sqrt(camera.fx * camera.fy)
    half_width = np.where(np.isfinite(stripe.width_px), stripe.width_px, 0.0) * mm_per_px
    distance = _distance_from_print(detection.target, xy)
    for factor in (1.0, 0.5, 0.25, 0.0):
        clear = on_board & (distance > factor * clearance_widths * half_width)
        if clear.sum() >= max(3 * MIN_POINTS, 0.2 * on_board.sum()):
            break
    keep = np.flatnonzero(clear if clear.sum() >= MIN_POINTS else on_board)
    width = float(np.median(half_width[keep]))
    line_board, inliers = _straight(xy[keep], width if width > 0 else 0.2 * detection.target.pitch)
    keep = keep[inliers]
    order = np.argsort((xy[keep] - line_board.point) @ line_board.direction)
    keep = keep[order]
    return PlacedStripe(
        pose,
        pose.camera_from_board.apply(detection.points_board).mean(axis=0),
        plane,
        stripe.uv[keep],
        rays[keep, :2],
        points[keep],
        xy[keep],
        line_board,
        stripe.u_normal_px[keep] * mm_per_px[keep],
    )


def _meet_target(
    rays: Float[np.ndarray, "n 3"], plane_camera: Plane, pose: BoardPose, target: Target
) -> Float[np.ndarray, "n 3"]:
    """Where viewing rays meet the target, which may be bent: its height is small, so two corrections are enough."""
    points = intersect_rays_with_plane(rays, plane_camera)
    if target.bend == FLAT:
        return points
    board_from_camera = pose.camera_from_board.inv()
    slope = board_from_camera.rotation.apply(rays)[:, 2]
    for _ in range(2):
        places = board_from_camera.apply(np.nan_to_num(points))
        points = points + ((target_height(target, places[:, :2]) - places[:, 2]) / slope)[:, None] * rays
    return points


def board_plane(pose: BoardPose) -> Plane:
    """Plane of the target in the camera frame, normal away from the camera (offset <= 0)."""
    normal = pose.camera_from_board.rotation.apply([0.0, 0.0, 1.0])
    plane = Plane(normal, -float(normal @ pose.camera_from_board.translation))
    return plane if plane.offset <= 0 else plane.flipped()


def _inside(target: Target, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Points on the printed area: half a pitch beyond the outer dots, one square beyond the outer corners."""
    columns, rows = target.grid_size
    margin = (0.5 if isinstance(target, DotGrid) else 1.0) * target.pitch
    upper = np.array([columns - 1, rows - 1]) * target.pitch + margin
    return np.asarray(((xy > -margin) & (xy < upper)).all(axis=1))


def _distance_from_print(target: Target, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Distance from what spoils the profile, mm: dots (negative inside), edges of squares, the frame of markers."""
    pitch = target.pitch
    cell = np.abs(xy / pitch - np.round(xy / pitch)) * pitch  # distance to the nearest grid line, each way
    if isinstance(target, DotGrid):
        diameter = target.diameter if target.diameter is not None else _ASSUMED_DIAMETER * pitch
        nearest = np.clip(np.round(xy / pitch), 0, np.array(target.dots) - 1) * pitch
        return np.asarray(np.linalg.norm(xy - nearest, axis=1) - diameter / 2)
    distance = cell.min(axis=1)
    if isinstance(target, CharucoBoard):
        from_centre = (pitch / 2 - cell).max(axis=1)
        distance = np.minimum(distance, np.abs(from_centre - target.marker / 2))
    return np.asarray(distance)


def _straight(xy: Float[np.ndarray, "n 2"], width_mm: float) -> tuple[Line2DFit, Bool[np.ndarray, " n"]]:
    """The straight line of most points, and the points on it; limits from the stripe's width, then from the scatter."""
    try:
        fit, _ = ransac_line_2d(xy, width_mm, np.random.default_rng(0), MIN_POINTS)
    except GeometryError as error:
        raise DetectionError(f"the stripe on the target is not a straight line: {error}") from error
    inliers = np.abs(fit.signed_distance_to(xy)) <= width_mm
    for _ in range(10):
        sigma = max(mad_scale(fit.signed_distance_to(xy[inliers])), 1e-6 * width_mm)
        now = np.abs(fit.signed_distance_to(xy)) <= min(4 * sigma, 1.5 * width_mm)
        if now.sum() < MIN_POINTS or np.array_equal(now, inliers):
            break
        inliers = now
        fit = fit_line_2d(xy[inliers])
    return fit, inliers
