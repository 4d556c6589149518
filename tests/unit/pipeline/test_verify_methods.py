"""The table of both methods, from errors of known size; the sessions it is made from."""

import json

import numpy as np
import pytest

import rotaline.pipeline.verify_methods as verify
from rotaline.calibration.observations import SessionObservations
from rotaline.errors import CalibrationError, SessionError
from rotaline.pipeline.compare_truth import CalibrationErrors
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.realisations import WorkPlan
from rotaline.pipeline.twin import TwinSession
from rotaline.pipeline.twin_errors import QuantityError


def errors(method, session, size, failure=""):
    features = tuple(
        QuantityError("features", name, "mm", sign * size, 0.002)
        for name, sign in (("stepped-1 diameter_small", 1), ("stepped-2 diameter_large", -3), ("rod diameter", 2))
    )
    stated = (QuantityError("axis", "axis_shift_x", "mm", size, 0.5 * size),) if method == "joint" else ()
    calibration = CalibrationErrors(axis_low_mm=size, axis_high_mm=2 * size, axis_urad=1000 * size)
    return verify.MethodErrors(method, session, calibration, features, stated, failure)


def test_errors_are_pooled_over_the_sessions_that_both_did():
    found = [
        *(errors("article", s, 0.02) for s in ("a", "b", "c")),
        *(errors("joint", s, 0.004) for s in ("a", "b")),
        errors("joint", "c", 9.0, failure="did not settle"),
    ]
    result = verify.compare_methods(found, rendered=False)
    assert result.n_sessions == 2
    assert result.failures == ("c, joint: did not settle",)
    rows = {r.quantity: r for r in result.rows}
    low = rows["axis, position at the table"]
    assert (low.article, low.joint, low.ratio, low.n) == (
        pytest.approx(0.02),
        pytest.approx(0.004),
        pytest.approx(5),
        2,
    )
    assert low.rms_standardised == pytest.approx(2.0)
    assert rows["axis, direction"].joint == pytest.approx(4e-6)
    assert np.isnan(rows["axis, direction"].rms_standardised)
    diameters = rows["stepped cylinder, diameters"]
    assert (diameters.joint, diameters.n) == (pytest.approx(0.004 * np.sqrt(5)), 4)
    assert rows["rod, diameter"].rms_standardised == pytest.approx(4.0)
    assert np.isnan(rows["ball, diameter"].joint)


def test_sessions_are_drawn_within_the_stated_ranges():
    one, two = verify.realistic_session(0).tables, verify.realistic_session(1).tables
    assert one.turntable != two.turntable
    for tables in (one, two):
        turntable = tables.turntable
        assert verify.ECCENTRICITY_DEG[0] <= turntable.angle_eccentricity_deg <= verify.ECCENTRICITY_DEG[1]
        assert verify.RUN_OUT_UM[0] <= turntable.run_out_um <= verify.RUN_OUT_UM[1]
        assert verify.WOBBLE_URAD[0] <= turntable.wobble_urad <= verify.WOBBLE_URAD[1]
        assert (turntable.angle_noise_deg, turntable.run_out_noise_um) == (0.003, 1.0)
        mounts = [c.mount for c in tables.captures if c.role == "artifact"]
        assert [
            low <= np.hypot(*m.position_mm) <= high
            for m, (low, high) in zip(mounts, verify.ARTIFACT_OFF_MM, strict=True)
        ] == [True, True]
    assert {t.print_seed for t in one.targets.values()}.isdisjoint(t.print_seed for t in two.targets.values())
    assert verify.realistic_session(0).tables == one


def test_a_session_that_cannot_be_calibrated_is_named(monkeypatch):
    def fail(*_):
        raise CalibrationError("nothing to see")

    monkeypatch.setattr(verify, "calibrate_observations", fail)
    monkeypatch.setattr(verify, "trace_twin", lambda rig, plan, **_: _Twin(rig, plan))
    result = verify.verify_methods(2, (), WorkPlan(1, None, Silent()))
    assert result.n_sessions == 0
    assert [f for f in result.failures if f.endswith("nothing to see")] == list(result.failures)
    assert len(result.failures) == 4


class _Twin:
    """A session of which nothing is seen."""

    def __init__(self, rig, plan):
        self.rig, self.plan = rig, plan

    def observed(self, *_):
        nothing = SessionObservations(self.rig.camera.image_size, (), frozenset(), (), (), ())
        return TwinSession(nothing, {})


def test_rendered_sessions_need_their_truth_and_a_place_for_results(tmp_path):
    session = tmp_path / "s00"
    session.mkdir()
    with pytest.raises(SessionError, match="--out DIR"):
        verify.verify_methods(20, (session,), WorkPlan(1, None, Silent()))
    with pytest.raises(SessionError, match=r"s00\.truth\.json"):
        verify.verify_methods(20, (session,), WorkPlan(1, tmp_path / "out", Silent()))
    (tmp_path / "s00.truth.json").write_text(json.dumps({"camera": 1}))
    with pytest.raises(SessionError, match="not the truth"):
        verify.verify_methods(20, (session,), WorkPlan(1, tmp_path / "out", Silent()))
