"""From the tables of a rig file to the values that are rendered: the rig, and the plan of a session."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import RigError
from rotaline.geometry.primitives import Artifact, Plane, SteppedCylinder, unit
from rotaline.io.rig_tables import (
    BlockTable,
    CameraTable,
    CaptureTable,
    CharucoTable,
    CheckerboardTable,
    ConeTable,
    CylinderTable,
    GeneratedTable,
    LaserTable,
    MeasurementTable,
    MeshTable,
    MountTable,
    PartTable,
    RigTables,
    SphereTable,
    SteppedCylinderTable,
    TargetTable,
    TurnKeys,
    TurntableTable,
)
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.complex_parts import GENERATORS
from rotaline.simulation.parts.form_error import FormError
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.mesh_files import read_mesh_part
from rotaline.simulation.parts.shapes import Ball, Block, Cone, GrooveBlock, Rod, Shape, SteppedRod
from rotaline.simulation.plan import (
    CapturePlan,
    MeasurementPlan,
    SessionPlan,
    axis_capture,
    camera_capture,
    laser_capture,
    laser_off,
    mount,
    scan_capture,
)
from rotaline.simulation.rig import Laser, Light, Mechanics, Optics, Rig, Sensor
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target

T = TypeVar("T")

_HERE = Path()

_RGB_BY_WAVELENGTH_NM = {450.0: (0.05, 0.15, 1.0), 532.0: (0.12, 1.0, 0.15), 650.0: (1.0, 0.12, 0.05)}
_STRIPE_LEVEL, _AMBIENT_LEVEL = 0.6, 0.75
"""Shares of full scale, white; speckle reaches twice the mean and more."""

_REFERENCES = {
    "sphere": ("diameter",),
    "cylinder": ("diameter",),
    "groove": ("depth",),
    "stepped-cylinder": ("diameter_small", "diameter_large", "height_small", "height_large"),
}
"""Sizes that stand in for the reference of a measurement, if the file states none."""


def rig_of(tables: RigTables) -> Rig:
    """The rig that a file describes.

    The base frame stands on the rotation axis: its z axis is the axis, its origin the axis's point on the table top, its x axis
    as near to the nominal one as the tilt allows.

    Raises
    ------
    RigError
        If camera or laser coincide with the point that they are aimed at, or the focus is nearer than the focal length.
    """
    base_from_nominal = _base_from_nominal(tables.turntable)
    model, camera_from_nominal = _camera(tables.camera)
    sensor = Sensor(**tables.sensor.model_dump())
    optics = _optics(tables.camera)
    table = tables.turntable
    return Rig(
        camera=model,
        camera_from_base=camera_from_nominal * base_from_nominal.inv(),
        laser=_laser(tables, base_from_nominal, model, optics, sensor),
        sensor=sensor,
        optics=optics,
        light=_light(tables, sensor),
        mechanics=Mechanics(
            angle_noise_deg=table.angle_noise_deg,
            angle_eccentricity_deg=table.angle_eccentricity_deg,
            angle_eccentricity_phase_deg=table.angle_eccentricity_phase_deg,
            run_out_um=table.run_out_um,
            run_out_phase_deg=table.run_out_phase_deg,
            run_out_noise_um=table.run_out_noise_um,
            wobble_urad=table.wobble_urad,
            wobble_phase_deg=table.wobble_phase_deg,
        ),
        turn_sense=table.turn_sense,
        table_radius_mm=table.radius_mm,
    )


def _base_from_nominal(table: TurntableTable) -> RigidTransform:
    lean_x, lean_y = np.tan(np.radians(table.axis_tilt_deg))
    z, direction = np.array([0.0, 0.0, 1.0]), unit(np.array([lean_x, lean_y, 1.0]))
    turn = np.cross(z, direction)
    sine = float(np.linalg.norm(turn))
    nominal_from_base = Rotation.from_rotvec(turn / sine * np.arcsin(sine) if sine > 0 else np.zeros(3))
    return RigidTransform.from_components([*table.axis_offset_mm, 0.0], nominal_from_base).inv()


def _direction(origin: tuple[float, ...], target: tuple[float, ...], what: str) -> Float[np.ndarray, "3"]:
    if np.allclose(origin, target):
        raise RigError(f"{what}: both are {list(target)}; give another point, so that there is a direction.")
    return unit(np.subtract(target, origin))


def _camera(table: CameraTable) -> tuple[CameraModel, RigidTransform]:
    """The intrinsic parameters, and ``camera_from_nominal``."""
    width, height = table.image_size
    fy = table.focal_length_mm / (table.pixel_pitch_um * 1e-3)
    right, down = table.principal_point_offset_px
    model = CameraModel(
        table.image_size,
        fy * table.pixel_aspect,
        fy,
        (width - 1) / 2 + right,
        (height - 1) / 2 + down,
        table.k1,
        table.k2,
        table.p1,
        table.p2,
        table.k3,
    )
    forward = _direction(table.position_mm, table.look_at_mm, "camera, position_mm and look_at_mm")
    # a camera that looks straight down has its top towards +y
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 1 - 1e-9 else np.array([0.0, 0.0, 1.0])
    right_axis = unit(np.cross(forward, up))
    upright = Rotation.from_matrix(np.stack([right_axis, np.cross(forward, right_axis), forward]))
    rotation = Rotation.from_rotvec([0.0, 0.0, np.radians(table.roll_deg)]) * upright
    return model, RigidTransform.from_components(-rotation.apply(np.array(table.position_mm)), rotation)


def _optics(table: CameraTable) -> Optics:
    focus = table.focus_distance_mm
    distance = float(np.linalg.norm(np.subtract(table.look_at_mm, table.position_mm)))
    focus_mm = None if focus == "everywhere" else distance if focus is None else float(focus)
    if focus_mm is not None and focus_mm <= 1.01 * table.focal_length_mm:
        raise RigError(
            f"camera, focus_distance_mm: the camera is focused at {focus_mm:g} mm with a lens of {table.focal_length_mm:g} mm; "
            "a lens focuses beyond its focal length only. Move the camera away, or give a shorter focal_length_mm."
        )
    return Optics(table.pixel_pitch_um, table.f_number, focus_mm, table.blur_px)


def _full_scale_e(sensor: Sensor) -> float:
    return sensor.full_well_e / sensor.gain


def _light(tables: RigTables, sensor: Sensor) -> Light:
    light = tables.light
    ambient = light.ambient_e_per_ms
    if ambient is None:
        ambient = _AMBIENT_LEVEL * _full_scale_e(sensor) / light.exposure_off_ms
    return Light(ambient, light.ambient_on_fraction, light.exposure_off_ms, light.exposure_on_ms)


def _laser(
    tables: RigTables, base_from_nominal: RigidTransform, camera: CameraModel, optics: Optics, sensor: Sensor
) -> Laser:
    table = tables.laser
    beam_nominal = _direction(table.position_mm, table.aim_at_mm, "laser, position_mm and aim_at_mm")
    beam = base_from_nominal.rotation.apply(beam_nominal)
    position = base_from_nominal.apply(np.array(table.position_mm))
    across = np.cross(beam, [0.0, 0.0, 1.0])
    # a beam along the axis holds its direction however the sheet is turned; then 0 means: along base x
    normal = unit(across) if np.linalg.norm(across) > 1e-9 else np.array([0.0, 1.0, 0.0])
    normal = unit(normal - (normal @ beam) * beam)
    normal = Rotation.from_rotvec(np.radians(table.sheet_roll_deg) * beam).apply(normal)

    distance = float(np.linalg.norm(np.subtract(table.aim_at_mm, table.position_mm)))
    diffraction_mrad = 4 / np.pi * table.wavelength_nm * 1e-3 / table.line_width_mm
    width_mrad = diffraction_mrad if table.divergence_mrad is None else table.divergence_mrad
    laser = Laser(
        plane_base=Plane(normal, -float(normal @ position)),
        position_base=position,
        beam_base=beam,
        sigma_mm=table.line_width_mm / 4,
        waist_mm=distance if table.waist_distance_mm is None else table.waist_distance_mm,
        divergence_mrad=float(width_mrad / 4),
        fan_deg=table.fan_deg,
        bow_mm=table.bow_mm,
        wavelength_nm=table.wavelength_nm,
        linewidth_nm=table.spectral_width_nm,
        speckle_contrast=table.speckle_contrast,
        rgb=_rgb_of(table),
    )
    if table.peak_e_per_ms is not None:
        return replace(laser, peak_e_per_ms=table.peak_e_per_ms)
    camera_mm = float(np.linalg.norm(np.subtract(tables.camera.position_mm, table.aim_at_mm)))
    sigma_px = laser.sigma_mm * camera.fy / camera_mm
    blurred = sigma_px / np.hypot(sigma_px, optics.blur_px)
    peak = _STRIPE_LEVEL * _full_scale_e(sensor) / tables.light.exposure_on_ms / blurred
    return replace(laser, peak_e_per_ms=float(peak))


def _rgb_of(table: LaserTable) -> tuple[float, float, float]:
    if table.rgb is not None:
        return table.rgb
    known = np.array(list(_RGB_BY_WAVELENGTH_NM.values()))
    red, green, blue = (
        float(np.interp(table.wavelength_nm, list(_RGB_BY_WAVELENGTH_NM), channel)) for channel in known.T
    )
    return red, green, blue


def plate_of(table: TargetTable) -> Plate:
    """The printed plate: the target that a session states, and the errors of the real one."""
    target: Target
    if isinstance(table, CheckerboardTable):
        target = Checkerboard(table.inner_corners, table.pitch_mm)
    elif isinstance(table, CharucoTable):
        target = CharucoBoard(table.squares, table.pitch_mm, table.marker_mm, table.dictionary)
    else:
        target = DotGrid(table.dots, table.pitch_mm, table.diameter_mm)
    return Plate(
        target,
        margin=table.margin_mm,
        pitch_error=table.pitch_error_ppm * 1e-6,
        print_offset_um=table.print_offset_um,
        print_seed=table.print_seed,
        flatness_um=table.flatness_um,
    )


def shape_of(table: PartTable, folder: Path = _HERE) -> Shape:
    """The part, standing on z = 0 of its own frame; ``folder``: where the files of meshes are.

    Raises
    ------
    RigError
        If a mesh cannot be used.
    ValueError
        If the sizes of a part contradict each other.
    """
    material = Material(table.albedo, table.gloss, table.gloss_width_deg, table.roughness_um)
    if isinstance(table, MeshTable):
        return read_mesh_part(
            folder / table.file, table.mm_per_unit, material, stand=table.stand, fill_holes=table.fill_holes
        )
    if isinstance(table, GeneratedTable):
        shape = GENERATORS[table.name]().shape
        stated = table.model_fields_set & {"albedo", "gloss", "gloss_width_deg", "roughness_um"}
        return replace(shape, material=material) if stated else shape
    form = FormError(table.form_error_um, table.form_error_lobes, table.form_error_phase_deg)
    if isinstance(table, SphereTable):
        return Ball(table.diameter_mm, material, form)
    surface: dict[str, Any] = {"material": material, "chamfer": table.chamfer_mm, "form_error": form}
    if isinstance(table, CylinderTable):
        return Rod(table.diameter_mm, table.height_mm, **surface)
    if isinstance(table, ConeTable):
        return Cone(table.diameter_bottom_mm, table.diameter_top_mm, table.height_mm, **surface)
    if isinstance(table, SteppedCylinderTable):
        return SteppedRod(SteppedCylinder(*table.diameters_mm, *table.heights_mm), **surface)
    if isinstance(table, BlockTable):
        return Block(table.width_mm, table.length_mm, table.height_mm, **surface)
    return GrooveBlock(
        table.width_mm,
        table.length_mm,
        table.height_mm,
        table.depth_mm,
        table.width_top_mm,
        table.width_bottom_mm,
        **surface,
    )


def _named(name: str, make: Callable[..., T], *of: Any) -> T:
    try:
        return make(*of)
    except (RigError, ValueError) as error:
        raise RigError(f"{name}: {error}") from error


def plan_of(tables: RigTables, rig: Rig, seed: int, folder: Path) -> SessionPlan:
    """The session that a file describes, frame by frame; ``folder``: where the files of meshes are.

    Raises
    ------
    RigError
        If a part or a target cannot be, or poses of a target do not fit into the view.
    """
    plates = {name: _named(f"targets.{name}", plate_of, table) for name, table in tables.targets.items()}
    shapes = {name: _named(f"parts.{name}", shape_of, table, folder) for name, table in tables.parts.items()}
    targets: dict[str, Target | Artifact] = {name: plate.target for name, plate in plates.items()}
    for name in (c.part for c in tables.captures if c.role == "artifact"):
        part = tables.parts[name or ""]
        assert isinstance(part, SphereTable | CylinderTable | SteppedCylinderTable)
        targets[name or ""] = part.artifact()
    captures = tuple(_capture_of(c, rig, plates, shapes, seed + 1000 * i) for i, c in enumerate(tables.captures))
    measurements = tuple(_measurement_of(m, tables, shapes) for m in tables.measurements)
    return SessionPlan(targets, captures, measurements, tables.session.image_format, seed)


def _capture_of(
    table: CaptureTable, rig: Rig, plates: dict[str, Plate], shapes: dict[str, Shape], seed: int
) -> CapturePlan:
    light = rig.light
    rig = replace(
        rig,
        light=Light(
            light.ambient_e_per_ms,
            light.ambient_on_fraction if table.ambient_on_fraction is None else table.ambient_on_fraction,
            light.exposure_off_ms if table.exposure_off_ms is None else table.exposure_off_ms,
            light.exposure_on_ms if table.exposure_on_ms is None else table.exposure_on_ms,
        ),
    )
    if table.target is not None and table.role != "scan":
        plate, name = plates[table.target], table.target
        if table.role == "camera":
            return camera_capture(rig, plate, name, views_of(table), seed, table.folder)
        if table.role == "laser-plane":
            return laser_capture(rig, plate, name, views_of(table), seed, folder=table.folder)
        return axis_capture(rig, plate, name, angles_deg(table, seed), table.folder)
    assert table.part is not None
    plan = scan_capture(
        rig,
        shapes[table.part],
        _table_from_part(table.mount),
        angles_deg(table, seed),
        folder=table.folder,
        role=table.role,
        target=table.part,
    )
    if not table.laser_off_frames:
        return plan
    pairs = [(laser_off(rig, angle_deg=shot.angle_deg, on_table=shot.on_table), shot) for shot in plan.shots]
    return replace(plan, shots=tuple(shot for pair in pairs for shot in pair))


def _table_from_part(table: MountTable) -> RigidTransform:
    return mount(*table.position_mm, table.turn_deg, table.tilt_deg, table.tilt_towards_deg)


def views_of(table: CaptureTable) -> int:
    """Number of poses of the target, stated or not."""
    return table.views or (20 if table.role == "camera" else 10)


def step_deg_of(table: TurnKeys) -> float:
    """Step of the angle, stated or not; for captures without ``frames``."""
    return table.step_deg or (2.0 if table.role == "axis" else 4.0)


def angles_deg(table: TurnKeys, seed: int) -> tuple[float, ...]:
    """The angles of a capture; the end of a full turn is its beginning and does not come twice.

    Examples
    --------
    >>> angles_deg(CaptureTable(folder="ball", role="scan", part="ball", frames=4), seed=1)
    (0.0, 90.0, 180.0, 270.0)
    >>> angles_deg(CaptureTable(folder="axis", role="axis", target="board", to_deg=6.0), seed=1)
    (0.0, 2.0, 4.0, 6.0)
    """
    axis = table.role == "axis"
    span = (40.0 if axis else 360.0) if table.to_deg is None else table.to_deg - table.from_deg
    whole_turn = abs(abs(span) - 360.0) < 1e-9
    if table.frames is not None:
        count = table.frames
        step = span / (count if whole_turn else max(count - 1, 1))
    else:
        step = float(np.copysign(step_deg_of(table), span))
        count = int(np.floor(abs(span / step) + 1e-9)) + 1
        count -= whole_turn and abs(step * (count - 1)) > 360.0 - 1e-6
    steps = np.arange(count, dtype=float)
    if table.shuffle:
        rng = np.random.default_rng([seed, 3])
        steps = rng.permutation(steps + rng.uniform(-0.35, 0.35, count))
    return tuple(float(angle) for angle in np.round(table.from_deg + step * steps, 6))


def _measurement_of(table: MeasurementTable, tables: RigTables, shapes: dict[str, Shape]) -> MeasurementPlan:
    if table.reference is not None:
        reference = {name.removesuffix("_mm"): float(value) for name, value in table.reference.items()}
    else:
        (part,) = {c.part for c in tables.captures if c.folder == table.capture}
        sizes = shapes[part or ""].sizes()
        reference = {name: sizes[name] for name in _REFERENCES.get(table.feature, ()) if name in sizes}
    return MeasurementPlan(table.capture, table.feature, reference, table.check)
