"""Statistics of coverage and of efficiency on errors of known distribution; the errors themselves on systems that are off by known amounts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rotaline.pipeline.verify_efficiency as efficiency
import rotaline.pipeline.verify_uncertainty as verify
from rotaline.calibration.model import SystemCalibration, SystemCovariance
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.geometry.transforms import base_from_axis
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.realisations import WorkPlan
from rotaline.pipeline.twin import trace_twin
from rotaline.pipeline.twin_errors import QuantityError, system_errors, truth_of
from rotaline.simulation.rig import Laser, build_rig
from rotaline.simulation.small_session import small_plan

NAMES = (
    "fx",
    "plane_turn_1",
    "plane_turn_2",
    "plane_offset",
    "axis_turn_x",
    "axis_turn_y",
    "axis_shift_x",
    "axis_shift_y",
)


def thin_rig():
    rig = build_rig((640, 480), turn_sense=-1)
    laser = replace(rig.laser, sigma_mm=rig.laser.sigma_mm / 10, peak_e_per_ms=10 * rig.laser.peak_e_per_ms)
    assert isinstance(laser, Laser)
    return replace(rig, laser=laser)


RIG = thin_rig()
PLAN = small_plan(RIG)


def test_errors_are_what_the_covariance_counts():
    """The estimate is moved by known amounts as the docstring of SystemCovariance says; the errors must undo that."""
    change = dict(zip(NAMES, (0.3, 2e-5, -3e-5, 0.004, 4e-5, -1e-5, 0.002, -0.005), strict=True))
    axis, plane = RIG.rotation_axis_camera, RIG.laser_plane_camera
    axis_pivot = axis.point + 20.0 * axis.direction
    plane_pivot = np.array([3.0, -5.0, 280.0])
    plane_pivot = plane_pivot - plane.signed_distance_to(plane_pivot[None])[0] * plane.normal
    estimate = SystemCalibration(RIG.camera, plane, Line(axis_pivot, axis.direction), -1, table_seen=False)
    covariance = SystemCovariance(NAMES, np.diag(np.arange(1.0, 9.0) ** 2), plane_pivot, axis_pivot)
    rotation = base_from_axis(axis).inv().rotation
    turn = Rotation.from_rotvec(rotation.apply([change["axis_turn_x"], change["axis_turn_y"], 0.0]))
    shift = rotation.apply([change["axis_shift_x"], change["axis_shift_y"], 0.0])
    e1, e2 = across(plane.normal)
    gradient = plane.normal + change["plane_turn_1"] * e1 + change["plane_turn_2"] * e2
    offset = plane.offset - (gradient - plane.normal) @ plane_pivot + change["plane_offset"]
    length = np.linalg.norm(gradient)
    truth = replace(
        truth_of(RIG, PLAN),
        camera=replace(RIG.camera, fx=RIG.camera.fx + change["fx"]),
        laser_plane_camera=Plane(-gradient / length, -offset / length),
        rotation_axis_camera=Line(
            axis_pivot + shift + 7.0 * turn.apply(axis.direction), unit(turn.apply(axis.direction))
        ),
    )
    found = {e.name: e for e in system_errors(truth, replace(estimate, covariance=covariance))}
    assert {n: e.error for n, e in found.items()} == pytest.approx({n: -v for n, v in change.items()}, rel=1e-3)
    assert [found[n].u for n in NAMES] == pytest.approx(range(1, 9))
    assert [found[n].group for n in NAMES] == ["camera"] + ["plane"] * 3 + ["axis"] * 4


def realisations(z, u=1.0):
    """Realisations with given errors (session, realisation, quantity) in units of the uncertainty."""
    names = [("axis", "axis_turn_x", "rad"), ("plane", "plane_offset", "mm"), ("features", "rod diameter", "mm")]
    return [
        verify.Realisation(
            s, r, tuple(QuantityError(*names[q], z[s, r, q] * u, u) for q in range(z.shape[2])), ("bend",), ""
        )
        for s in range(z.shape[0])
        for r in range(z.shape[1])
    ]


def test_coverage_of_right_and_of_too_small_uncertainties():
    z = np.random.default_rng(1).standard_normal((40, 25, 3))
    rows = verify.summarise(realisations(z)).rows
    pooled = rows[0]
    assert (pooled.group, pooled.n) == ("all", 3000)
    assert pooled.coverage == pytest.approx(0.95, abs=0.012)
    assert pooled.u_coverage == pytest.approx(math.sqrt(0.95 * 0.05 / 3000), rel=0.4)
    assert pooled.rms_standardised == pytest.approx(1.0, abs=0.04)
    assert pooled.noise_share == pytest.approx(1.0, abs=0.05)
    assert all(r.holds for r in rows)
    too_small = verify.summarise(realisations(1.5 * z)).rows[0]
    assert too_small.coverage == pytest.approx(0.809, abs=0.02)
    assert not too_small.holds
    too_large = verify.summarise(realisations(0.5 * z)).rows[0]
    assert too_large.coverage > 0.99
    assert not too_large.holds


def test_realisations_of_a_session_that_err_alike_count_once():
    per_session = np.random.default_rng(2).standard_normal((60, 1, 3))
    rows = verify.summarise(realisations(np.repeat(per_session, 10, axis=1))).rows
    once = verify.summarise(realisations(per_session)).rows
    assert rows[0].coverage == pytest.approx(once[0].coverage)
    assert rows[0].u_coverage == pytest.approx(once[0].u_coverage)
    assert rows[0].noise_share == pytest.approx(0.0, abs=1e-12)


def test_quantities_have_rows_of_their_own_and_failures_are_told():
    z = np.zeros((2, 2, 3))
    z[:, :, 1] = 3.0
    failed = verify.Realisation(1, 9, (), (), "no stripe")
    result = verify.summarise([*realisations(z, u=0.002), failed])
    by_name = {(r.group, r.name): r for r in result.rows}
    plane = by_name["plane", "plane_offset"]
    assert (plane.coverage, plane.mean_u, plane.rms_error) == (0.0, 0.002, pytest.approx(0.006))
    assert plane.mean_standardised == pytest.approx(3.0)
    assert by_name["axis", ""].coverage == 1.0
    assert by_name["all", ""].coverage == pytest.approx(2 / 3)
    assert result.failures == ("session 1, noise 9: no stripe",)
    assert (result.n_realisations, result.n_sessions, result.optional) == (5, 2, {"bend": 4})


def test_realisations_are_spread_evenly_over_sessions(monkeypatch):
    monkeypatch.setattr(
        verify,
        "session_errors",
        lambda unit: tuple(verify.Realisation(unit.session, seed, (), (), "not tried") for seed in unit.noise_seeds),
    )
    result = verify.verify_uncertainty(50, WorkPlan(1, None, Silent()))
    sessions = [int(text.split(",")[0].split()[1]) for text in result.failures]
    assert result.n_sessions == 20
    assert sorted(np.bincount(sessions)) == [2] * 10 + [3] * 10
    assert len({text.split(":")[0].split()[-1] for text in result.failures}) == 50


def test_sessions_differ_in_table_and_plates_and_have_a_thin_line():
    a, b = verify.article_session(0).tables, verify.article_session(1).tables
    assert a.turntable.run_out_phase_deg != b.turntable.run_out_phase_deg
    seeds = {t.print_seed for tables in (a, b) for t in tables.targets.values()}
    assert len(seeds) == 4
    assert a.laser.line_width_mm == verify.LINE_WIDTH_MM
    light = a.laser.line_width_mm * a.light.exposure_on_ms
    assert light == pytest.approx(0.3 * 10.0)
    assert {c.step_deg for c in a.captures if c.role in ("artifact", "scan")} == {verify.STEP_DEG}


@pytest.fixture(scope="module")
def small_twin():
    return trace_twin(RIG, PLAN, spacing_px=4.0)


def test_a_realisation_has_all_errors_within_their_uncertainty(small_twin, monkeypatch):
    monkeypatch.setattr(verify, "_traced", lambda session: small_twin)
    (found,) = verify.session_errors(verify.SessionUnit(3, (5,)))
    assert found.failure == ""
    assert (found.session, found.noise_seed) == (3, 5)
    groups = [e.group for e in found.errors]
    assert [groups.count(g) for g in ("plane", "axis", "features")] == [3, 4, 1]
    assert max(abs(e.standardised) for e in found.errors) < 4.0
    # errors are not zero, and uncertainties not huge: the ball is known to some um
    assert found.errors[-1].name == "ball diameter"
    assert 0.0001 < found.errors[-1].u < 0.01


def test_the_bound_is_near_the_stated_variances(small_twin):
    """The estimate learns the size of the noise to a few per cent; for errors of the table that it cannot exclude, the axis pays."""
    observations = small_twin.observed(verify.TARGET_PX, verify.STRIPE_PX, 4).observations
    parts = verify.calibrate_observations(observations, verify.JOINT_OPTIONS)
    bound = efficiency.information_bound(observations, efficiency.joint_start(parts, observations), parts.joint)
    stated = parts.joint.covariance
    assert bound.names == stated.names[: len(bound.names)]
    assert bound.names[-7:] == NAMES[1:]
    ratio = np.diag(stated.matrix)[: len(bound.names)] / np.diag(bound.matrix)
    assert np.all((ratio[:-4] > 0.95) & (ratio[:-4] < 1.1))  # camera and plane
    assert np.all((ratio[-4:] > 0.95) & (ratio[-4:] < 2.0))
    assert 0.5 < bound.used_fraction <= 1.0


def test_efficiency_is_the_ratio_of_variances():
    rng = np.random.default_rng(3)
    matrix = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.3], [0.0, 0.3, 1e-6 + 0.2]])
    errors = rng.multivariate_normal(np.zeros(3), 1.2 * matrix, size=4000)
    names = ("fx", "plane_offset", "axis_shift_x")
    pieces = [
        efficiency.SystemErrors(("camera", "plane", "axis"), names, part, ()) for part in np.array_split(errors, 7)
    ]
    order = [2, 0, 1]
    bound = efficiency.Bound(tuple(names[i] for i in order), matrix[np.ix_(order, order)], 1.0)
    rows = efficiency.efficiency_rows("Gaussian", pieces, bound, bar=1.1)
    assert [(r.group, r.n, r.p) for r in rows] == [
        ("all", 4000, 3), ("camera", 4000, 1), ("plane", 4000, 1), ("axis", 4000, 1)
    ]  # fmt: skip
    assert all(abs(r.ratio - 1.2) < 4 * 1.2 * r.u_ratio for r in rows)
    assert not rows[0].holds
    assert all(r.bias < 3.0 for r in rows)
    biased = [replace(p, errors=p.errors + np.array([0.5, 0.0, 0.0])) for p in pieces]
    assert efficiency.efficiency_rows("Gaussian", biased, bound, bar=1.1)[1].bias > 10.0


def test_nothing_is_wrong_in_the_ideal_session():
    tables = efficiency.ideal_session().tables
    turntable = tables.turntable
    errors = (turntable.angle_noise_deg, turntable.angle_eccentricity_deg, turntable.run_out_um)
    assert (*errors, turntable.run_out_noise_um, turntable.wobble_urad) == (0, 0, 0, 0, 0)
    assert all(t.print_offset_um == 0 for t in tables.targets.values())
