"""The plan of an acquisition, checked: which captures, of what, at which angles or poses, how exposed. Frozen data."""

from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from rotaline.io.rig_tables import TurnKeys
from rotaline.tables import NotNegative, Number, Positive, Table, key

Exposure = Positive | Literal["auto"]


class PlanOptics(Table):
    """What is known of lens, sensor and laser; goes into session.toml, where it says how far speckle limits the stripe."""

    f_number: Positive = key(..., "focal length over aperture")
    pixel_pitch_um: Positive = key(..., "side of a pixel on the sensor")
    wavelength_nm: Positive = key(..., "of the laser")
    speckle_contrast: Annotated[float, Field(ge=0, le=1)] = key(1.0, "standard deviation of the speckle over its mean")


class PlanCapture(TurnKeys):
    """A folder of frames that is to be recorded."""

    target: str | None = key(None, "a name under [targets]; for a scan any word, or absent")
    poses: Annotated[int, Field(ge=1, le=1000)] | None = key(
        None, "how many poses a person places; roles camera (20) and laser-plane (10)"
    )
    mode: Literal["step", "continuous"] = key(
        "step",
        "step: the table stands for each frame; continuous: it turns while the camera streams. Only what kills the whole computer leaves it turning: "
        "state limits_deg of the table in rig.toml, and it ends there",
    )
    speed_deg_s: Positive | None = key(
        None,
        "speed in mode continuous; absent: as fast as there is a frame for each angle, with no more than a tenth of a step in an exposure",
    )
    laser_off_frames: bool = key(
        False, "a laser-off frame at each angle as well, as background; artifact and scan, mode step"
    )
    exposure_on_us: Exposure = key("auto", 'of laser-on frames, us; "auto": the stripe is bright and not saturated')
    exposure_off_us: Exposure = key("auto", 'of laser-off frames, us; "auto": white is bright and not saturated')
    bracket: Annotated[tuple[Positive, ...], Strict(False), Field(min_length=1, max_length=8)] = key(
        (1.0,), "factors of exposure_on_us: one laser-on frame each, e.g. [0.3, 1.0, 3.0] for glossy or dark parts"
    )
    gain: Number | None = key(None, "in the camera's unit; in all captures or in none: then it stays as it is")
    laser_power: Annotated[float, Field(gt=0, le=1)] | None = key(
        None,
        "share of full power, where it can be set; in all captures with the laser or in none: then it stays as it is",
    )
    settle_s: NotNegative = key(0.2, "rest after each move of the table, before the exposure")
    reference_every: Annotated[int, Field(ge=0)] = key(
        0, "a reference frame at from_deg every so many angles, to see drift; 0: none; mode step"
    )
    text: str | None = key(None, "what the person is told before this capture")


class PlanTables(Table):
    """A plan as a whole."""

    version: Literal[1] = key(1, "of this format")
    home: bool = key(True, "find the table's angle 0 before the first capture that turns; false: keep its angles")
    warm_up_s: NotNegative = key(0.0, "the laser is on for so long before the first frame with it")
    optics: PlanOptics | None = key(None, "lens, sensor and laser")
    targets: dict[str, dict[str, Any]] = key({}, "targets and artefacts, by name; as in session.toml")
    captures: Annotated[tuple[PlanCapture, ...], Strict(False), Field(min_length=1)] = key(
        ..., "folders of frames, in this order"
    )
    measurements: Annotated[tuple[dict[str, Any], ...], Strict(False)] = key((), "what to measure; as in session.toml")
