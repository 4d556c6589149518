"""Derivatives of the residuals against differences of the residuals, column by column."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotaline.calibration.joint.linear import board_pivot
from rotaline.calibration.joint.rows import mount_rows, plate_pivot, plate_rows, table_rows
from rotaline.calibration.joint.state import Rigid, table_motions
from rotaline.calibration.model import AngleError
from rotaline.geometry.primitives import KnownSphere

_STEPS = {
    "camera": 1e-5,
    "plane": 1e-5,
    "axis": 1e-5,
    "board": 1e-5,
    "mount": 1e-5,
    "sizes": 1e-4,
    "curvature": 1e-7,
    "angle": 1e-5,
    "run-out": 1e-4,
    "wobble": 1e-5,
    "pitch": 1e-6,
    "bend": 1e-4,
    "line": 1e-3,
}
"""Of the differences: small beside what makes the problem bend, large beside rounding."""

_ERRORS = {
    "curvature": np.array([2e-5, -1e-5, 1.5e-5]),
    "angle_error": AngleError(3e-4, -5e-4),
    "run_out": np.array([1e-3, -2e-3]),
    "wobble": np.array([5e-5, -3e-5]),
    "bends": (np.array([0.05, -0.03, 0.02]), np.array([-0.04, 0.06, 0.03])),
    "pitch_errors": (1e-3, -2e-3),
}


@pytest.fixture(params=["ideal", "curved sheet, bent targets, errors of the table", "the same, the other sense"])
def situation(request):
    """A session, a state, and by what part of its largest element a column may be off.

    Terms of second order are left out of the columns: the axes about which the sheet is curved turn with it, and errors of the table are small
    rotations one after another.
    """
    if request.param == "ideal":
        case = request.getfixturevalue("right_handed")
        return case, case.state, 2e-5
    case = request.getfixturevalue("left_handed" if "other" in request.param else "right_handed")
    return case, replace(case.state, **_ERRORS), 2e-3


def _assert_alike(column, difference, tolerance, what):
    scale = np.abs(difference).max()
    assert scale > 0, what
    assert np.abs(column - difference).max() < tolerance * scale, what


def _differences(case, state, layout, slot, value):
    """The columns of a slot by central differences of ``value(state)``."""
    out = []
    size = _STEPS[slot.partition(":")[0]]
    for k in range(layout.of(slot).start, layout.of(slot).stop):
        step = np.zeros(layout.size)
        step[k] = size * _unit_of(case, layout, k)
        ends = [value(case.after(state, layout, sign * step)) for sign in (1.0, -1.0)]
        out.append((ends[0] - ends[1]) / (2 * step[k]))
    return np.stack(out, axis=-1)


def _unit_of(case, layout, k):
    """Focal lengths are some thousand px; distortion hardly shows near the middle of the image."""
    if k >= len(case.names):
        return 1.0
    return 1e3 if case.names[k] in ("fx", "fy", "cx", "cy") else 1e2


def _plate_values(case, frame, pose):
    """Target points in px and the stripe's distances from the sheet in mm: what the rows derive."""

    def values(state):
        rows = plate_rows(state, frame, pose, case.data, case.names)
        n = 2 * len(frame.points.uv)
        return np.concatenate([rows.residuals[:n], (rows.residuals * rows.mm_per_px)[n:]])

    return values


def _in_mm(rows, n):
    """Factor of each row that makes its residual what :func:`_plate_values` gives."""
    return np.concatenate([np.ones(n), rows.mm_per_px[n:]])


def _striped(case):
    return next((k, f) for k, f in enumerate(case.data.plates) if f.stripe is not None)


def test_rows_of_plates_by_what_frames_share(situation):
    case, state, tolerance = situation
    k, frame = _striped(case)
    target = frame.points.target
    layout = case.layout("curvature", f"pitch:{target}", f"bend:{target}")
    rows = plate_rows(state, frame, state.plates[k], case.data, case.names)
    factor = _in_mm(rows, 2 * len(frame.points.uv))
    values = _plate_values(case, frame, state.plates[k])
    for slot in ("camera", "plane", "curvature", f"pitch:{target}", f"bend:{target}"):
        found = _differences(case, state, layout, slot, values)
        for c in range(found.shape[1]):
            _assert_alike(rows.common[slot][:, c] * factor, found[:, c], tolerance, (slot, c))


def test_rows_of_plates_by_their_own_motion(situation):
    case, state, tolerance = situation
    k, frame = _striped(case)
    pose = state.plates[k]
    n = 2 * len(frame.points.uv)
    rows = plate_rows(state, frame, pose, case.data, case.names)
    pivot = plate_pivot(state, frame, pose)
    for c in range(6):
        step = 1e-5 * np.eye(6)[c]
        ends = [_plate_values(case, frame, pose.moved(s * step, pivot))(state) for s in (1.0, -1.0)]
        _assert_alike(rows.local[:, c] * _in_mm(rows, n), (ends[0] - ends[1]) / 2e-5, tolerance, c)


def test_a_surface_off_the_plane_of_its_points_is_a_plate_moved_under_the_stripe(case):
    """Heights 1, x and y are a shift along the plate's normal and tilts about its middle, and leave the points where they are."""
    k, frame = _striped(case)
    state, pose = case.state, case.state.plates[k]
    n = 2 * len(frame.points.uv)
    rows = plate_rows(state, frame, pose, case.data, case.names)
    target = case.data.targets[frame.points.target]
    size = (np.array(target.grid_size) - 1) * target.pitch
    middle = pose.apply(np.array([[*size / 2, 0.0]]))[0]
    per_mm = 2.0 / np.linalg.norm(size)
    axes = pose.rotation.T
    motions = [np.r_[0, 0, 0, axes[2]], np.r_[-per_mm * axes[1], 0, 0, 0], np.r_[per_mm * axes[0], 0, 0, 0]]
    assert not rows.local[:n, 6:].any()
    for c, motion in enumerate(motions):
        ends = [_plate_values(case, frame, pose.moved(s * 1e-5 * motion, middle))(state)[n:] for s in (1.0, -1.0)]
        _assert_alike(rows.local[n:, 6 + c] * _in_mm(rows, n)[n:], (ends[0] - ends[1]) / 2e-5, 2e-5, c)


def test_residuals_grow_by_a_pixel_where_the_stripe_moves_by_a_pixel(situation):
    case, state, tolerance = situation
    k, frame = _striped(case)
    line = frame.stripe
    moved = replace(frame, stripe=replace(line, uv=line.uv + 1e-3 * line.normal))
    n = 2 * len(frame.points.uv)
    before, after = (plate_rows(state, f, state.plates[k], case.data, case.names) for f in (frame, moved))
    gain_mm = (after.residuals * after.mm_per_px - before.residuals * before.mm_per_px)[n:]
    assert gain_mm / before.mm_per_px[n:] == pytest.approx(np.full(len(gain_mm), 1e-3), rel=max(tolerance, 1e-3))
    for mount in range(len(case.data.mount_names)):
        frame = next(f for f in case.data.mount_frames if f.mount == mount)
        line = frame.stripe
        moved = replace(frame, stripe=replace(line, uv=line.uv + 1e-3 * line.normal))
        (a, pa), (b, pb) = (mount_rows(state, [f], case.data, case.names, 1.0)[0] for f in (frame, moved))
        both, ia, ib = np.intersect1d(pa.chosen, pb.chosen, return_indices=True)
        gain_mm = (b.residuals * b.mm_per_px)[ib] - (a.residuals * a.mm_per_px)[ia]
        assert len(both) > 10
        assert gain_mm / a.mm_per_px[ia] == pytest.approx(np.full(len(both), 1e-3), rel=max(tolerance, 5e-3))


def _moved_base(state, motion):
    """The table turned and shifted in its own frame."""
    base = state.camera_from_base
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    return replace(state, camera_from_base=Rigid(base.rotation @ turn, base.rotation @ motion[3:] + base.translation))


def test_rows_of_targets_on_the_table(situation):
    case, state, tolerance = situation
    frame = case.data.tables[4]
    target = frame.points.target
    layout = case.layout("angle", "run-out", "wobble", f"pitch:{target}", f"bend:{target}")

    def values(s):
        return table_rows(s, frame, case.names).residuals

    rows = table_rows(state, frame, case.names)
    for c in range(6):
        step = 1e-5 * np.eye(6)[c]
        difference = (values(_moved_base(state, step)) - values(_moved_base(state, -step))) / 2e-5
        _assert_alike(rows.local[:, c], difference, tolerance, c)
    pivot = state.boards[0].apply(board_pivot(case.data, 0)[None])[0]
    motions = table_motions(state, frame.angle_rad, layout, "board:0", pivot)
    columns = {**rows.common, **{name: rows.local @ motion for name, motion in motions.items()}}
    for slot in ("camera", "axis", "angle", "run-out", "wobble", "board:0", f"pitch:{target}", f"bend:{target}"):
        found = _differences(case, state, layout, slot, values)
        for c in range(found.shape[1]):
            _assert_alike(columns[slot][:, c], found[:, c], tolerance, (slot, c))


@pytest.mark.parametrize("mount", range(4), ids=["stepped", "rod", "endless", "ball"])
def test_rows_of_artefacts(situation, mount):
    """Over all frames of the mount: in some the angle hardly shows. How the blur shifts the curved stripe on a ball is taken as constant."""
    case, state, tolerance = situation
    tolerance = max(tolerance, 2e-3) if isinstance(state.artifacts[mount], KnownSphere) else tolerance
    frames = [f for f in case.data.mount_frames if f.mount == mount]
    group = case.data.artifact_groups[mount]
    layout = case.layout("curvature", "angle", "run-out", "wobble", f"sizes:{group}")
    found = mount_rows(state, frames, case.data, case.names, 1.0)

    def values(s):
        """Distances in mm; NaN where a point near an edge has left its surface."""
        out = []
        again = mount_rows(s, frames, case.data, case.names, 1.0)
        for frame, (_, before), (rows, points) in zip(frames, found, again, strict=True):
            full = np.full((len(frame.stripe.uv), 2), np.nan)
            full[points.chosen] = np.column_stack([rows.residuals * rows.mm_per_px, points.surface])
            out.append(np.where(full[before.chosen, 1] == before.surface, full[before.chosen, 0], np.nan))
        return np.concatenate(out)

    def assert_same(column, difference, what):
        known = np.isfinite(difference)
        assert np.count_nonzero(known) > 0.8 * len(known), what
        if np.abs(difference[known]).max() < 1e-9:  # heights of an artefact whose discs are not seen
            assert np.abs(column[known]).max() < 1e-9, what
        else:
            _assert_alike(column[known], difference[known], tolerance, what)

    pivot, slot_of_pose = state.mount_pivot(mount), f"mount:{mount}"
    locals_mm = np.concatenate([r.local * r.mm_per_px[:, None] for r, _ in found])
    for c in range(6):
        step = 1e-5 * np.eye(6)[c]
        difference = (values(_moved_base(state, step)) - values(_moved_base(state, -step))) / 2e-5
        assert_same(locals_mm[:, c], difference, c)
    columns = []
    for frame, (rows, _) in zip(frames, found, strict=True):
        motions = table_motions(state, frame.angle_rad, layout, slot_of_pose, pivot)
        frame_columns = {**rows.common, **{name: rows.local @ motion for name, motion in motions.items()}}
        columns.append({name: c * rows.mm_per_px[:, None] for name, c in frame_columns.items()})
    for slot in ("camera", "plane", "curvature", "axis", "angle", "run-out", "wobble", slot_of_pose, f"sizes:{group}"):
        difference = _differences(case, state, layout, slot, values)
        column = np.concatenate([c[slot] for c in columns])
        for c in range(difference.shape[1]):
            assert_same(column[:, c], difference[:, c], (slot, c))


@pytest.mark.parametrize("mount", range(4), ids=["stepped", "rod", "endless", "ball"])
def test_rows_of_artefacts_by_the_width_of_the_line(case, mount):
    frame = [f for f in case.data.mount_frames if f.mount == mount][3]
    wide, narrow = (replace(case.state, line_variance=v) for v in (0.02, 0.01))
    (a, _), (b, _) = (mount_rows(s, [frame], case.data, case.names, 1.0)[0] for s in (wide, narrow))
    _assert_alike(a.common["line"][:, 0], (a.residuals - b.residuals) / 0.01, 1e-6, "line")


def test_mounts_in_one_call_are_mounts_frame_by_frame(case):
    frames = [f for f in case.data.mount_frames if f.mount == 0]
    together = mount_rows(case.state, frames, case.data, case.names, 1.0)
    for frame, (rows, points) in zip(frames, together, strict=True):
        alone, where = mount_rows(case.state, [frame], case.data, case.names, 1.0)[0]
        assert np.mean(np.isin(points.chosen, where.chosen)) > 0.95  # what counts as grazing depends on the others
        _, i, j = np.intersect1d(points.chosen, where.chosen, return_indices=True)
        assert rows.residuals[i] == pytest.approx(alone.residuals[j], abs=1e-12)
        assert rows.local[i] == pytest.approx(alone.local[j], abs=1e-9)
