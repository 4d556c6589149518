"""What frames show that took no part, against estimates that were made without them.

Few frames are left, so that it matters whether one takes part: its residuals grow, by so much.
"""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.held_out import held_out
from rotaline.calibration.joint.iterate import iterate
from rotaline.calibration.joint.rows import mount_rows, plate_pivot, plate_rows
from rotaline.calibration.joint.state import table_motions


@pytest.fixture(scope="module")
def found(right_handed):
    return right_handed.solved()


def _part(case, found, plates, mounts):
    """The session with some of its plates and mounts only and no target on the table: a case and its estimate."""
    data = replace(
        case.data,
        plates=tuple(case.data.plates[k] for k in plates),
        tables=(),
        mount_frames=tuple(
            replace(f, mount=mounts.index(f.mount)) for f in case.data.mount_frames if f.mount in mounts
        ),
        mount_names=tuple(case.data.mount_names[k] for k in mounts),
        artifact_groups=tuple(case.data.artifact_groups[k] for k in mounts),
        n_boards=0,
    )
    state = replace(
        found.state,
        plates=tuple(found.state.plates[k] for k in plates),
        boards=(),
        mounts=tuple(found.state.mounts[k] for k in mounts),
        artifacts=tuple(found.state.artifacts[k] for k in mounts),
    )
    setting = replace(case.setting, data=data, artifacts=tuple(case.setting.artifacts[k] for k in mounts))
    part = replace(case, data=data, state=state, setting=setting)
    layout = part.layout()
    if not mounts:
        layout = replace(layout, slots=tuple(s for s in layout.slots if s[0] != "axis"))
    noise = replace(found.noise, frame=np.ones(0))
    return part, iterate(setting, layout, state, noise, found.band_mm)


@pytest.mark.parametrize("k", [1, 3])
def test_a_view_that_took_no_part(right_handed, found, k):
    """Two views in role camera, five with stripes."""
    plates = [0, 4, 8, 9, 10, 11, 12]
    case, whole = _part(right_handed, found, plates, [])
    _, part = _part(right_handed, found, [p for i, p in enumerate(plates) if i != k], [])
    without, frame, pose = part.state, case.data.plates[k], whole.state.plates[k]
    n = 2 * len(frame.points.uv)
    for _ in range(5):
        rows = plate_rows(without, frame, pose, case.data, case.names)
        step = -np.linalg.lstsq(rows.local[:n, :6], rows.residuals[:n], rcond=None)[0]
        pose = pose.moved(step, plate_pivot(without, frame, pose))
    left = plate_rows(without, frame, pose, case.data, case.names).residuals
    result = held_out(case.setting, whole)
    rms_px = np.sqrt(2 * np.mean(left[:n] ** 2))
    inside = np.sqrt(2 * np.mean(whole.frames[k].raw[:n] ** 2))
    assert rms_px > inside
    assert result.of(k, stripe=False) - inside == pytest.approx(rms_px - inside, rel=0.15)
    assert (frame.stripe is not None) == (k == 3)
    if frame.stripe is None:
        assert np.isnan(result.of(k, stripe=True))
    else:
        assert result.of(k, stripe=True) == pytest.approx(np.sqrt(np.mean(left[n:] ** 2)), rel=0.1)


def test_a_mount_that_took_no_part(right_handed, found):
    """One of two, and no target on the table: the axis comes from the other alone."""
    plates = [0, 2, 4, 8, 9, 10]
    case, whole = _part(right_handed, found, plates, [0, 3])
    _, part = _part(right_handed, found, plates, [0])
    state = replace(
        part.state,
        mounts=(*part.state.mounts, whole.state.mounts[1]),
        artifacts=(*part.state.artifacts, whole.state.artifacts[1]),
    )
    frames = [f for f in case.data.mount_frames if f.mount == 1]
    for _ in range(5):
        columns, residuals, distances = [], [], []
        for frame, (rows, _) in zip(frames, mount_rows(state, frames, case.data, case.names, 0.5), strict=True):
            motions = table_motions(state, frame.angle_rad, whole.layout, "mount:1", state.mount_pivot(1))
            columns.append(rows.local @ motions["mount:1"])
            residuals.append(rows.residuals)
            distances.append(rows.residuals * rows.mm_per_px)
        step = np.zeros(whole.layout.size)
        move = -np.linalg.lstsq(np.concatenate(columns), np.concatenate(residuals), rcond=None)[0]
        step[whole.layout.of("mount:1")] = move
        state = case.after(state, whole.layout, step)
    rms_mm = np.sqrt(np.mean(np.concatenate(distances) ** 2))
    mine = whole.frames[-len(frames) :]
    inside = np.sqrt(np.mean(np.concatenate([f.raw * f.rows.mm_per_px for f in mine]) ** 2))
    assert rms_mm > inside
    assert held_out(case.setting, whole).mounts_mm[1] - inside == pytest.approx(rms_mm - inside, rel=0.15)


def test_a_frame_with_a_fault_stands_out_when_it_takes_no_part(right_handed, found):
    """The stripe of one pose is 0.3 px off: what its plate may be off its points must not hide it."""
    case = right_handed
    k = next(i for i, f in enumerate(case.data.plates) if f.stripe is not None)
    line = case.data.plates[k].stripe
    bad = replace(case.data.plates[k], stripe=replace(line, uv=line.uv + 0.3 * line.normal))
    data = replace(case.data, plates=tuple(bad if i == k else f for i, f in enumerate(case.data.plates)))
    faulty = iterate(replace(case.setting, data=data), found.layout, found.state, found.noise, found.band_mm)
    result = held_out(replace(case.setting, data=data), faulty)
    striped = [i for i, f in enumerate(data.plates) if f.stripe is not None]
    assert max(striped, key=lambda i: result.of(i, stripe=True)) == k
    assert result.of(k, stripe=True) > 0.2
