"""What the calibration stages return, and the system that they make up together.

Every value carries the observations behind it, so that the report can show residuals without doing a stage again.
Lengths in mm, angles in rad, image errors in px; frames stand in the names. Rows of NaN mark elements that are missing.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import RigidTransform

from rotaline.geometry.primitives import Line, Plane, SheetCurvature
from rotaline.geometry.transforms import base_from_axis
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Target, TargetDetection


@dataclass(frozen=True, eq=False)
class TargetView:
    """A target detected in one image of the session; ``name`` is ``folder/image``.

    ``angle_rad`` is that of the turntable, where it plays a part; ``u_angle_rad`` its standard uncertainty, 0 where none is stated.
    """

    name: str
    detection: TargetDetection
    angle_rad: float | None = None
    u_angle_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class CameraView:
    """One view in the camera calibration; ``reason`` says why it was left out (empty if used).

    ``residuals_px`` are observed minus projected; rows of points that were left out of a used view are NaN.
    """

    name: str
    used: bool
    reason: str
    camera_from_board: RigidTransform
    rms_px: float
    uv: Float[np.ndarray, "n 2"]
    residuals_px: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Camera with the standard deviations of its parameters and the residuals of every view.

    ``rms_px`` is sqrt(mean |residual|^2) over the points of the used views (the figure that OpenCV prints);
    ``mean_error_px`` is the mean length of a residual (the figure of the article). ``targets_as_stated[k]`` was found to be
    ``targets[k]``: bent, where the views show it. ``notes`` tell what was found about the targets and is taken into account.
    """

    camera: CameraModel
    parameter_names: tuple[str, ...]
    u_parameters: Float[np.ndarray, " p"]
    views: tuple[CameraView, ...]
    rms_px: float
    mean_error_px: float
    warnings: tuple[str, ...]
    targets_as_stated: tuple[Target, ...] = ()
    targets: tuple[Target, ...] = ()
    notes: tuple[str, ...] = ()

    def with_target_as_found(self, detection: TargetDetection) -> TargetDetection:
        """The detection, on its target as the camera calibration found it."""
        if detection.target not in self.targets_as_stated:
            return detection
        return replace(detection, target=self.targets[self.targets_as_stated.index(detection.target)])


@dataclass(frozen=True, eq=False)
class StripeOnBoard:
    """The stripe on a target in one pose: points on the board's plane and their distance from the laser plane."""

    name: str
    used: bool
    reason: str
    camera_from_board: RigidTransform
    uv: Float[np.ndarray, "n 2"]
    points_camera: Float[np.ndarray, "n 3"]
    residuals_mm: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class LaserPlaneCalibration:
    """The laser plane fitted to the stripes on all boards.

    ``rms_mm`` is over the points used; ``u_normal_rad`` are the standard uncertainties of the normal along the two
    principal directions of the points, larger first; ``u_offset_mm`` that of the plane at the centroid of the points.
    """

    plane_camera: Plane
    views: tuple[StripeOnBoard, ...]
    rms_mm: float
    u_normal_rad: tuple[float, float]
    u_offset_mm: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class CrossRatioResult:
    """Laser plane optimisation by cross-ratio invariance, eq. (4)-(7): intervals before and after.

    One entry per interval: ``view`` indexes ``names``, ``row`` is the first of the two dot rows (or columns).
    ``accepted`` is False, with the reason, where the optimised plane is not better; then ``plane_camera`` is the one
    that came in, while ``measured_after_mm`` and ``rmse_after_mm`` show what the optimised one would do. ``history_mm[k]`` is
    the objective (7) after iteration k (0: at the start).
    """

    plane_camera: Plane
    plane_before_camera: Plane
    accepted: bool
    reason: str
    names: tuple[str, ...]
    view: Int[np.ndarray, " m"]
    row: Int[np.ndarray, " m"]
    reference_mm: Float[np.ndarray, " m"]
    measured_before_mm: Float[np.ndarray, " m"]
    measured_after_mm: Float[np.ndarray, " m"]
    rmse_before_mm: float
    rmse_after_mm: float
    n_iterations: int
    converged: bool
    history_mm: Float[np.ndarray, " k"]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class AxisFrame:
    """One frame of the target on the turntable."""

    name: str
    used: bool
    reason: str
    angle_rad: float
    camera_from_board: RigidTransform
    rms_px: float


@dataclass(frozen=True, eq=False)
class AxisCalibration:
    """Initial rotation axis from a target on the turntable, eq. (8)-(10).

    ``turn_sense`` is +1 if ``angle_deg`` of the session is right-handed about ``axis_camera.direction`` (which points up).
    ``corners_camera[f, i]`` is corner ``point_ids[i]`` in frame f (NaN where not seen); circle i has the centre
    ``circle_centres_camera[i]``. ``rms_mm`` is the distance of the corners from their circles.
    """

    axis_camera: Line
    turn_sense: int
    frames: tuple[AxisFrame, ...]
    point_ids: Int[np.ndarray, " m"]
    corners_camera: Float[np.ndarray, "f m 3"]
    circle_centres_camera: Float[np.ndarray, "m 3"]
    circle_radii_mm: Float[np.ndarray, " m"]
    circle_rms_mm: Float[np.ndarray, " m"]
    rms_mm: float
    centre_line_rms_mm: float
    u_direction_rad: float
    u_position_mm: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ArtifactMount:
    """The stepped cylinder in one mount.

    ``features_camera[f, h]`` is feature point B_(h+1) of frame f (NaN where not found);
    ``features_before_base`` / ``features_base`` are the same points turned back to angle 0 about the initial / the optimised
    axis, in the base frame of that axis. ``distances_*_mm[f, h]`` are eq. (13) of the ideal circle in the pose
    ``base_from_part``. ``eccentricity_mm`` is the distance of the cylinder's axis from the rotation axis at mid height.
    """

    name: str
    frame_names: tuple[str, ...]
    angles_rad: Float[np.ndarray, " f"]
    frame_used: tuple[bool, ...]
    frame_reasons: tuple[str, ...]
    features_camera: Float[np.ndarray, "f 4 3"]
    features_before_base: Float[np.ndarray, "f 4 3"]
    features_base: Float[np.ndarray, "f 4 3"]
    distances_before_mm: Float[np.ndarray, "f 4"]
    distances_mm: Float[np.ndarray, "f 4"]
    base_from_part_before: RigidTransform
    base_from_part: RigidTransform
    mean_distance_before_mm: float
    mean_distance_mm: float
    eccentricity_mm: float


@dataclass(frozen=True, eq=False)
class ArtifactCalibration:
    """Axis optimised with the stepped cylinder, eq. (11)-(14), over all mounts together.

    ``history_mm[k]`` is the objective (14), mean distance over all mounts, after iteration k (0: at the start).
    ``u_direction_rad`` and ``u_position_mm`` are the larger standard uncertainties of the axis, from the residuals.
    """

    method: str
    axis_camera: Line
    axis_before_camera: Line
    mounts: tuple[ArtifactMount, ...]
    mean_distance_before_mm: float
    mean_distance_mm: float
    n_iterations: int
    converged: bool
    history_mm: Float[np.ndarray, " k"]
    u_direction_rad: float
    u_position_mm: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class AngleError:
    """Once-per-turn error of the angle read-out: the table has turned by ``read + cos_rad cos(read) + sin_rad sin(read)``.

    In the sense of the read-out (before ``turn_sense`` is applied); rad.
    """

    cos_rad: float = 0.0
    sin_rad: float = 0.0

    def turned_rad(self, read_rad: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
        """How far the table has turned when the read-out says ``read_rad``."""
        return np.asarray(read_rad + self.cos_rad * np.cos(read_rad) + self.sin_rad * np.sin(read_rad))


@dataclass(frozen=True, eq=False)
class TableMotion:
    """Movements of the rotation axis once per turn that turn against the table; what turns with it is another place of the part.

    With the table turned by ``phi`` (right-handed about base z) and ``against = R(-phi)`` in the plane of x and y, the axis stands shifted by
    ``against @ run_out_mm`` and tilted by the rotation vector ``against @ wobble_rad`` about ``pivot_camera``, both in the base frame:
    ``X_base = tilt (turn_z(phi) X_table) + shift``, with X counted from the pivot.
    """

    run_out_mm: tuple[float, float]
    wobble_rad: tuple[float, float]
    pivot_camera: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class SystemCovariance:
    """Covariance of what a scan is made with: errors that are common to all points of all scans.

    Small changes, in the order of ``names``:

    - camera parameters by their names (px; distortion without unit)
    - ``plane_turn_1``, ``plane_turn_2`` (rad), ``plane_offset`` (mm): the plane becomes
      ``normal . X + offset + (t1 e1 + t2 e2) . (X - plane_pivot) + h = 0`` with ``e1, e2 = across(normal)``
    - ``curvature_uu``, ``curvature_uv``, ``curvature_vv`` (1/mm), where the sheet is curved
    - ``axis_turn_x``, ``axis_turn_y`` (rad), ``axis_shift_x``, ``axis_shift_y`` (mm): the axis turns about x and y of the base
      frame, right-handed, about ``axis_pivot``, and moves along them; the frame moves with it
    - ``angle_cos``, ``angle_sin`` (rad): of :class:`AngleError`, where that was estimated
    - ``run_out_x``, ``run_out_y`` (mm), ``wobble_x``, ``wobble_y`` (rad): of :class:`TableMotion`, where that was estimated

    Attributes
    ----------
    names : (p,)
    matrix : (p, p)   k = 1
    plane_pivot_camera, axis_pivot_camera : (3,)   mm
    """

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "p p"]
    plane_pivot_camera: Float[np.ndarray, "3"]
    axis_pivot_camera: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class SystemCalibration:
    """All that a scan needs. ``rotation_axis_camera.point`` is the origin of the base frame: z = 0.

    ``table_seen``: z = 0 is the table top; otherwise it is the point of the axis nearest to the optical axis. ``laser_curvature``: None
    for a flat sheet. ``covariance``: None where it is not known. ``line_sigma_mm``: standard deviation of the laser line across the sheet, ``stripe_blur_px``
    that of the stripe which a line without width would make (lens and pixels); both 0 where they are not known.
    """

    camera: CameraModel
    laser_plane_camera: Plane
    rotation_axis_camera: Line
    turn_sense: int
    table_seen: bool
    laser_curvature: SheetCurvature | None = None
    angle_error: AngleError = AngleError()
    table_motion: TableMotion | None = None
    covariance: SystemCovariance | None = None
    line_sigma_mm: float = 0.0
    stripe_blur_px: float = 0.0

    @property
    def base_from_camera(self) -> RigidTransform:
        """Camera to base frame (see :func:`rotaline.geometry.transforms.base_from_axis`)."""
        return base_from_axis(self.rotation_axis_camera)
