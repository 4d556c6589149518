"""The joint estimate."""

from dataclasses import dataclass

from rotaline.calibration.joint.model import JointCalibration, JointStart
from rotaline.calibration.observations import SessionObservations


@dataclass(frozen=True)
class JointOptions:
    """How everything is estimated together."""


def estimate_jointly(
    observations: SessionObservations, start: JointStart, options: JointOptions | None = None
) -> JointCalibration:
    """Camera, target poses, laser plane, axis, angle errors and mounts of least robust squares."""
    raise NotImplementedError
