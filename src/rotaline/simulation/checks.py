"""Whether a rig can record what a plan asks for, found before anything is rendered.

An error is a scene of which nothing can be measured: the camera looks away, the laser misses the part, the part does not fit on the
table. A warning is one that gives poor results: a part that is cut off, a stripe that is too wide, saturated or faint.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.errors import RigError
from rotaline.simulation.ideal.stripe_trace import trace_stripe
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.boards import WHITE, Plate
from rotaline.simulation.parts.shapes import Shape
from rotaline.simulation.plan import CapturePlan, SessionPlan, Shot, table_disc
from rotaline.simulation.poses import in_fan, in_image
from rotaline.simulation.rig import Laser, Rig

_LEAST_ANGLE_DEG, _GOOD_ANGLE_DEG = 5.0, 15.0
_LEAST_SIGMA_PX, _LARGEST_SIGMA_PX = 0.4, 7.5
"""Standard deviation of the stripe in the image; a pixel's own area alone gives 0.29."""

_FAINT_DN, _DARK_DN = 8.0, 25.0
_SATURATED_SHARE, _CUT_SHARE = 0.2, 0.02
_STANDS_MM = 1.0
"""A part may float or sink by as much: parts that lean do."""

_N_ANGLES, _N_TRACED = 12, 3
"""Frames of a capture that are looked at: for what the laser meets, and for how the stripe looks."""


@dataclass(frozen=True)
class SceneProblem:
    """What is wrong: ``where`` (the rig, or a capture), and a text that says what was found and what to do."""

    severity: Literal["error", "warning"]
    where: str
    text: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.where}: {self.text}"


def check_scene(rig: Rig, plan: SessionPlan) -> tuple[SceneProblem, ...]:
    """All problems of a scene, errors first. Where camera or laser stand wrong, the captures are not looked at."""
    problems = _check_rig(rig)
    if not any(p.severity == "error" for p in problems):
        for capture in plan.captures:
            problems += _check_capture(rig, capture)
    return tuple(sorted(problems, key=lambda p: p.severity))


def require_scene(rig: Rig, plan: SessionPlan) -> tuple[SceneProblem, ...]:
    """The warnings of :func:`check_scene`.

    Raises
    ------
    RigError
        If there are errors: all of them, a line each.
    """
    problems = check_scene(rig, plan)
    _raise_errors(problems)
    return problems


def require_rig(rig: Rig) -> None:
    """Refuse a rig that can see no stripe whatever it records: no plan can be made for it.

    Raises
    ------
    RigError
        If there are errors: all of them, a line each.
    """
    _raise_errors(_check_rig(rig))


def _raise_errors(problems: Sequence[SceneProblem]) -> None:
    if errors := [str(p) for p in problems if p.severity == "error"]:
        raise RigError("\n".join(errors))


def _camera_base(rig: Rig) -> Float[np.ndarray, "3"]:
    return np.asarray(rig.camera_from_base.inv().translation)


def _check_rig(rig: Rig) -> list[SceneProblem]:
    problems = []
    places = {"Camera": _camera_base(rig), "Laser": rig.laser.position_base}
    for name, place in places.items():
        if place[2] <= 0:
            problems.append(
                SceneProblem("error", name, f"stands {-place[2]:.0f} mm below the table top. Move it above the table.")
            )
    axis_base = np.column_stack([np.zeros((26, 2)), np.linspace(0.0, 50.0, 26)])
    axis_camera = rig.camera_from_base.apply(axis_base)
    if not np.any(in_image(rig.camera, axis_camera)):
        off_deg = np.degrees(np.arctan2(np.linalg.norm(axis_camera[0, :2]), axis_camera[0, 2]))
        text = (
            f"lies {-axis_camera[0, 2]:.0f} mm behind the camera"
            if axis_camera[0, 2] <= 0
            else f"lies {off_deg:.0f} deg from the optical axis"
        )
        problems.append(
            SceneProblem(
                "error",
                "Camera",
                "looks away from the table: the rotation axis is not in the image up to 50 mm above the table top, "
                f"its foot {text}. Point the camera at the middle of the table.",
            )
        )
    middle_camera = axis_camera[12]
    towards = rig.laser_plane_camera.normal @ middle_camera / np.linalg.norm(middle_camera)
    angle_deg = float(np.degrees(np.arcsin(abs(towards))))
    if angle_deg < _GOOD_ANGLE_DEG:
        text = f"sees the laser sheet at {angle_deg:.1f} deg"
        text += ", almost edge on: there is no depth" if angle_deg < _LEAST_ANGLE_DEG else ": depth is measured badly"
        problems.append(
            SceneProblem(
                "error" if angle_deg < _LEAST_ANGLE_DEG else "warning",
                "Camera",
                f"{text}. Put camera and laser farther apart, at best 30 to 60 deg.",
            )
        )
    return problems


@dataclass(frozen=True, eq=False)
class _Scene:
    """What stands before the camera in a frame, base frame: what is to be measured, and the bare table."""

    measured: tuple[Placed, ...]
    table: tuple[Placed, ...]

    @staticmethod
    def of(rig: Rig, shot: Shot) -> "_Scene":
        base_from_table = rig.base_from_table(0.0 if shot.angle_deg is None else shot.angle_deg)
        bare = table_disc(rig).shape
        on_table = [part.moved(base_from_table) for part in shot.on_table]
        measured = (*shot.held, *(part for part in on_table if part.shape != bare))
        return _Scene(measured, tuple(part for part in on_table if part.shape == bare))

    @property
    def everything(self) -> tuple[Placed, ...]:
        return self.measured + self.table


def _spread(shots: Sequence[Shot], n: int) -> list[Shot]:
    """Up to n shots, evenly out of all."""
    return [shots[i] for i in sorted({round(k) for k in np.linspace(0, len(shots) - 1, min(n, len(shots)))})]


def _check_capture(rig: Rig, capture: CapturePlan) -> list[SceneProblem]:
    where = f"Capture {capture.folder}"
    off, on = ([shot for shot in capture.shots if shot.laser is laser] for laser in (False, True))
    problems = [] if not off else _check_exposure(rig, off[0], where)
    if capture.shots and capture.shots[0].on_table:
        problems += _check_part(rig, capture, where)
    if on and not any(p.severity == "error" for p in problems):
        problems += _check_stripe(rig, on, where)
    return problems


def _check_exposure(rig: Rig, shot: Shot, where: str) -> list[SceneProblem]:
    white_dn = shot.ambient_e_per_ms * shot.exposure_ms * WHITE / rig.sensor.electrons_per_dn
    white_dn += rig.sensor.black_level_dn
    found = f"white paper that faces the camera gets {white_dn:.0f} of 255 grey values in laser-off frames"
    if white_dn > 255:
        return [SceneProblem("warning", where, f"saturated: {found}. Shorten the exposure or dim the light.")]
    if white_dn < _DARK_DN:
        return [SceneProblem("warning", where, f"dark: {found}. Lengthen the exposure, or turn up light or gain.")]
    return []


def _surface_points(shape: Shape) -> Float[np.ndarray, "n 3"]:
    """Points all over a shape, part frame: where rays from 26 sides meet it."""
    lower, upper = shape.bounds()
    middle, reach = (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2
    places = np.linspace(-1.0, 1.0, 25) * reach
    square = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    points = []
    for side in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3):
        if not np.any(side):
            continue
        towards = side / np.linalg.norm(side)
        first = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
        first /= np.linalg.norm(first)
        origin = middle + 20.0 * reach * towards
        rays = middle + square @ np.stack([first, np.cross(towards, first)]) - origin
        t, _ = shape.intersect(origin, rays)
        hit = np.isfinite(t)
        points.append(origin + t[hit, None] * rays[hit])
    return np.concatenate(points)


def _check_part(rig: Rig, capture: CapturePlan, where: str) -> list[SceneProblem]:
    """Whether the parts of a capture fit on the table and into the view."""
    problems = []
    bare = table_disc(rig).shape
    for part in capture.shots[0].on_table:
        if part.shape == bare or isinstance(part.shape, Plate):
            continue
        points_table = part.frame_from_part.apply(_surface_points(part.shape))
        problems += _check_place(rig, part.shape, points_table, where)
        problems += _check_view(rig, capture, part, points_table, where)
    return problems


def _check_place(rig: Rig, shape: Shape, points_table: Float[np.ndarray, "n 3"], where: str) -> list[SceneProblem]:
    problems = []
    reach, radius = float(np.hypot(points_table[:, 0], points_table[:, 1]).max()), rig.table_radius_mm
    if reach > radius:
        width, depth, height = np.diff(shape.bounds(), axis=0)[0]
        larger = np.hypot(*(points_table[:, :2] - points_table[:, :2].mean(axis=0)).T).max() > radius
        problems.append(
            SceneProblem(
                "error",
                where,
                f"the part ({width:.0f} x {depth:.0f} x {height:.0f} mm) "
                + ("is larger than the table" if larger else "hangs over the edge of the table")
                + f": it reaches {reach:.0f} mm from the axis, the table ends at {radius:.0f} mm. "
                + (
                    "Take a larger table or a smaller part (wrong unit?)." if larger else "Put it nearer to the middle."
                ),
            )
        )
    lowest = float(points_table[:, 2].min())
    if abs(lowest) > _STANDS_MM:
        text = f"floats {lowest:.1f} mm above" if lowest > 0 else f"sinks {-lowest:.1f} mm into"
        problems.append(
            SceneProblem("warning", where, f"the part {text} the table top. Change the height of its mount.")
        )
    return problems


def _check_view(
    rig: Rig, capture: CapturePlan, part: Placed, points_table: Float[np.ndarray, "n 3"], where: str
) -> list[SceneProblem]:
    problems, cut = [], []
    lower, upper = part.shape.bounds()
    inside: set[str] = set()
    for shot in _spread(capture.shots, _N_ANGLES):
        base_from_table = rig.base_from_table(0.0 if shot.angle_deg is None else shot.angle_deg)
        part_from_base = (base_from_table * part.frame_from_part).inv()
        for name, place in {"camera": _camera_base(rig), "laser": rig.laser.position_base}.items():
            place_part = part_from_base.apply(place[None])[0]
            if np.all((place_part > lower) & (place_part < upper)):
                inside.add(name)
        seen = in_image(rig.camera, (rig.camera_from_base * base_from_table).apply(points_table))
        cut.append(1.0 - float(seen.mean()))
    problems += [
        SceneProblem("error", where, f"the {name} stands inside the part. Move it away, or check the part's unit.")
        for name in sorted(inside)
    ]
    if min(cut) == 1.0:
        problems.append(
            SceneProblem(
                "error", where, "no point of the part is in the image at any angle. Point the camera at it, or move it."
            )
        )
    elif max(cut) > _CUT_SHARE:
        problems.append(
            SceneProblem(
                "warning",
                where,
                f"up to {100 * max(cut):.0f} % of the part's surface is outside the image and cannot be measured. "
                "Move the camera away, or take a shorter focal length.",
            )
        )
    return problems


def _first(
    parts: Sequence[Placed], origin_base: Float[np.ndarray, "3"], rays_base: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Distance in lengths of the ray of the first hit, and the index of the part (-1: nothing is hit)."""
    t, index = np.full(len(rays_base), np.inf), np.full(len(rays_base), -1)
    for i, part in enumerate(parts):
        part_from_base = part.frame_from_part.inv()
        t_part, _ = part.shape.intersect(part_from_base.apply(origin_base), part_from_base.rotation.apply(rays_base))
        index = np.where(t_part < t, i, index)
        t = np.minimum(t, t_part)
    return t, index


def _lit_points(laser: Laser, scene: _Scene) -> Float[np.ndarray, "n 3"]:
    """Points of what is to be measured that the laser's plane reaches (a bow is left out), base frame."""
    angle = np.radians(np.linspace(-laser.fan_deg / 2, laser.fan_deg / 2, 1001))[:, None]
    rays = np.cos(angle) * laser.beam_base + np.sin(angle) * np.cross(laser.plane_base.normal, laser.beam_base)
    t, index = _first(scene.everything, laser.position_base, rays)
    hit = (index >= 0) & (index < len(scene.measured))
    return np.asarray(laser.position_base + t[hit, None] * rays[hit])


def _in_sight(rig: Rig, scene: _Scene, points_base: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether nothing stands between the camera and points of a surface."""
    eye = _camera_base(rig)
    t, _ = _first(scene.everything, eye, points_base - eye)
    return np.asarray(t > 1.0 - 1e-6)


def _check_stripe(rig: Rig, shots: Sequence[Shot], where: str) -> list[SceneProblem]:
    """Whether the laser meets the part, the camera sees that, and what the stripe looks like."""
    looked_at = _spread(shots, _N_ANGLES)
    scenes = [_Scene.of(rig, shot) for shot in looked_at]
    lit = [_lit_points(rig.laser, scene) for scene in scenes]
    n_lit = sum(len(points) > 0 for points in lit)
    if n_lit == 0:
        return [SceneProblem("error", where, _why_missed(rig, scenes))]
    problems = []
    if n_lit < len(scenes):
        problems.append(
            SceneProblem(
                "warning",
                where,
                f"the laser meets the part in {n_lit} of {len(scenes)} frames looked at. "
                "Put the part nearer to the axis, or aim the laser at the axis.",
            )
        )
    points = np.concatenate(lit)
    in_view = in_image(rig.camera, rig.camera_from_base.apply(points))
    visible = np.concatenate([_in_sight(rig, scene, p) for scene, p in zip(scenes, lit, strict=True)])
    if not np.any(in_view & visible):
        text = f"{100 * np.mean(~in_view):.0f} % of it is outside the image, and the part hides {100 * np.mean(~visible):.0f} %"
        problems.append(
            SceneProblem(
                "error",
                where,
                f"the camera does not see the stripe on the part: {text}. Move camera or laser, so that both see the same side.",
            )
        )
        return problems
    lit_shots = [shot for shot, found in zip(looked_at, lit, strict=True) if len(found)]
    return problems + _check_look(rig, _spread(lit_shots, _N_TRACED), where)


def _why_missed(rig: Rig, scenes: Sequence[_Scene]) -> str:
    parts = [part for scene in scenes for part in scene.measured]
    points = np.concatenate([part.frame_from_part.apply(_surface_points(part.shape)) for part in parts])
    wide = replace(rig.laser, fan_deg=170.0)
    if any(len(_lit_points(wide, scene)) for scene in scenes):
        rays = points - rig.laser.position_base
        cosines = rays @ rig.laser.beam_base / np.linalg.norm(rays, axis=1)
        nearest_deg = float(np.degrees(np.arccos(cosines.max())))
        return (
            f"the laser's fan does not reach the part: it is {nearest_deg:.0f} deg or more from the middle of the beam, the fan ends at "
            f"{rig.laser.fan_deg / 2:.0f} deg. Aim the laser at the part, or take a wider fan."
        )
    if not np.any(in_fan(replace(rig.laser, fan_deg=179.0), points)):
        return "the laser points away from the part. Aim it at the middle of the table."
    distance = np.abs(rig.laser.plane_base.signed_distance_to(points)).min()
    return (
        f"the laser sheet misses the part at all angles: it passes at a distance of {distance:.1f} mm or more. "
        "Aim the laser at the part, or move the part."
    )


def _check_look(rig: Rig, shots: Sequence[Shot], where: str) -> list[SceneProblem]:
    """Width and brightness of the stripe."""
    traces = []
    for shot in shots:
        exposed = replace(rig, light=replace(rig.light, exposure_on_ms=shot.exposure_ms))
        traces.append(trace_stripe(exposed, _Scene.of(rig, shot).measured, spacing_px=4.0, min_intensity_dn=0.0))
    width_px, intensity_dn, saturated = (
        np.concatenate([getattr(trace, name) for trace in traces]) for name in ("width_px", "intensity_dn", "saturated")
    )
    if len(width_px) == 0:
        return [SceneProblem("warning", where, "only scraps of the stripe are in view. Move the part or the camera.")]
    problems = []
    sigma_px = float(np.median(width_px))
    if sigma_px < _LEAST_SIGMA_PX:
        text = "too narrow to be located between pixels. Take a wider line or a softer lens"
    else:
        text = "too wide to be located well. Take a narrower line, a better focus or a larger f-number"
    if not _LEAST_SIGMA_PX <= sigma_px <= _LARGEST_SIGMA_PX:
        problems.append(
            SceneProblem("warning", where, f"the stripe is {4 * sigma_px:.1f} px wide (1/e^2, all of it): {text}.")
        )
    share, middle_dn = float(saturated.mean()), float(np.median(intensity_dn))
    if share > _SATURATED_SHARE:
        problems.append(
            SceneProblem(
                "warning",
                where,
                f"{100 * share:.0f} % of the stripe is saturated. Shorten the exposure of laser-on frames, or dim the laser.",
            )
        )
    if middle_dn < _FAINT_DN:
        problems.append(
            SceneProblem(
                "warning",
                where,
                f"the stripe is faint: half of it has less than {middle_dn:.1f} of 255 grey values. "
                "Lengthen the exposure of laser-on frames, or take a stronger laser.",
            )
        )
    return problems
