"""The errors of the rig that the budget varies, each alone, and the rig that has none of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from scipy.spatial.transform import Rotation

from rotaline.geometry.primitives import Plane
from rotaline.io.rig_file import RigFile
from rotaline.io.rig_values import plate_of
from rotaline.pipeline.reproduce.article import STEPPED_CYLINDER
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.shapes import SteppedRod
from rotaline.simulation.rig import Mechanics, Rig

BASE_NOISE_PX = 0.01
BASE_LINE_WIDTH_MM = 0.1


@dataclass(frozen=True, eq=False)
class Conditions:
    """A rig with its plates and its stepped cylinder, as they really are.

    ``tilt_deg``: how far the stepped cylinder leans on the table; ``noise_px``: of the stripe's centres, where no images are made;
    ``laser_turn_mrad``: how far the laser has turned since the sensor was calibrated.
    """

    rig: Rig
    plates: dict[str, Plate]
    stepped: SteppedRod
    tilt_deg: float
    noise_px: float
    laser_turn_mrad: float = 0.0

    def rig_when_scanning(self) -> Rig:
        """The rig after its sensor was calibrated: the laser has turned about the vertical through itself."""
        laser = self.rig.laser
        turn = Rotation.from_rotvec([0.0, 0.0, 1e-3 * self.laser_turn_mrad])
        normal = turn.apply(laser.plane_base.normal)
        plane = Plane(normal, -float(normal @ laser.position_base))
        return replace(self.rig, laser=replace(laser, plane_base=plane, beam_base=turn.apply(laser.beam_base)))


@dataclass(frozen=True)
class Source:
    """One error: ``levels`` of it from small to large, the first of them without; ``apply`` puts a level of it on a rig."""

    key: str
    title: str
    unit: str
    from_images: bool
    levels: tuple[float, ...]
    apply: Callable[[Conditions, float], Conditions]


def ideal_conditions(rig_file: RigFile) -> Conditions:
    """The rig of the file without any error: perfect mechanics and plates, all in focus, a narrow line, no speckle, no read-out noise."""
    rig = rig_file.rig()
    names = ("checkerboard", "dots")
    perfect = {
        name: replace(plate_of(rig_file.tables.targets[name]), pitch_error=0.0, print_offset_um=0.0, flatness_um=0.0)
        for name in names
    }
    return Conditions(
        rig=replace(
            rig,
            mechanics=Mechanics(),
            optics=replace(rig.optics, focus_mm=None),
            sensor=replace(rig.sensor, read_noise_e=0.0),
            laser=replace(rig.laser, bow_mm=0.0, speckle_contrast=0.0, sigma_mm=BASE_LINE_WIDTH_MM / 4),
        ),
        plates=perfect,
        stepped=SteppedRod(STEPPED_CYLINDER),
        tilt_deg=0.0,
        noise_px=BASE_NOISE_PX,
    )


def _mechanics(name: str) -> Callable[[Conditions, float], Conditions]:
    return lambda c, level: replace(c, rig=replace(c.rig, mechanics=replace(c.rig.mechanics, **{name: level})))


def _laser(**fields: Callable[[float], Any]) -> Callable[[Conditions, float], Conditions]:
    def apply(c: Conditions, level: float) -> Conditions:
        return replace(c, rig=replace(c.rig, laser=replace(c.rig.laser, **{k: f(level) for k, f in fields.items()})))

    return apply


def _plates(name: str, factor: float) -> Callable[[Conditions, float], Conditions]:
    def apply(c: Conditions, level: float) -> Conditions:
        error: dict[str, Any] = {name: factor * level}
        return replace(c, plates={key: replace(plate, **error) for key, plate in c.plates.items()})

    return apply


def _read_noise(c: Conditions, level: float) -> Conditions:
    return replace(c, rig=replace(c.rig, sensor=replace(c.rig.sensor, read_noise_e=level)))


def _defocus(c: Conditions, level: float) -> Conditions:
    """Focused behind the middle of the table by so much."""
    focus_mm = float(c.rig.camera_from_base.translation[2]) + level if level else None
    return replace(c, rig=replace(c.rig, optics=replace(c.rig.optics, focus_mm=focus_mm)))


SOURCES = (
    Source("angle-noise", "angle read-out, noise", "deg", False, (0.0, 0.03, 0.1, 0.3), _mechanics("angle_noise_deg")),
    Source(
        "angle-eccentricity",
        "angle read-out, once per turn",
        "deg",
        False,
        (0.0, 0.03, 0.1, 0.3),
        _mechanics("angle_eccentricity_deg"),
    ),
    Source(
        "run-out",
        "run-out of the spindle, once per turn",
        "um",
        False,
        (0.0, 10.0, 30.0, 100.0),
        _mechanics("run_out_um"),
    ),
    Source(
        "run-out-noise",
        "run-out of the spindle, random",
        "um",
        False,
        (0.0, 2.0, 6.0, 20.0),
        _mechanics("run_out_noise_um"),
    ),
    Source("wobble", "wobble of the spindle", "urad", False, (0.0, 100.0, 500.0, 2500.0), _mechanics("wobble_urad")),
    Source(
        "tilt",
        "stepped cylinder does not stand flat",
        "deg",
        False,
        (0.0, 0.05, 0.15, 0.5),
        lambda c, level: replace(c, tilt_deg=level),
    ),
    Source(
        "centre-noise",
        "noise of stripe centres",
        "px",
        False,
        (BASE_NOISE_PX, 0.05, 0.15, 0.5),
        lambda c, level: replace(c, noise_px=level),
    ),
    Source(
        "laser-turn",
        "laser turned since its calibration",
        "mrad",
        False,
        (0.0, 0.1, 0.4, 1.6),
        lambda c, level: replace(c, laser_turn_mrad=level),
    ),
    Source("bow", "bow of the laser sheet", "mm", False, (0.0, 0.02, 0.1, 0.5), _laser(bow_mm=float)),
    Source("pitch", "pitch of both targets", "ppm", False, (0.0, 100.0, 400.0, 1600.0), _plates("pitch_error", 1e-6)),
    Source("flatness", "bow of both targets", "um", False, (0.0, 10.0, 40.0, 160.0), _plates("flatness_um", 1.0)),
    Source(
        "print",
        "print of both targets, each point",
        "um",
        False,
        (0.0, 2.0, 8.0, 32.0),
        _plates("print_offset_um", 1.0),
    ),
    Source("speckle", "contrast of the speckle", "", True, (0.0, 0.05, 0.15, 0.5), _laser(speckle_contrast=float)),
    Source("pixel-noise", "read-out noise of the pixels", "e", True, (0.0, 40.0, 120.0, 360.0), _read_noise),
    Source(
        "line-width",
        "width of the laser line",
        "mm",
        True,
        (BASE_LINE_WIDTH_MM, 0.2, 0.4, 0.8),
        _laser(sigma_mm=lambda width_mm: width_mm / 4),
    ),
    Source("defocus", "focus behind the middle of the table", "mm", True, (0.0, 20.0, 60.0, 180.0), _defocus),
    Source(
        "chamfer",
        "chamfer of the stepped cylinder's edges",
        "mm",
        True,
        (0.0, 0.05, 0.2, 0.8),
        lambda c, level: replace(c, stepped=replace(c.stepped, chamfer=level)),
    ),
)
