"""The rig to be rendered: camera, lens, sensor, laser, light, turntable, with their true values.

Frames: ``base`` is fixed, z = rotation axis, z = 0 on the table top; ``table`` turns and equals ``base`` at angle 0.
Light is counted in photo-electrons of a pixel; grey values (DN) are those of an 8 bit image, whatever the bit depth.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.vision.camera import CameraModel

BIT_DEPTHS = (8, 12, 16)


def _require(condition: bool, text: str) -> None:
    if not condition:
        raise ValueError(text)


@dataclass(frozen=True)
class Optics:
    """What the lens does beyond the pinhole camera and its distortion.

    Attributes
    ----------
    pixel_pitch_um : side of a pixel on the sensor
    f_number : focal length over aperture; fixes defocus and the grain of speckle
    focus_mm : depth (z of the camera frame) that is in focus; None: everything is
    blur_px : standard deviation of the image of a point that is in focus
    """

    pixel_pitch_um: float = 3.75
    f_number: float = 5.6
    focus_mm: float | None = None
    blur_px: float = 0.8

    def __post_init__(self) -> None:
        """Refuse what no lens has."""
        _require(self.pixel_pitch_um > 0, f"pixel_pitch_um must be above 0, not {self.pixel_pitch_um}.")
        _require(self.f_number > 0, f"f_number must be above 0, not {self.f_number}.")
        _require(self.focus_mm is None or self.focus_mm > 0, f"focus_mm must be above 0, not {self.focus_mm}.")
        _require(self.blur_px >= 0, f"blur_px must not be negative, it is {self.blur_px}.")

    def blur_px_at(self, depth_mm: Float[np.ndarray, "*n"], focal_px: float) -> Float[np.ndarray, "*n"]:
        """Standard deviation of the image of a point at this depth, px.

        A thin lens of focal length ``f`` and aperture ``f / N`` images a point at depth z as a disc of the diameter
        ``f^2 / (N (s - f)) |z - s| / z`` if it is focused at s; a disc of diameter c has the standard deviation c / 4.
        """
        depth = np.asarray(depth_mm, dtype=float)
        if self.focus_mm is None:
            return np.full(depth.shape, self.blur_px)
        focal_mm = focal_px * self.pixel_pitch_um * 1e-3
        disc_mm = focal_mm**2 / (self.f_number * (self.focus_mm - focal_mm)) * np.abs(depth - self.focus_mm) / depth
        return np.hypot(self.blur_px, disc_mm / (self.pixel_pitch_um * 1e-3) / 4.0)


@dataclass(frozen=True)
class Sensor:
    """From photo-electrons to grey values.

    Attributes
    ----------
    colour : red, green and blue pixels in a Bayer pattern, interpolated to a colour image, instead of grey
    bit_depth : 8, 12 or 16; 12 and 16 bit are written in 16 bit files, full scale 65535
    full_well_e : electrons at full scale with gain 1
    gain : full scale is reached at ``full_well_e / gain``
    read_noise_e : standard deviation of the noise that is there without light
    black_level_dn : grey value without light
    """

    colour: bool = False
    bit_depth: int = 8
    full_well_e: float = 10200.0
    gain: float = 1.0
    read_noise_e: float = 24.0
    black_level_dn: float = 2.0

    def __post_init__(self) -> None:
        """Refuse what no sensor has."""
        _require(self.bit_depth in BIT_DEPTHS, f"bit_depth must be 8, 12 or 16, not {self.bit_depth}.")
        _require(self.full_well_e > 0, f"full_well_e must be above 0, not {self.full_well_e}.")
        _require(self.gain > 0, f"gain must be above 0, not {self.gain}.")
        _require(self.read_noise_e >= 0, f"read_noise_e must not be negative, it is {self.read_noise_e}.")
        _require(0 <= self.black_level_dn < 128, f"black_level_dn must be 0 to 128, not {self.black_level_dn}.")

    @property
    def electrons_per_dn(self) -> float:
        """Electrons that make one grey value of an 8 bit image."""
        return self.full_well_e / self.gain / 255.0


@dataclass(frozen=True, eq=False)
class Laser:
    """A laser line: a sheet of light with a Gaussian profile that comes from one point.

    Attributes
    ----------
    plane_base : the middle of the sheet; of a bowed sheet, its tangent along the beam
    position_base : (3,)   where the light comes from, mm; a point of ``plane_base``
    beam_base : (3,)   unit direction of the middle of the fan, in the plane
    sigma_mm : standard deviation of the profile across the sheet at its waist (a quarter of the 1/e^2 width)
    waist_mm : distance of the waist from ``position_base``
    divergence_mrad : the sheet's standard deviation grows to ``hypot(sigma_mm, divergence * |distance - waist|)``
    fan_deg : full opening angle of the fan; there is no light beyond
    bow_mm : the sheet's sag off the plane at both ends of the fan, at the distance of the waist; it grows with the square of
        the angle from the beam and in proportion to the distance
    peak_e_per_ms : electrons a millisecond from a white surface that faces the laser at the waist, in the stripe's middle, before
        the blur of the lens
    wavelength_nm, linewidth_nm : of the light; they fix the speckle
    speckle_contrast : standard deviation of the speckle over its mean; None: from wavelength, aperture and roughness
    rgb : share of the light that red, green and blue pixels see (a grey camera sees all)
    """

    plane_base: Plane
    position_base: Float[np.ndarray, "3"]
    beam_base: Float[np.ndarray, "3"]
    sigma_mm: float = 0.1
    waist_mm: float = 240.0
    divergence_mrad: float = 0.0
    fan_deg: float = 60.0
    bow_mm: float = 0.0
    peak_e_per_ms: float = 1440.0
    wavelength_nm: float = 650.0
    linewidth_nm: float = 1.0
    speckle_contrast: float | None = None
    rgb: tuple[float, float, float] = (1.0, 0.12, 0.05)

    def __post_init__(self) -> None:
        """Refuse what no laser has."""
        for name in ("sigma_mm", "waist_mm", "peak_e_per_ms", "wavelength_nm"):
            _require(getattr(self, name) > 0, f"{name} must be above 0, not {getattr(self, name)}.")
        for name in ("divergence_mrad", "linewidth_nm"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, it is {getattr(self, name)}.")
        _require(0 < self.fan_deg < 180, f"fan_deg must be between 0 and 180, not {self.fan_deg}.")
        contrast = self.speckle_contrast
        _require(contrast is None or 0 <= contrast <= 1, f"speckle_contrast must be 0 to 1, not {contrast}.")


@dataclass(frozen=True)
class Light:
    """The light of the room and the exposures.

    Attributes
    ----------
    ambient_e_per_ms : electrons a millisecond from a white surface that faces the camera, in laser-off frames
    ambient_on_fraction : how much of it is left in laser-on frames (lamps off, or a filter before the lens)
    exposure_off_ms, exposure_on_ms : of laser-off and laser-on frames
    """

    ambient_e_per_ms: float = 760.0
    ambient_on_fraction: float = 0.016
    exposure_off_ms: float = 10.0
    exposure_on_ms: float = 10.0

    def __post_init__(self) -> None:
        """Refuse negative light."""
        for name in ("ambient_e_per_ms", "ambient_on_fraction"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, it is {getattr(self, name)}.")
        for name in ("exposure_off_ms", "exposure_on_ms"):
            _require(getattr(self, name) > 0, f"{name} must be above 0, not {getattr(self, name)}.")


@dataclass(frozen=True)
class Mechanics:
    """Errors of the turntable; all zero: an ideal one.

    A rotating part cannot tell a displacement that turns with the table from its own place on it. So the once-per-turn terms
    here have a direction that is fixed in the base frame.

    Attributes
    ----------
    angle_noise_deg : standard deviation of the read-out; true angle = read angle + error
    angle_eccentricity_deg, angle_eccentricity_phase_deg : once-per-turn error ``amplitude * sin(read angle + phase)``
    run_out_um, run_out_phase_deg : the axis moves along base x by ``amplitude * cos(angle + phase)``
    run_out_noise_um : standard deviation of a further movement in x and y, another one in each frame
    wobble_urad, wobble_phase_deg : the axis tilts about base y by ``amplitude * cos(angle + phase)``, about the point on the table top
    """

    angle_noise_deg: float = 0.0
    angle_eccentricity_deg: float = 0.0
    angle_eccentricity_phase_deg: float = 0.0
    run_out_um: float = 0.0
    run_out_phase_deg: float = 0.0
    run_out_noise_um: float = 0.0
    wobble_urad: float = 0.0
    wobble_phase_deg: float = 0.0

    def __post_init__(self) -> None:
        """Refuse negative standard deviations."""
        for name in ("angle_noise_deg", "run_out_noise_um"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, it is {getattr(self, name)}.")


@dataclass(frozen=True, eq=False)
class Rig:
    """Camera, laser and turntable.

    ``turn_sense`` is +1 if ``angle_deg`` of the session is right-handed about base z, else -1.
    """

    camera: CameraModel
    camera_from_base: RigidTransform
    laser: Laser
    sensor: Sensor = field(default_factory=Sensor)
    optics: Optics = field(default_factory=Optics)
    light: Light = field(default_factory=Light)
    mechanics: Mechanics = field(default_factory=Mechanics)
    turn_sense: int = 1
    table_radius_mm: float = 80.0

    def base_from_table(self, angle_deg: float) -> RigidTransform:
        """Where an ideal table stands when the session's angle is ``angle_deg``; without the errors of ``mechanics``."""
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
    beam = unit(middle - plane.signed_distance_to(middle[None])[0] * normal - start)
    # a wide stripe is biased on curved surfaces, a narrow one is sampled by too few pixels
    laser = Laser(plane, start, beam, sigma_mm=0.6 * distance / focal, speckle_contrast=0.1)
    return Rig(camera, camera_from_base, laser, sensor, turn_sense=turn_sense)
