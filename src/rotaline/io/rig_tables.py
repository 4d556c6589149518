"""The tables of a rig file, checked: what stands where, with which errors, and what is to be recorded.

Positions are in the nominal table frame: z up, z = 0 on the table top, the middle of the table at (0, 0). Each field is a
key of the file; its description ends up in the message about a wrong value and in the documentation.
"""

from typing import Annotated, Literal

from pydantic import Field, Strict

from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.tables import Fraction, NotNegative, Number, Positive, Table, key

Count = Annotated[int, Field(ge=2)]
Pixels = Annotated[int, Field(ge=16, le=20_000)]
# lists are all that TOML has; tuples are what values hold
Vector = Annotated[tuple[Number, Number, Number], Strict(False)]
Pair = Annotated[tuple[Number, Number], Strict(False)]
Size = Annotated[tuple[Pixels, Pixels], Strict(False)]
Counts = Annotated[tuple[Count, Count], Strict(False)]
Lengths = Annotated[tuple[Positive, Positive], Strict(False)]
Shares = Annotated[tuple[Fraction, Fraction, Fraction], Strict(False)]


class CameraTable(Table):
    """Where the camera is, its lens and its distortion."""

    position_mm: Vector = key(..., "projection centre: x, y, z")
    look_at_mm: Vector = key((0.0, 0.0, 24.0), "a point on the optical axis")
    roll_deg: Number = key(0.0, "turn of the camera about its optical axis; 0: upright, 90: on its side")
    image_size: Size = key((1280, 960), "width, height, pixels")
    focal_length_mm: Positive = key(9.0, "focal length of the lens, focused as it is")
    pixel_pitch_um: Positive = key(3.75, "side of a pixel on the sensor")
    pixel_aspect: Positive = key(1.0, "fx / fy")
    principal_point_offset_px: Pair = key((0.0, 0.0), "principal point less the middle of the image: right, down")
    k1: Number = key(0.0, "radial distortion, normalised coordinates (see conventions)")
    k2: Number = key(0.0, "radial distortion, fourth power")
    k3: Number = key(0.0, "radial distortion, sixth power")
    p1: Number = key(0.0, "tangential distortion")
    p2: Number = key(0.0, "tangential distortion")
    f_number: Positive = key(5.6, "focal length over aperture: depth of field and grain of the speckle")
    focus_distance_mm: Positive | Literal["everywhere"] | None = key(
        None, 'what is sharp, along the optical axis; absent: look_at_mm; "everywhere": no defocus'
    )
    blur_px: NotNegative = key(0.8, "standard deviation of the image of a point that is in focus")


class SensorTable(Table):
    """From light to grey values."""

    colour: bool = key(False, "a Bayer pattern and colour images instead of grey")
    bit_depth: Literal[8, 12, 16] = key(8, "8, 12 or 16; 12 and 16 bit need png or tiff")
    full_well_e: Positive = key(10200.0, "electrons at full scale with gain 1")
    gain: Positive = key(1.0, "full scale is reached at full_well_e / gain")
    read_noise_e: NotNegative = key(24.0, "standard deviation of the noise without light, electrons")
    black_level_dn: Annotated[float, Field(ge=0, lt=128)] = key(2.0, "grey value without light, of 255")


class LaserTable(Table):
    """The line laser: where it is, where it points, how wide and bright the line is."""

    position_mm: Vector = key(..., "where the light comes from: x, y, z")
    aim_at_mm: Vector = key((0.0, 0.0, 24.0), "a point that the middle of the fan hits")
    sheet_roll_deg: Number = key(
        0.0, "turn of the sheet about its beam; 0: the sheet holds the direction of the rotation axis"
    )
    line_width_mm: Positive = key(0.3, "full width of the line at its narrowest place, to 1/e^2 of its middle")
    waist_distance_mm: Positive | None = key(
        None, "distance of the narrowest place from the laser; absent: that of aim_at_mm"
    )
    divergence_mrad: NotNegative | None = key(
        None, "full angle at which the 1/e^2 width grows, far from its narrowest place; absent: by diffraction"
    )
    fan_deg: Annotated[float, Field(gt=0, lt=180)] = key(60.0, "full opening angle of the fan; no light beyond")
    bow_mm: Number = key(0.0, "sag of the sheet off a plane at both ends of the fan, at the narrowest place")
    peak_e_per_ms: Positive | None = key(
        None,
        "electrons per ms from white that faces the laser, in the line's middle; absent: 0.6 of full scale in the image",
    )
    wavelength_nm: Annotated[float, Field(ge=350, le=1100)] = key(650.0, "of the light: speckle, diffraction, colour")
    spectral_width_nm: NotNegative = key(1.0, "of the light; a wide one has less speckle")
    speckle_contrast: Fraction | None = key(
        None, "standard deviation of the speckle over its mean; absent: from wavelength, aperture and roughness"
    )
    rgb: Shares | None = key(
        None, "share of the light that red, green and blue pixels see; absent: from the wavelength"
    )


class LightTable(Table):
    """The light of the room, and the exposures."""

    ambient_e_per_ms: NotNegative | None = key(
        None, "electrons per ms from white that faces the camera, laser off; absent: 0.75 of full scale"
    )
    ambient_on_fraction: NotNegative = key(0.016, "how much of it is left in laser-on frames")
    exposure_off_ms: Positive = key(10.0, "exposure of laser-off frames")
    exposure_on_ms: Positive = key(10.0, "exposure of laser-on frames")


class TurntableTable(Table):
    """The turntable and its errors; all errors zero: an ideal one."""

    radius_mm: Positive = key(80.0, "of the table top")
    turn_sense: Literal[-1, 1] = key(
        1, "1: its angles count right-handed about z (anticlockwise from above), -1: the other way"
    )
    axis_offset_mm: Pair = key((0.0, 0.0), "where the rotation axis passes through the table top: x, y")
    axis_tilt_deg: Pair = key((0.0, 0.0), "lean of the axis, and the table top with it, towards x and towards y")
    angle_noise_deg: NotNegative = key(0.0, "standard deviation of the read-out of the angle")
    angle_eccentricity_deg: Number = key(0.0, "once-per-turn error of the read-out, amplitude")
    angle_eccentricity_phase_deg: Number = key(0.0, "its phase")
    run_out_um: Number = key(0.0, "once-per-turn movement of the axis along x, amplitude")
    run_out_phase_deg: Number = key(0.0, "its phase")
    run_out_noise_um: NotNegative = key(
        0.0, "further movement along x and y, another one in each frame, standard deviation"
    )
    wobble_urad: Number = key(0.0, "once-per-turn tilt of the axis about y, amplitude")
    wobble_phase_deg: Number = key(0.0, "its phase")


class SessionTable(Table):
    """What is written."""

    image_format: Literal["png", "jpg", "bmp", "tiff"] = key("png", "of all images; jpg holds 8 bit only")
    seed: Annotated[int, Field(ge=0)] = key(1, "of noise and of drawn poses; --seed overrides it")


class _PlateTable(Table):
    pitch_mm: Positive = key(..., "distance of neighbouring points, as session.toml states it")
    pitch_error_ppm: Number = key(0.0, "true pitch over stated pitch, less one, in millionths")
    print_offset_um: NotNegative = key(0.0, "each point off its place in x and in y, standard deviation")
    print_seed: Annotated[int, Field(ge=0)] = key(1, "of these offsets")
    flatness_um: Number = key(0.0, "how far the plate's middle stands out towards the viewer, over its corners")
    margin_mm: NotNegative = key(4.0, "white border around the print")


class CheckerboardTable(_PlateTable):
    """A checkerboard."""

    kind: Literal["checkerboard"] = key(..., '"checkerboard"')
    inner_corners: Counts = key(..., "columns, rows of inner corners")


class DotsTable(_PlateTable):
    """A plate of round dots."""

    kind: Literal["dots"] = key(..., '"dots"')
    dots: Counts = key(..., "columns, rows of dots")
    diameter_mm: Positive | None = key(None, "of a dot; absent: half the pitch, and session.toml does not state it")


class CharucoTable(_PlateTable):
    """A ChArUco board."""

    kind: Literal["charuco"] = key(..., '"charuco"')
    squares: Counts = key(..., "columns, rows of squares")
    marker_mm: Positive = key(..., "side of a marker")
    dictionary: Annotated[str, Field(pattern=r"^DICT_\w+$")] = key("DICT_5X5_100", "OpenCV's name of the markers")


TargetTable = Annotated[CheckerboardTable | DotsTable | CharucoTable, Field(discriminator="kind")]


class _PartTable(Table):
    albedo: Fraction = key(0.8, "share of the light that the surface scatters to all sides")
    gloss: Fraction = key(0.0, "weight of the reflection, 0: matt")
    gloss_width_deg: Annotated[float, Field(gt=0, le=90)] = key(8.0, "standard deviation of the reflection's direction")
    roughness_um: NotNegative = key(1.0, "of the surface; a smooth one has less speckle")


class _ExactPartTable(_PartTable):
    form_error_um: Annotated[float, Field(ge=0, le=1000)] = key(0.0, "largest deviation from the exact form")
    form_error_lobes: Annotated[int, Field(ge=1, le=100)] = key(
        3, "its waves round a round part, half waves along a flat one"
    )
    form_error_phase_deg: Number = key(0.0, "its phase")


_TOLERANCE = "as an artefact: how far each size may be from the true one, as session.toml states it"


class _EdgedPartTable(_ExactPartTable):
    chamfer_mm: NotNegative = key(0.0, "width of the chamfers on its convex edges, 45 deg")


class SphereTable(_ExactPartTable):
    """A ball."""

    kind: Literal["sphere"] = key(..., '"sphere"')
    diameter_mm: Positive = key(..., "diameter")
    tolerance_mm: NotNegative = key(0.0, _TOLERANCE)

    def artifact(self) -> KnownSphere:
        """What a session states about it in role artifact."""
        return KnownSphere(self.diameter_mm, self.tolerance_mm)


class CylinderTable(_EdgedPartTable):
    """An upright cylinder."""

    kind: Literal["cylinder"] = key(..., '"cylinder"')
    diameter_mm: Positive = key(..., "diameter")
    height_mm: Positive = key(..., "height")
    tolerance_mm: NotNegative = key(0.0, _TOLERANCE)

    def artifact(self) -> KnownCylinder:
        """What a session states about it in role artifact."""
        return KnownCylinder(self.diameter_mm, self.height_mm, self.tolerance_mm)


class SteppedCylinderTable(_EdgedPartTable):
    """A small cylinder on a large one: the artefact that fixes the rotation axis."""

    kind: Literal["stepped-cylinder"] = key(..., '"stepped-cylinder"')
    diameters_mm: Lengths = key(..., "small (upper), large (lower)")
    heights_mm: Lengths = key(..., "small (upper), large (lower)")
    tolerance_mm: NotNegative = key(0.0, _TOLERANCE)

    def artifact(self) -> SteppedCylinder:
        """What a session states about it in role artifact."""
        return SteppedCylinder(*self.diameters_mm, *self.heights_mm, self.tolerance_mm)


class GrooveTable(_EdgedPartTable):
    """A block with a trapezoidal groove along y, open at the top and at both ends."""

    kind: Literal["groove"] = key(..., '"groove"')
    depth_mm: Positive = key(..., "of the groove")
    width_top_mm: Positive = key(22.0, "of the groove, at the top")
    width_bottom_mm: Positive = key(12.0, "of the groove, at its floor")
    width_mm: Positive = key(46.0, "of the block, across the groove")
    length_mm: Positive = key(32.0, "of the block, along the groove")
    height_mm: Positive = key(24.0, "of the block")


class ConeTable(_EdgedPartTable):
    """An upright cone or frustum."""

    kind: Literal["cone"] = key(..., '"cone"')
    diameter_bottom_mm: NotNegative = key(..., "diameter at the bottom")
    diameter_top_mm: NotNegative = key(0.0, "diameter at the top; 0: an apex")
    height_mm: Positive = key(..., "height")


class BlockTable(_EdgedPartTable):
    """A block or plate."""

    kind: Literal["block"] = key(..., '"block"')
    width_mm: Positive = key(..., "along x")
    length_mm: Positive = key(..., "along y")
    height_mm: Positive = key(..., "along z")


class MeshTable(_PartTable):
    """Any closed surface of triangles."""

    kind: Literal["mesh"] = key(..., '"mesh"')
    file: str = key(..., "STL, PLY or OBJ; relative to the rig file")
    mm_per_unit: Positive = key(1.0, "of the file: 1000 for metres, 25.4 for inches")
    stand: bool = key(True, "moved so that it stands in the middle of z = 0; false: as in the file")
    fill_holes: bool = key(False, "close holes instead of refusing a mesh that has some")


class GeneratedTable(_PartTable):
    """A part with small details that the program generates; as it comes, unless its surface is stated."""

    kind: Literal["generated"] = key(..., '"generated"')
    name: Literal["bust", "casting_with_flash", "rubber_model", "thread_connector"] = key(
        ..., "bust, casting_with_flash, rubber_model or thread_connector"
    )


PartTable = Annotated[
    SphereTable
    | CylinderTable
    | ConeTable
    | SteppedCylinderTable
    | GrooveTable
    | BlockTable
    | MeshTable
    | GeneratedTable,
    Field(discriminator="kind"),
]


class MountTable(Table):
    """How a part stands on the table, at angle 0."""

    position_mm: Pair = key((0.0, 0.0), "of the part's axis from the rotation axis: x, y")
    turn_deg: Number = key(0.0, "turn of the part about its own axis")
    tilt_deg: Annotated[float, Field(ge=0, lt=90)] = key(0.0, "tilt of the part")
    tilt_towards_deg: Number = key(0.0, "the side to which it tilts, from x")


class TurnKeys(Table):
    """A folder of frames, its role, and the angles of the table."""

    folder: Annotated[str, Field(pattern=r"^[\w][\w.-]*$")] = key(..., "name of the folder")
    role: Literal["camera", "laser-plane", "axis", "artifact", "scan"] = key(
        ..., "camera, laser-plane, axis, artifact or scan"
    )
    from_deg: Number = key(0.0, "first angle; roles axis, artifact and scan")
    to_deg: Number | None = key(None, "last angle; absent: a full turn, for role axis from_deg + 40")
    step_deg: Positive | None = key(None, "step of the angle; absent: 4, for role axis 2")
    frames: Annotated[int, Field(ge=1, le=100_000)] | None = key(None, "number of equal steps, instead of step_deg")
    shuffle: bool = key(False, "uneven steps in mixed order")


class CaptureTable(TurnKeys):
    """A folder of frames: what is recorded with which target or part."""

    target: str | None = key(None, "a name under [targets]; roles camera, laser-plane and axis")
    part: str | None = key(
        None, "a name under [parts]; roles artifact (a stepped cylinder, cylinder or sphere) and scan"
    )
    views: Annotated[int, Field(ge=1, le=1000)] | None = key(
        None, "poses of the target, drawn so that they cover the view (camera: 20) or the sheet (laser-plane: 10)"
    )
    laser_off_frames: bool = key(False, "a laser-off frame at each angle as well, as background; artifact and scan")
    mount: MountTable = key(MountTable(), "how the part stands on the table")
    exposure_off_ms: Positive | None = key(None, "of this capture; absent: as in [light]")
    exposure_on_ms: Positive | None = key(None, "of this capture; absent: as in [light]")
    ambient_on_fraction: NotNegative | None = key(None, "of this capture; absent: as in [light]")


class MeasurementTable(Table):
    """What is to be measured in a scan."""

    capture: str = key(..., "folder of a capture with role scan or artifact")
    feature: Literal["sphere", "cylinder", "plane", "step", "groove", "stepped-cylinder"] = key(..., "what to measure")
    reference: dict[Annotated[str, Field(pattern=r"^\w+_mm$")], Number] | None = key(
        None, "what a better instrument found, e.g. { diameter_mm = 28.475 }; absent: the true sizes of the part"
    )
    check: bool = key(False, "the reference is used to judge the calibration; captures with role scan only")


class RigTables(Table):
    """A rig file as a whole."""

    version: Literal[1] = key(1, "of this format")
    preset: str | None = key(
        None, "what is not stated here is as in that preset: article, webcam, high-resolution or demo"
    )
    camera: CameraTable = key(..., "the camera and its lens")
    sensor: SensorTable = key(SensorTable(), "the sensor")
    laser: LaserTable = key(..., "the line laser")
    light: LightTable = key(LightTable(), "light and exposures")
    turntable: TurntableTable = key(TurntableTable(), "the turntable")
    session: SessionTable = key(SessionTable(), "what is written")
    targets: dict[str, TargetTable] = key({}, "plates with a printed pattern, by name")
    parts: dict[str, PartTable] = key({}, "what stands on the table, by name")
    captures: Annotated[list[CaptureTable], Field(min_length=1)] = key(..., "folders of frames")
    measurements: list[MeasurementTable] = key([], "what to measure")
