"""The end of the iteration as the result: the system with its covariance, and the residuals of every observation."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.data import MountFrame, TableFrame
from rotaline.calibration.joint.held_out import HeldOut, held_out
from rotaline.calibration.joint.iterate import MAX_ITERATIONS, Iterated
from rotaline.calibration.joint.linear import FrameResiduals, Setting
from rotaline.calibration.joint.model import (
    EstimatedQuantity,
    JointCalibration,
    JointMount,
    JointStart,
    OptionalParameters,
    ResidualGroup,
    TableErrors,
    ViewResiduals,
)
from rotaline.calibration.joint.noise import KEPT, TABLE_CLASSES, TABLE_ERRORS, determined, of_all_frames
from rotaline.calibration.joint.observability import weak_directions
from rotaline.calibration.joint.state import POSE_MOTIONS, State, once_per_turn
from rotaline.calibration.joint.surfaces import mid_height, sizes_of, surface_names
from rotaline.calibration.model import SystemCovariance, TableMotion
from rotaline.geometry.primitives import KnownSphere, Line, SheetCurvature
from rotaline.geometry.transforms import base_from_axis
from rotaline.vision.camera import DISTORTION_NAMES

_SLOT_NAMES = {
    "plane": ("plane_turn_1", "plane_turn_2", "plane_offset"),
    "curvature": ("curvature_uu", "curvature_uv", "curvature_vv"),
    "axis": ("axis_turn_x", "axis_turn_y", "axis_shift_x", "axis_shift_y"),
    "angle": ("angle_cos", "angle_sin"),
    "run-out": ("run_out_x", "run_out_y"),
    "wobble": ("wobble_x", "wobble_y"),
}


_NOT_SETTLED = (
    f"The joint estimate did not settle in {MAX_ITERATIONS} iterations: its uncertainties are not to be relied on. Look at the verdict for what "
    "contradicts what, and calibrate with --method article to see how far the stages agree."
)


def slot_values(state: State, slot: str, artifact_groups: Sequence[int]) -> Float[np.ndarray, " k"]:
    """The present values of a group of parameters that have values of their own."""
    kind, _, number = slot.partition(":")
    if kind in ("angle", "run-out", "wobble"):
        return once_per_turn(state, kind)
    if kind == "curvature":
        return state.curvature
    if kind == "pitch":
        return np.array([state.pitch_errors[int(number)]])
    if kind == "bend":
        return state.bends[int(number)]
    if kind == "sizes":
        return sizes_of(state.artifacts[artifact_groups.index(int(number))])
    raise ValueError(f"The parameters {slot!r} have no value of their own.")


def to_result(
    setting: Setting, found: Iterated, start: JointStart, optional: tuple[OptionalParameters, ...], n_iterations: int
) -> JointCalibration:
    """Everything that others need of the estimate."""
    state = found.state
    axis, state, turn = _final_axis(state)
    covariance = _system_covariance(setting, found, state, turn)
    left_out = held_out(setting, found)
    groups = _groups(setting, found, left_out)
    mounts = _mounts(setting, found, left_out)
    curvature = None
    if "curvature" in found.layout:
        a, b, c = (float(x) for x in state.curvature)
        curvature = SheetCurvature(state.plane_pivot, (a, b, c))
    result = JointCalibration(
        camera=state.camera,
        camera_names=setting.camera_names,
        laser_plane_camera=state.plane,
        laser_curvature=curvature,
        axis_camera=axis,
        turn_sense=state.turn_sense,
        angle_error=state.angle_error,
        covariance=covariance,
        parameters=_quantities(state, axis, covariance),
        groups=groups,
        mounts=mounts,
        table=_table_errors(setting, found),
        optional=optional,
        weak_directions=(),
        n_parameters=found.layout.size + sum(len(s) for s in found.solution.own_steps),
        n_observations=sum(len(f.raw) for f in found.frames),
        n_iterations=n_iterations,
        converged=found.converged,
        seconds=0.0,
        warnings=() if found.converged else (_NOT_SETTLED,),
        line_sigma_mm=float(np.sqrt(max(state.line_variance, 0.0))),
        stripe_blur_px=state.stripe_blur_px,
        table_motion=_table_motion(state, turn),
    )
    return replace(result, weak_directions=weak_directions(result))


def _final_axis(state: State) -> tuple[Line | None, State, float]:
    """The axis with the point nearest to the optical axis, and by how much the base frame of this line is turned about z."""
    base = state.camera_from_base
    if base is None:
        return None, state, 0.0
    direction, origin = base.rotation[:, 2], base.translation
    across_optical = direction[:2] @ direction[:2]
    s = -(origin[:2] @ direction[:2]) / across_optical if across_optical > 1e-12 else 0.0
    axis = Line(origin + s * direction, direction)
    final = base_from_axis(axis).rotation.as_matrix() @ base.rotation
    return axis, state, float(np.arctan2(final[1, 0], final[0, 0]))


def _table_motion(state: State, turn_rad: float) -> TableMotion | None:
    """Run-out and wobble in the base frame of the final line; None where there are none."""
    if state.camera_from_base is None or not (state.run_out.any() or state.wobble.any()):
        return None
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    (rx, ry), (wx, wy) = np.stack([state.run_out, state.wobble]) @ np.array([[c, s], [-s, c]])
    return TableMotion((float(rx), float(ry)), (float(wx), float(wy)), state.camera_from_base.translation)


def _system_covariance(setting: Setting, found: Iterated, state: State, turn_rad: float) -> SystemCovariance:
    """The part of the covariance that a scan needs, with the axis in the base frame of the final line."""
    names, columns = list(setting.camera_names), list(range(len(setting.camera_names)))
    layout = found.layout
    for slot, slot_names in _SLOT_NAMES.items():
        if slot in layout:
            place = layout.of(slot)
            names += slot_names
            columns += range(place.start, place.stop)
    matrix = found.solution.covariance[np.ix_(columns, columns)]
    if "axis" in layout:
        at = names.index("axis_turn_x")
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.eye(len(names))
        turn[at : at + 2, at : at + 2] = turn[at + 2 : at + 4, at + 2 : at + 4] = [[c, -s], [s, c]]
        for first in ("run_out_x", "wobble_x"):
            if first in names:
                k = names.index(first)
                turn[k : k + 2, k : k + 2] = [[c, -s], [s, c]]
        matrix = turn @ matrix @ turn.T
    pivot = np.zeros(3) if state.camera_from_base is None else state.camera_from_base.translation
    return SystemCovariance(tuple(names), matrix, state.plane_pivot, pivot)


def _quantities(state: State, axis: Line | None, covariance: SystemCovariance) -> tuple[EstimatedQuantity, ...]:
    """Value and standard uncertainty of every calibrated quantity."""
    u = dict(zip(covariance.names, np.sqrt(np.diag(covariance.matrix)).tolist(), strict=True))
    out = []
    for name in covariance.names:
        if hasattr(state.camera, name):
            unit = "1" if name in DISTORTION_NAMES else "px"
            out.append(EstimatedQuantity(name, float(getattr(state.camera, name)), u[name], unit, "image"))
    if state.plane is not None and "plane_offset" in u:
        turn = float(np.hypot(u["plane_turn_1"], u["plane_turn_2"]))
        out.append(EstimatedQuantity("laser plane, direction", float("nan"), turn, "rad", "camera"))
        offset = float(state.plane.normal @ state.plane_pivot + state.plane.offset)
        out.append(EstimatedQuantity("laser plane, offset", offset, u["plane_offset"], "mm", "camera"))
    for name in ("curvature_uu", "curvature_uv", "curvature_vv"):
        if name in u:
            value = state.curvature[("curvature_uu", "curvature_uv", "curvature_vv").index(name)]
            out.append(EstimatedQuantity(name.replace("_", " "), float(value), u[name], "1/mm", "camera"))
    if axis is not None and "axis_turn_x" in u:
        for name, label, unit in (
            ("axis_turn_x", "axis, direction about x", "rad"),
            ("axis_turn_y", "axis, direction about y", "rad"),
            ("axis_shift_x", "axis, position along x", "mm"),
            ("axis_shift_y", "axis, position along y", "mm"),
        ):
            out.append(EstimatedQuantity(label, float("nan"), u[name], unit, "base"))
    for name, label, unit, value in (
        ("run_out_x", "run-out once per turn, x", "mm", state.run_out[0]),
        ("run_out_y", "run-out once per turn, y", "mm", state.run_out[1]),
        ("wobble_x", "wobble once per turn, x", "rad", state.wobble[0]),
        ("wobble_y", "wobble once per turn, y", "rad", state.wobble[1]),
    ):
        if name in u:
            out.append(EstimatedQuantity(label, float(value), u[name], unit, "base"))
    if "angle_cos" in u:
        out.append(EstimatedQuantity("angle error, cos", state.angle_error.cos_rad, u["angle_cos"], "rad", "table"))
        out.append(EstimatedQuantity("angle error, sin", state.angle_error.sin_rad, u["angle_sin"], "rad", "table"))
    return tuple(out)


def _groups(setting: Setting, found: Iterated, left_out: HeldOut) -> tuple[ResidualGroup, ...]:
    data = setting.data
    names = [
        *((f.name, f.stripe_name, np.nan) for f in data.plates),
        *((f.name, "", f.angle_rad) for f in data.tables),
        *((f.name, f.name, f.angle_rad) for f in data.mount_frames),
    ]
    views: list[list[ViewResiduals]] = [[] for _ in data.groups]
    squares_mm: list[list[Float[np.ndarray, " _"]]] = [[] for _ in data.groups]
    predicted: list[list[Float[np.ndarray, " _"]]] = [[] for _ in data.groups]
    for k, frame in enumerate(found.frames):
        name, stripe_name, angle = names[k]
        for g in np.unique(frame.rows.group):
            mine = frame.rows.group == g
            is_stripe = data.groups[g].kind in ("plate-stripe", "artifact")
            width = 1 if is_stripe else 2
            # what belongs to the frame or to single points of a target is no misfit; on artefacts it is, for a scan has it too
            left = frame.raw if data.groups[g].kind == "artifact" else frame.cleaned
            residuals = left[mine].reshape(-1, width)
            weight = frame.weight[mine][::width]
            kept = weight > KEPT
            rms = float(np.sqrt(np.mean(np.sum(residuals[kept] ** 2, axis=1)))) if kept.any() else float("nan")
            views[g].append(
                ViewResiduals(
                    stripe_name if is_stripe else name,
                    True,
                    "",
                    _uv_of(setting, k, frame, is_stripe),
                    residuals,
                    weight,
                    rms,
                    left_out.of(k, is_stripe),
                    float(angle),
                )
            )
            predicted[g].append(frame.rows.u[mine])
            squares_mm[g].append((left * frame.rows.mm_per_px)[mine & (frame.weight > KEPT)] ** 2)
    out = []
    for g, info in enumerate(data.groups):
        if not views[g]:
            continue
        residuals = np.concatenate([v.residuals_px for v in views[g]])
        kept = np.concatenate([v.weight for v in views[g]]) > KEPT
        u = np.concatenate(predicted[g])
        stripe = info.kind in ("plate-stripe", "artifact")
        usual = float(np.median(u))
        scale = float(found.noise.scale[g])
        out.append(
            ResidualGroup(
                info.kind,
                info.name,
                tuple(views[g]),
                scale * usual if stripe else scale,
                float(np.sqrt(np.mean(np.sum(residuals[kept] ** 2, axis=1)))) if kept.any() else float("nan"),
                usual if stripe else float("nan"),
                float(found.noise.correlation[g]),
                len(residuals),
                int(np.count_nonzero(kept)),
                float(np.sqrt(np.mean(np.concatenate(squares_mm[g])))) if stripe and kept.any() else float("nan"),
            )
        )
    return tuple(out)


def _uv_of(setting: Setting, k: int, frame: FrameResiduals, is_stripe: bool) -> Float[np.ndarray, "n 2"]:
    data = setting.data
    if k < len(data.plates):
        plate = data.plates[k]
        if is_stripe:
            assert plate.stripe is not None
            return plate.stripe.uv
        return plate.points.uv
    k -= len(data.plates)
    if k < len(data.tables):
        return data.tables[k].points.uv
    assert frame.mount is not None
    return data.mount_frames[k - len(data.tables)].stripe.uv[frame.mount.chosen]


def _mounts(setting: Setting, found: Iterated, left_out: HeldOut) -> tuple[JointMount, ...]:
    data, state = setting.data, found.state
    first = len(data.plates) + len(data.tables)
    out = []
    for k, name in enumerate(data.mount_names):
        frames = [(f, found.frames[first + i]) for i, f in enumerate(data.mount_frames) if f.mount == k]
        artifact = state.artifacts[k]
        names = surface_names(artifact)

        def collect(what: str, frames: list = frames) -> np.ndarray:
            return np.concatenate([getattr(f.mount, what) for _, f in frames])

        surface, distances = collect("surface"), collect("distances_mm")
        weight = np.concatenate([f.weight for _, f in frames])
        kept = weight > KEPT
        on = [distances[(surface == s) & kept] for s in range(len(names))]
        pose = state.mounts[k]
        middle = pose.apply(np.array([[0.0, 0.0, mid_height(artifact)]]))[0]
        slot = found.layout.of(f"mount:{k}")
        sideways = slot.start + POSE_MOTIONS[slot.stop - slot.start].index(3)
        shift = found.solution.covariance[sideways : sideways + 2, sideways : sideways + 2]
        eccentricity = float(np.hypot(middle[0], middle[1]))
        towards = middle[:2] / eccentricity if eccentricity > 0 else np.array([1.0, 0.0])
        tilt = float("nan")
        if not isinstance(artifact, KnownSphere):
            tilt = float(np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0)))
        out.append(
            JointMount(
                name=name,
                artifact=artifact,
                table_from_part=pose.as_transform(),
                eccentricity_mm=eccentricity,
                u_eccentricity_mm=float(np.sqrt(towards @ shift @ towards)),
                tilt_rad=tilt,
                frame_names=tuple(f.name for f, _ in frames),
                angles_rad=np.array([f.angle_rad for f, _ in frames]),
                frame=np.repeat(np.arange(len(frames)), [len(f.raw) for _, f in frames]),
                surface=surface,
                points_part=collect("points_part"),
                distances_mm=distances,
                residuals_px=np.concatenate([f.raw for _, f in frames]),
                weight=weight,
                surfaces=names,
                mean_mm=np.array([float(d.mean()) if len(d) else np.nan for d in on]),
                rms_mm=np.array([float(np.sqrt(np.mean(d**2))) if len(d) else np.nan for d in on]),
                held_out_rms_mm=left_out.mounts_mm[k],
            )
        )
    return tuple(out)


def _table_errors(setting: Setting, found: Iterated) -> TableErrors | None:
    data = setting.data
    frames: list[TableFrame | MountFrame] = [*data.tables, *data.mount_frames]
    if not frames:
        return None
    first = len(data.plates)
    steps = np.array(found.solution.own_steps[first:])
    known = np.array(found.solution.own_variances[first:])
    _, variances = of_all_frames(found.noise, steps, known, np.ones(len(frames)))
    u = []
    for c in range(len(TABLE_ERRORS)):
        n = determined(float(found.noise.table[c]), variances[:, c == TABLE_CLASSES])
        u.append(found.noise.table[c] / np.sqrt(2.0 * max(n, 0.5)))
    return TableErrors(
        TABLE_ERRORS,
        found.noise.table,
        np.array(u),
        tuple(f.name.rpartition("/")[0] for f in frames),
        tuple(f.name for f in frames),
        np.array([f.angle_rad for f in frames]),
        steps,
    )
