"""The rig to be rendered: camera, laser, turntable and sensor, with their true values.

Frames: ``base`` is fixed, z = rotation axis, z = 0 on the table top; ``table`` turns and equals ``base`` at angle 0.
Grey values (DN) are those of an 8 bit image; an image of 16 bit holds 257 times as much.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.vision.camera import CameraModel


@dataclass(frozen=True)
class Sensor:
    """From light to grey values.

    Attributes
    ----------
    colour : red, green, blue instead of grey
    bit_depth : 8 or 16
    black_level_dn : grey value without light
    read_noise_dn : standard deviation of the noise that is there without light
    electrons_per_dn : shot noise has the variance ``signal_dn / electrons_per_dn``
    blur_px : standard deviation of the lens's blur
    """

    colour: bool = False
    bit_depth: int = 8
    black_level_dn: float = 2.0
    read_noise_dn: float = 0.6
    electrons_per_dn: float = 40.0
    blur_px: float = 0.8

    def __post_init__(self) -> None:
        """Refuse bit depths that no file has."""
        if self.bit_depth not in (8, 16):
            raise ValueError(f"bit_depth must be 8 or 16, not {self.bit_depth}.")


@dataclass(frozen=True, eq=False)
class Laser:
    """A laser line: a sheet of light with a Gaussian profile that comes from one point.

    Attributes
    ----------
    plane_base : the middle of the sheet
    position_base : (3,)   where the light comes from, mm; a point of ``plane_base``
    sigma_mm : standard deviation of the profile across the sheet
    peak_dn : grey value of a white surface that faces the laser, before the blur of the lens
    speckle_contrast : standard deviation of the speckle, as a fraction of the signal
    speckle_grain_px : size of its grains (standard deviation of the smoothing)
    rgb : share of the light that the red, green and blue pixels see (a grey camera sees all)
    """

    plane_base: Plane
    position_base: Float[np.ndarray, "3"]
    sigma_mm: float = 0.1
    peak_dn: float = 360.0
    speckle_contrast: float = 0.1
    speckle_grain_px: float = 0.7
    rgb: tuple[float, float, float] = (1.0, 0.12, 0.05)


@dataclass(frozen=True, eq=False)
class Rig:
    """Camera, laser and turntable.

    ``turn_sense`` is +1 if ``angle_deg`` of the session is right-handed about base z, else -1. ``ambient_dn`` is the grey
    value of a white surface in laser-off frames, ``ambient_laser_dn`` the same in laser-on frames.
    """

    camera: CameraModel
    camera_from_base: RigidTransform
    laser: Laser
    sensor: Sensor
    turn_sense: int = 1
    ambient_dn: float = 190.0
    ambient_laser_dn: float = 3.0
    table_radius_mm: float = 80.0

    def base_from_table(self, angle_deg: float) -> RigidTransform:
        """Where the table stands when the session's angle is ``angle_deg``."""
        return RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, self.turn_sense * np.radians(angle_deg)]))

    @property
    def laser_plane_camera(self) -> Plane:
        """True laser plane in the camera frame, camera on the negative side (offset < 0)."""
        normal = self.camera_from_base.rotation.apply(self.laser.plane_base.normal)
        offset = self.laser.plane_base.offset - float(normal @ self.camera_from_base.translation)
        plane = Plane(normal, offset)
        return plane if offset < 0 else plane.flipped()

    @property
    def rotation_axis_camera(self) -> Line:
        """True rotation axis in the camera frame, directed upwards; its point lies on the table top."""
        return Line(
            np.asarray(self.camera_from_base.translation), self.camera_from_base.rotation.apply([0.0, 0.0, 1.0])
        )


def _standing(azimuth_deg: float, elevation_deg: float, distance: float) -> Float[np.ndarray, "3"]:
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return distance * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def build_rig(
    image_size: tuple[int, int] = (640, 480),
    *,
    camera_side: int = -1,
    roll_deg: float = 0.0,
    turn_sense: int = 1,
    sensor: Sensor | None = None,
    distance: float = 290.0,
) -> Rig:
    """A rig like the article's: camera and laser 45 deg apart, both looking down on the turntable.

    Parameters
    ----------
    image_size : width, height, px
    camera_side : -1 camera to the right of the laser as the table sees them, +1 to the left
    roll_deg : rotation of the camera about its optical axis
    turn_sense : see :class:`Rig`
    sensor : grey, 8 bit if None
    distance : of the camera from the middle of the scene, mm

    Notes
    -----
    The laser plane runs 0.7 mm past the rotation axis and is tilted by half a degree, as real ones do and are. The focal
    length makes the shorter side of the image see 92 mm.
    """
    width, height = image_size
    sensor = Sensor() if sensor is None else sensor
    focal = min(width, height) / 92.0 * distance
    camera = CameraModel(
        image_size, focal * 1.0004, focal, width / 2 + 2.3, height / 2 - 3.1, k1=-0.09, k2=0.07, p1=0.0005, p2=-0.0004
    )

    middle = np.array([0.0, 0.0, 18.0])
    position = middle + _standing(camera_side * 23.0, 40.0, distance)
    forward = unit(middle - position)
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    level = np.stack([right, np.cross(forward, right), forward])
    rotation = Rotation.from_rotvec([0.0, 0.0, np.radians(roll_deg)]) * Rotation.from_matrix(level)
    camera_from_base = RigidTransform.from_components(-rotation.apply(position), rotation)

    azimuth = np.radians(-camera_side * 22.0)
    tilt = np.radians(0.5)
    normal = np.array([-np.sin(azimuth) * np.cos(tilt), np.cos(azimuth) * np.cos(tilt), np.sin(tilt)])
    plane = Plane(normal, 0.7)
    start = middle + _standing(-camera_side * 22.0, 50.0, 240.0)
    start = start - plane.signed_distance_to(start[None])[0] * normal
    # a wide stripe is biased on curved surfaces, one narrower than this would alias: the blur comes after the pixels
    laser = Laser(plane, start, sigma_mm=0.6 * distance / focal)
    return Rig(camera, camera_from_base, laser, sensor, turn_sense)
