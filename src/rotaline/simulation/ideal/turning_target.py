"""A target on the turntable, as ideal detectors would see it."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.circles import TurntableRig
from rotaline.simulation.ideal.observations import observe_target
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Target, TargetDetection


def standing_board(target: Target, azimuth_deg: float = 0.0, distance_mm: float = 10.0) -> RigidTransform:
    """``base_from_board`` of a target that stands upright on the table.

    Parameters
    ----------
    target : Target
    azimuth_deg : float   where its front faces, about the rotation axis; 0 is towards the camera
    distance_mm : float   from the rotation axis to the target's plane
    """
    columns, rows = target.grid_size
    facing = Rotation.from_euler("z", azimuth_deg, degrees=True)
    upright = Rotation.from_matrix(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    corner = np.array([distance_mm, -(columns - 1) * target.pitch / 2, rows * target.pitch])
    return RigidTransform.from_components(facing.apply(corner), facing * upright)


def observe_turning_target(
    camera: CameraModel,
    rig: TurntableRig,
    target: Target,
    base_from_board: RigidTransform,
    angles_rad: Float[np.ndarray, " f"],
    sigma_px: float,
    rng: np.random.Generator,
) -> list[TargetDetection]:
    """Detections at each angle of the table, with Gaussian noise of ``sigma_px`` a coordinate."""
    detections = []
    for angle in angles_rad:
        turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, rig.turn_sense * angle]))
        camera_from_board = rig.base_from_camera.inv() * turn * base_from_board
        detections.append(observe_target(camera, camera_from_board, target, sigma_px, rng))
    return detections
