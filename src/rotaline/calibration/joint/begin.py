"""Where the joint estimate begins: the state that the stages before found, and the noise that is assumed before anything is known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.joint.data import JointData, TableFrame
from rotaline.calibration.joint.model import JointStart
from rotaline.calibration.joint.noise import Noise
from rotaline.calibration.joint.state import Rigid, State
from rotaline.calibration.joint.surfaces import mid_height
from rotaline.calibration.model import AngleError
from rotaline.calibration.observations import SessionObservations
from rotaline.geometry.transforms import base_from_axis, table_from_base
from rotaline.vision.targets.model import FLAT
from rotaline.vision.targets.ordering import symmetry_permutations

_START_SCALE = {"target": 0.1, "table-target": 0.1, "plate-stripe": 3.0, "artifact": 10.0}
"""Scale of the residuals before anything is known: px, and stated uncertainties of the stripe."""


def start_state(observations: SessionObservations, start: JointStart, data: JointData) -> State:
    """The unknowns as the stages left them."""
    poses = {v.name: v.camera_from_board for v in start.camera.views}
    stripes = {v.name: v for v in start.laser_plane.views} if start.laser_plane is not None else {}
    plates = tuple(
        Rigid.of(stripes[f.stripe_name].camera_from_board if f.stripe is not None else poses[f.name])
        for f in data.plates
    )
    plane, pivot = start.plane_camera, np.zeros(3)
    if plane is not None and stripes:
        seen = np.concatenate([v.points_camera for v in stripes.values() if v.used])
        pivot = seen.mean(axis=0)
        pivot = pivot - float(plane.normal @ pivot + plane.offset) * plane.normal
    artifacts = {m.name: m.artifact for m in observations.mounts}
    held = tuple(artifacts[name] for name in data.mount_names)
    base: Rigid | None = None
    boards: tuple[Rigid, ...] = ()
    mounts: tuple[Rigid, ...] = ()
    if start.axis_camera is not None:
        found = {m.name: m.table_from_part for m in start.mounts}
        parts = [found[name] for name in data.mount_names]
        on_table = _boards_on_table(start, data)
        heights = [float(p.apply([0.0, 0.0, mid_height(a)])[2]) for p, a in zip(parts, held, strict=True)] or [
            float(b.translation[2]) for b in on_table
        ]
        up = RigidTransform.from_translation([0.0, 0.0, float(np.mean(heights)) if heights else 0.0])
        base = Rigid.of(base_from_axis(start.axis_camera).inv() * up)
        boards = tuple(Rigid.of(up.inv() * b) for b in on_table)
        mounts = tuple(Rigid.of(up.inv() * p) for p in parts)
    bends = []
    for target in data.targets:
        bend = np.zeros(3)
        if target in start.camera.targets_as_stated:
            found_target = start.camera.targets[start.camera.targets_as_stated.index(target)]
            bend = np.array(found_target.bend if found_target.bend != FLAT else (0.0, 0.0, 0.0))
        bends.append(bend)
    return State(
        start.camera.camera,
        plates,
        plane,
        pivot,
        np.zeros(3),
        base,
        start.turn_sense,
        AngleError(),
        np.zeros(2),
        np.zeros(2),
        boards,
        mounts,
        held,
        tuple(bends),
        tuple(0.0 for _ in data.targets),
    )


def start_noise(data: JointData) -> Noise:
    """Scales before the first residuals are seen."""
    return Noise(
        np.array([_START_SCALE[g.kind] for g in data.groups]),
        np.ones(len(data.groups)),
        print_mm=np.zeros(len(data.targets)),
    )


def in_one_order(data: JointData, start: JointStart) -> JointData:
    """Targets on the table with their points numbered alike in all frames, as the axis stage found them.

    A symmetric target looks the same after half a turn, so the number of a point is a convention of each image.
    """
    if start.axis is None:
        return data
    poses = {f.name: f.camera_from_board for f in start.axis.frames}
    return replace(data, tables=tuple(_in_order(f, poses[f.name], data, start) for f in data.tables))


def _in_order(frame: TableFrame, camera_from_board: RigidTransform, data: JointData, start: JointStart) -> TableFrame:
    target = data.targets[frame.points.target]
    grid = target.points_board()
    best: tuple[float, np.ndarray] | None = None
    for permutation in symmetry_permutations(target):
        numbers = permutation[frame.points.numbers]
        uv = start.camera.camera.project(camera_from_board.apply(grid[numbers]))
        misfit = float(np.median(np.linalg.norm(uv - frame.points.uv, axis=1)))
        if best is None or misfit < best[0]:
            best = (misfit, numbers)
    assert best is not None
    return replace(frame, points=frame.points.renumbered(best[1], target))


def _boards_on_table(start: JointStart, data: JointData) -> Sequence[RigidTransform]:
    """``table_from_board`` of each target on the table: the mean over its frames."""
    assert start.axis_camera is not None
    if start.axis is None:
        return ()
    base_from_camera = base_from_axis(start.axis_camera)
    poses = {f.name: f.camera_from_board for f in start.axis.frames}
    result = []
    for board in range(data.n_boards):
        turned = [
            table_from_base(start.turn_sense * f.angle_rad) * base_from_camera * poses[f.name]
            for f in data.tables
            if f.board == board
        ]
        rotation = Rotation.concatenate([t.rotation for t in turned]).mean()
        result.append(RigidTransform.from_components(np.mean([t.translation for t in turned], axis=0), rotation))
    return result
