"""Directions that the data leave open, in words."""

from rotaline.calibration.joint.model import JointCalibration, WeakDirection


def weak_directions(found: JointCalibration) -> tuple[WeakDirection, ...]:
    """Directions."""
    return ()
