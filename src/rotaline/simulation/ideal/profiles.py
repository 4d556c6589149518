"""The stripe on an ideal stepped cylinder: where the laser plane cuts its surfaces and the table.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, figures 5 and 13
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.ideal.circles import TurntableRig
from rotaline.vision.camera import CameraModel


@dataclass(frozen=True, eq=False)
class IdealStripe:
    """Points of a stripe: pixels, unit normal in the image, and the piece (0 top ... 4 table) of each."""

    uv: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    piece: Int[np.ndarray, " n"]


def ideal_stepped_stripe(
    artifact: SteppedCylinder,
    rig: TurntableRig,
    base_from_part: RigidTransform,
    angle_rad: float,
    camera: CameraModel,
    table_mm: float = 40.0,
) -> IdealStripe:
    """The stripe on top, small side, step, large side and table, on the side towards the camera, a point a pixel.

    Parameters
    ----------
    artifact, rig, base_from_part, angle_rad : as in :func:`rotaline.simulation.ideal.circles.ideal_feature_points`
    camera : CameraModel
    table_mm : float   length of the stripe on the table

    Raises
    ------
    ValueError
        If the laser plane misses the small cylinder.
    """
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, rig.turn_sense * angle_rad]))
    camera_from_part = rig.base_from_camera.inv() * turn * base_from_part
    part_from_camera = camera_from_part.inv()
    plane = rig.laser_plane_camera
    normal = part_from_camera.rotation.apply(plane.normal)
    offset = plane.offset + float(plane.normal @ camera_from_part.translation)
    eye = part_from_camera.translation
    level = float(np.hypot(normal[0], normal[1]))
    across = normal[:2] / level
    along = np.array([-across[1], across[0]])
    along = along * np.sign(along @ eye[:2])

    def side(z: Float[np.ndarray, " k"], radius: float, sign: float = 1.0) -> Float[np.ndarray, "k 3"]:
        distance = -(offset + normal[2] * z) / level
        if np.any(np.abs(distance) >= radius):
            raise ValueError(
                f"The laser plane passes {np.abs(distance).max():.1f} mm from the axis, outside radius {radius:.1f} mm."
            )
        reach = sign * np.sqrt(radius**2 - distance**2)
        return np.column_stack([distance[:, None] * across + reach[:, None] * along, z])

    r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
    step, top = artifact.height_large, artifact.height_small + artifact.height_large
    t = np.linspace(0.0, 1.0, 2000)

    def straight(start: Float[np.ndarray, "1 3"], end: Float[np.ndarray, "1 3"]) -> Float[np.ndarray, "k 3"]:
        return start + t[:, None] * (end - start)

    at = {name: np.array([z]) for name, z in (("top", top), ("step", step), ("bottom", 0.0))}
    foot = side(at["bottom"], r2)
    lines = (
        straight(side(at["top"], r1, -1.0), side(at["top"], r1)),
        side(top + t * (step - top), r1),
        straight(side(at["step"], r1), side(at["step"], r2)),
        side(step * (1.0 - t), r2),
        straight(foot, foot + table_mm * np.append(along, 0.0)),
    )
    uvs, normals, pieces = [], [], []
    for k, line in enumerate(lines):
        uv = camera.project(camera_from_part.apply(line))
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
        places = np.arange(0.5, length[-1], 1.0)
        uv = np.column_stack([np.interp(places, length, uv[:, axis]) for axis in (0, 1)])
        tangent = np.gradient(uv, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1)[:, None]
        uvs.append(uv)
        normals.append(np.column_stack([-tangent[:, 1], tangent[:, 0]]))
        pieces.append(np.full(len(uv), k))
    return IdealStripe(np.concatenate(uvs), np.concatenate(normals), np.concatenate(pieces))
