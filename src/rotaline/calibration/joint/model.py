"""What the joint estimate returns: the system with its covariance, the residuals of every observation, and what it could not tell."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.model import (
    AngleError,
    AxisCalibration,
    CameraCalibration,
    LaserPlaneCalibration,
    SystemCovariance,
    TableMotion,
)
from rotaline.geometry.primitives import Artifact, Line, Plane, SheetCurvature
from rotaline.vision.camera import CameraModel

GroupKind = Literal["target", "plate-stripe", "table-target", "artifact"]


@dataclass(frozen=True, eq=False)
class ViewResiduals:
    """The residuals of one frame, px: of target points (n, 2), observed minus projected; of stripe points (n, 1), along the normal.

    ``weight`` is the robust weight of each point, 1 for one like the others, 0 for one that was left out. ``used`` is False, with a
    reason, for a frame that was left out; ``held_out_rms_px`` is what the frame shows when it takes no part in the estimate (its own pose
    is still fitted to it), NaN where that was not tried.
    """

    name: str
    used: bool
    reason: str
    uv: Float[np.ndarray, "n 2"]
    residuals_px: Float[np.ndarray, "n k"]
    weight: Float[np.ndarray, " n"]
    rms_px: float
    held_out_rms_px: float
    angle_rad: float


@dataclass(frozen=True, eq=False)
class ResidualGroup:
    """Residuals that share a scale: the target points or the stripes of one capture.

    ``sigma_px`` is the robust standard deviation of one residual; ``correlation_length`` how many neighbours along a stripe count as one
    (1 for target points); ``predicted_px`` the median of the uncertainty that the detector stated; ``rms_mm`` that of the distances of
    stripe points from where they should lie (NaN for target points). Errors of the frame itself, and of single points of targets, are taken off the residuals,
    except on artefacts: a scan has them too.
    """

    kind: GroupKind
    name: str
    views: tuple[ViewResiduals, ...]
    sigma_px: float
    rms_px: float
    predicted_px: float
    correlation_length: float
    n_points: int
    n_used: int
    rms_mm: float = float("nan")


@dataclass(frozen=True, eq=False)
class JointMount:
    """One mount of an artefact, with every stripe point on it.

    Attributes
    ----------
    name : folder
    artifact : as estimated (as stated where its sizes were not)
    table_from_part : RigidTransform   mm
    eccentricity_mm, u_eccentricity_mm : distance of the artefact's axis (of a sphere: its centre) from the rotation axis, at mid height
    tilt_rad : of the artefact's axis against the rotation axis; NaN for a sphere
    frame_names, angles_rad : (f,)
    frame : (n,)   of each point that lies on a surface
    surface : (n,)   index into ``surfaces``
    points_part : (n, 3)   mm
    distances_mm : (n,)   signed distance from the surface, positive outside
    residuals_px : (n,)
    weight : (n,)   robust weights
    surfaces : names of the surfaces, of a stepped cylinder "top disc", "small side", "step", "large side"
    mean_mm, rms_mm : (s,)   of the distances on each surface; of the points that were not left out as outliers
    held_out_rms_mm : RMS of the distances when the mount takes no part in the estimate of camera, plane and axis; NaN if not tried
    """

    name: str
    artifact: Artifact
    table_from_part: RigidTransform
    eccentricity_mm: float
    u_eccentricity_mm: float
    tilt_rad: float
    frame_names: tuple[str, ...]
    angles_rad: Float[np.ndarray, " f"]
    frame: Int[np.ndarray, " n"]
    surface: Int[np.ndarray, " n"]
    points_part: Float[np.ndarray, "n 3"]
    distances_mm: Float[np.ndarray, " n"]
    residuals_px: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    surfaces: tuple[str, ...]
    mean_mm: Float[np.ndarray, " s"]
    rms_mm: Float[np.ndarray, " s"]
    held_out_rms_mm: float

    @property
    def used(self) -> Bool[np.ndarray, " n"]:
        """Points that were not left out as outliers."""
        return self.weight > 0.1


@dataclass(frozen=True, eq=False)
class TableErrors:
    """Errors of the turntable from frame to frame: standard deviations, and what was found in each frame.

    ``sigma``, ``u_sigma`` in the order of ``names``: "angle" (rad), "run-out" (mm, in x and in y), "lift" (mm, along the axis), "wobble" (rad,
    about x and about y). ``frame_errors[f]`` = turn about x, y, z (rad), shift along x, y, z of the base frame (mm) of frame f; ``captures`` and
    ``angles_rad`` say which frame that is.
    """

    names: tuple[str, ...]
    sigma: Float[np.ndarray, " c"]
    u_sigma: Float[np.ndarray, " c"]
    captures: tuple[str, ...]
    frame_names: tuple[str, ...]
    angles_rad: Float[np.ndarray, " f"]
    frame_errors: Float[np.ndarray, "f 6"]


@dataclass(frozen=True)
class OptionalParameters:
    """Parameters that are estimated only where the data carry them.

    ``name``: "angle harmonics", "sheet curvature", "artefact sizes", "pitch of <target>". ``improvement`` is how much the weighted sum of
    squares falls (chi-square with as many degrees of freedom as ``values``). ``on`` says whether they are in the estimate; ``reason`` why or why not.
    ``values`` and ``u`` hold numbers with ``units`` of the same keys (also of parameters that stayed off: what they would be).
    """

    name: str
    on: bool
    reason: str
    improvement: float
    values: dict[str, float]
    u: dict[str, float]
    units: dict[str, str]


@dataclass(frozen=True)
class WeakDirection:
    """A direction of the parameter space that the data leave open, in words.

    ``quantity``: for example "axis position across the laser plane"; ``u`` its standard uncertainty in ``unit`` ("mm", "rad" or "relative"); ``text`` says what it is and why,
    ``action`` what to do about it. ``share`` is the part that it contributes to the uncertainty of a measured point near the axis, 0 ... 1.
    """

    quantity: str
    u: float
    unit: str
    text: str
    action: str
    share: float


@dataclass(frozen=True, eq=False)
class JointCalibration:
    """The joint estimate.

    ``camera_names`` are the camera parameters that were estimated. ``parameters`` gives value, standard uncertainty and unit of every
    calibrated quantity by name. ``turn_sense`` is the one that came in. ``axis_camera`` is None in sessions without a turntable; then
    ``covariance`` has no axis. ``line_sigma_mm`` is the standard deviation of the laser line across the sheet, for which the surfaces of artefacts
    are corrected, ``stripe_blur_px`` that of the image of a line without width; 0 where the stripes do not show it.
    """

    camera: CameraModel
    camera_names: tuple[str, ...]
    laser_plane_camera: Plane | None
    laser_curvature: SheetCurvature | None
    axis_camera: Line | None
    turn_sense: int
    angle_error: AngleError
    covariance: SystemCovariance
    parameters: tuple["EstimatedQuantity", ...]
    groups: tuple[ResidualGroup, ...]
    mounts: tuple[JointMount, ...]
    table: TableErrors | None
    optional: tuple[OptionalParameters, ...]
    weak_directions: tuple[WeakDirection, ...]
    n_parameters: int
    n_observations: int
    n_iterations: int
    converged: bool
    seconds: float
    warnings: tuple[str, ...]
    line_sigma_mm: float = 0.0
    stripe_blur_px: float = 0.0
    table_motion: TableMotion | None = None


@dataclass(frozen=True)
class EstimatedQuantity:
    """A calibrated quantity with its standard uncertainty (k = 1); ``frame`` says where it holds: "image", "camera", "base", "table".

    ``value`` is NaN for directions and places, which are no single number: they stand in ``laser_plane_camera`` and ``axis_camera``.
    """

    name: str
    value: float
    u: float
    unit: str
    frame: str


@dataclass(frozen=True, eq=False)
class MountStart:
    """Where an artefact stands at the start of the joint estimate; ``table_from_part`` in the table frame of the start axis, mm."""

    name: str
    table_from_part: RigidTransform


@dataclass(frozen=True, eq=False)
class JointStart:
    """What the stages before found: where the joint estimate starts.

    ``plane_camera`` is None where no plane was found, ``axis_camera`` None where there is no turntable. The table frame is
    :func:`rotaline.geometry.transforms.base_from_axis` of ``axis_camera`` with the table at angle 0. ``camera`` also tells which views were
    used and how targets are bent or misprinted; ``axis`` which frames on the table belong (None: axis from the artefact alone).
    """

    camera: CameraCalibration
    laser_plane: LaserPlaneCalibration | None
    plane_camera: Plane | None
    axis: AxisCalibration | None
    axis_camera: Line | None
    turn_sense: int
    mounts: tuple[MountStart, ...]
