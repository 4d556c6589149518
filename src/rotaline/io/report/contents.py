"""What a report is made from: plain values, so that it can be written again from stored results."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from rotaline.calibration.joint.model import JointCalibration
from rotaline.calibration.model import (
    ArtifactCalibration,
    AxisCalibration,
    CameraCalibration,
    CrossRatioResult,
    LaserPlaneCalibration,
    SystemCalibration,
)
from rotaline.calibration.speckle_limit import SpeckleLimit
from rotaline.calibration.verdict.model import Verdict
from rotaline.geometry.primitives import SteppedCylinder
from rotaline.io.drift_file import CaptureDrift
from rotaline.io.results import MeasurementEntry
from rotaline.scanning.cloud import PointCloud

STAGES = {
    "session": "Session",
    "camera": "Camera",
    "stripe": "Stripe",
    "laser-plane": "Laser plane",
    "cross-ratio": "Cross-ratio optimisation",
    "axis": "Initial axis",
    "artifact": "Axis optimisation",
    "joint": "Joint estimate",
    "scan": "Scan",
    "drift": "Drift",
    "measure": "Measurement",
    "surface": "Surface",
    "report": "Report",
}
"""Names of the stages in warnings and overlays, with their titles."""

STEP_TITLES = {
    "session": "Session",
    "camera": "Camera",
    "laser-plane": "Laser plane",
    "axis": "Rotation axis",
    "artifact": "Artefact",
    "table": "Turntable",
    "scan": "Scan",
    "measure": "Measurement",
}
"""Titles of the steps that a verdict judges."""


@dataclass(frozen=True)
class RunInfo:
    """Who measured what, when, with which versions and options, and how long each stage took."""

    session: str
    finished_at: str
    versions: dict[str, str]
    machine: str
    options: dict[str, str]
    stage_seconds: dict[str, float]


@dataclass(frozen=True)
class CaptureSummary:
    """One capture of the session."""

    folder: str
    role: str
    target: str
    n_frames: int
    n_laser_on: int
    image_size: tuple[int, int]


@dataclass(frozen=True)
class StageWarning:
    """Something that makes a result doubtful: the stage that spoiled it, what was found and what to do.

    ``serious``: the result should not be trusted.
    """

    stage: str
    text: str
    serious: bool = False


@dataclass(frozen=True, eq=False)
class FrameOverlay:
    """A frame of ``stage`` with the points that were found in it.

    ``image`` may be reduced: its width is ``scale`` times the full width (``scale`` <= 1). ``uv`` are px of the full image.
    """

    stage: str
    name: str
    caption: str
    image: UInt8[np.ndarray, "h w 3"]
    scale: float
    uv: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class CloudSummary:
    """A scan; ``cloud`` is thinned for drawing, the counts are of the full one. ``folder``: capture."""

    folder: str
    cloud: PointCloud
    n_points: int
    n_frames: int
    n_frames_without_stripe: int


@dataclass(frozen=True, eq=False)
class SurfaceSummary:
    """A reconstructed surface, in the table frame; ``failure`` says why there is none."""

    folder: str
    vertices_table: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    failure: str = ""


@dataclass(frozen=True, eq=False)
class FittedPoints:
    """Points of a measured feature with their residuals (perhaps thinned), for the picture of the fit.

    ``capture``, ``feature`` and ``name`` are those of the :class:`~rotaline.io.results.MeasurementEntry`.
    """

    capture: str
    feature: str
    name: str
    points_table: Float[np.ndarray, "n 3"]
    residuals_mm: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class ReportContents:
    """Everything that the report shows; stages that were not done are None or empty.

    ``artifacts`` holds the calibrated sizes of the stepped cylinder by the folder of its capture. ``joint`` and ``verdict`` are None
    for the article's way of calibrating, ``speckle_limit`` where the session does not state its optics. ``drift`` is empty without
    reference frames.
    """

    run: RunInfo
    captures: tuple[CaptureSummary, ...]
    targets: dict[str, str]
    warnings: tuple[StageWarning, ...]
    camera: CameraCalibration | None
    laser_plane: LaserPlaneCalibration | None
    cross_ratio: CrossRatioResult | None
    axis: AxisCalibration | None
    artifact: ArtifactCalibration | None
    calibration: SystemCalibration | None
    clouds: tuple[CloudSummary, ...]
    surfaces: tuple[SurfaceSummary, ...]
    measurements: tuple[MeasurementEntry, ...]
    measurements_initial_axis: tuple[MeasurementEntry, ...]
    overlays: tuple[FrameOverlay, ...]
    fitted_points: tuple[FittedPoints, ...] = ()
    artifacts: dict[str, SteppedCylinder] = field(default_factory=dict)
    joint: JointCalibration | None = None
    verdict: Verdict | None = None
    speckle_limit: SpeckleLimit | None = None
    drift: tuple[CaptureDrift, ...] = ()

    @property
    def estimated_jointly(self) -> bool:
        """The calibration was to end with the joint estimate, not in the article's way."""
        return self.joint is not None or self.run.options.get("calibration.method") == "joint"
