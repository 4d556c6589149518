"""The joint estimate on sessions of the twin: the truth comes back within its uncertainty, and what is planted is found.

The line of the laser is thin here: ideal stripes are centred on the middle of the sheet, whatever their width, and the estimate would
correct a broad line's for its width.
"""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.intrinsics import CameraOptions, calibrate_camera
from rotaline.calibration.joint.estimate import JointOptions, estimate_jointly
from rotaline.calibration.joint.model import JointStart
from rotaline.calibration.laser_plane import calibrate_laser_plane
from rotaline.calibration.mount_start import start_from_artifact, start_mounts
from rotaline.calibration.rotation_axis import AxisOptions, calibrate_axis
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import KnownCylinder, KnownSphere
from rotaline.pipeline.calibrate_joint import joint_system
from rotaline.pipeline.twin import trace_twin
from rotaline.pipeline.twin_errors import system_errors, truth_of
from rotaline.simulation.ideal.observed_session import IdealSession
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.shapes import Ball, Rod, SteppedRod
from rotaline.simulation.plan import (
    SessionPlan,
    axis_capture,
    camera_capture,
    full_turn,
    laser_capture,
    mount,
    scan_capture,
)
from rotaline.simulation.rig import Mechanics, build_rig
from rotaline.simulation.small_session import CHECKERBOARD, DOTS, STEPPED_CYLINDER

TARGET_PX, STRIPE_PX, SPACING_PX = 0.02, 0.05, 3.0
PLAIN = build_rig((640, 480))
RIG = replace(PLAIN, laser=replace(PLAIN.laser, sigma_mm=0.02, peak_e_per_ms=5000.0))
SHAPES = {
    "stepped": (SteppedRod(STEPPED_CYLINDER), STEPPED_CYLINDER),
    "rod": (Rod(38.004, 40.0), KnownCylinder(38.004)),
    "ball": (Ball(28.475), KnownSphere(28.475)),
}
MOUNTS = {
    "m1": ("stepped", mount(-4.1, 2.9, tilt_deg=0.05)),
    "m2": ("stepped", mount(6.0, 3.0, tilt_deg=0.02)),
    "centred": ("stepped", mount(0.05, -0.03)),
    "rod": ("rod", mount(4.0, 4.0, tilt_deg=0.1)),
    "ball": ("ball", mount(5.0, -2.0)),
}
FULL = ("camera", "laser", "axis", "m1", "m2")


def capture(rig, name, board=CHECKERBOARD, dots=DOTS, poses=6, frames=12):
    """The plan of one capture."""
    if name == "camera":
        return camera_capture(rig, board, "checkerboard", 10, 1)
    if name == "laser":
        return laser_capture(rig, dots, "dots", poses, 1)
    if name == "axis":
        return axis_capture(rig, board, "checkerboard", tuple(5.0 * i for i in range(9)))
    kind, pose = MOUNTS[name]
    return scan_capture(rig, SHAPES[kind][0], pose, full_turn(frames), folder=name, role="artifact", target=kind)


def twin(names, rig=RIG, spacing_px=SPACING_PX, **what):
    """A traced session of some captures."""
    targets = {"checkerboard": CHECKERBOARD, "dots": DOTS, **{k: a for k, (_, a) in SHAPES.items()}}
    plan = SessionPlan(targets, tuple(capture(rig, name, **what) for name in names))
    return trace_twin(rig, plan, spacing_px=spacing_px)


@pytest.fixture(autouse=True)
def shapes(request):
    """Checked in the clean session; the others go the same ways."""
    if request.node.originalname != "test_a_clean_session":
        request.getfixturevalue("shapes_unchecked")


@pytest.fixture(scope="module")
def parts():
    """Every capture of the plain rig by itself: sessions are put together of them."""
    return twin(("camera", "laser", "axis", *MOUNTS))


def put_together(parts, names=FULL, other=None):
    """A session of some captures, some of them from another twin."""
    sources = [other if other is not None and n in [c.folder for c in other.plan.captures] else parts for n in names]
    chosen = [(s, [c.folder for c in s.plan.captures].index(n)) for s, n in zip(sources, names, strict=True)]
    plan = replace(parts.plan, captures=tuple(s.plan.captures[i] for s, i in chosen))
    return replace(parts, plan=plan, ideal=IdealSession(tuple(s.ideal.captures[i] for s, i in chosen)))


def observe(session, seed=1, **noise):
    return session.observed(TARGET_PX, STRIPE_PX, seed, **noise).observations


def start_of(observations):
    """What the stages find."""
    camera = calibrate_camera(
        list(observations.camera_views), observations.image_size, CameraOptions(), observations.preferred_folders
    )

    def found(view):
        return replace(view, detection=camera.with_target_as_found(view.detection))

    plane = calibrate_laser_plane(camera.camera, [found(v) for v in observations.plate_views])
    axis = None
    line, sense, mounts = None, 1, ()
    if observations.table_views:
        axis = calibrate_axis(camera.camera, [found(v) for v in observations.table_views], AxisOptions(method="joint"))
        line, sense = axis.axis_camera, axis.turn_sense
    elif observations.mounts:
        line, sense = start_from_artifact(camera.camera, plane.plane_camera, observations.mounts, 1)
    if observations.mounts:
        mounts, warnings = start_mounts(camera.camera, plane.plane_camera, line, sense, observations.mounts)
        assert warnings == ()
    return JointStart(camera, plane, plane.plane_camera, axis, line, sense, mounts)


def estimate(observations, **options):
    return estimate_jointly(observations, start_of(observations), JointOptions(**options))


def errors(found, rig=RIG):
    """Errors in standard uncertainties, by name."""
    truth = truth_of(rig, SessionPlan({}, ()))
    return {e.name: e.standardised for e in system_errors(truth, joint_system(found))}


def assert_true(found, rig=RIG, without=()):
    """Every parameter within 4 of its standard uncertainties, all together as chance has it."""
    z = {name: v for name, v in errors(found, rig).items() if not name.startswith(without or ("-",))}
    assert max(np.abs(list(z.values()))) < 4.0, z
    assert 0.3 < np.sqrt(np.mean(np.square(list(z.values())))) < 2.0, z
    assert found.converged


def on(found):
    return {o.name for o in found.optional if o.on}


def optional(found, name):
    """Values and uncertainties of a group that is on."""
    (group,) = [o for o in found.optional if o.name == name]
    assert group.on, group.reason
    return np.array(list(group.values.values())), np.array(list(group.u.values()))


@pytest.fixture(scope="module")
def clean(parts):
    """Observations of a session without errors, and what they give."""
    observations = observe(put_together(parts))
    return observations, estimate(observations)


def assert_same(found, other, share=0.02):
    """Camera, plane and axis agree within a part of their uncertainties."""
    z = {e.name: abs(e.standardised) for e in system_errors(_as_truth(joint_system(found)), joint_system(other))}
    assert max(z.values()) < share, z
    before, after = (_uncertainties(f) for f in (found, other))
    assert [after[name] for name in z] == pytest.approx([before[name] for name in z], rel=10 * share)


def _uncertainties(found):
    return dict(zip(found.covariance.names, np.sqrt(np.diag(found.covariance.matrix)).tolist(), strict=True))


def _as_truth(system):
    truth = truth_of(RIG, SessionPlan({}, ()))
    return replace(
        truth,
        camera=system.camera,
        laser_plane_camera=system.laser_plane_camera,
        rotation_axis_camera=system.rotation_axis_camera,
        turn_sense=system.turn_sense,
    )


def test_a_clean_session(clean):
    """Truth within its uncertainties; nothing that is not there is found; surfaces without an offset; noise as it was."""
    _, found = clean
    assert_true(found)
    assert on(found) == set()
    assert found.turn_sense == 1
    for group in found.groups:
        sigma = TARGET_PX if "target" in group.kind and "stripe" not in group.kind else STRIPE_PX
        assert group.sigma_px == pytest.approx(sigma, rel=0.2), group.name
        assert group.n_used >= 0.99 * group.n_points
    for m, (_, pose) in zip(found.mounts, (MOUNTS["m1"], MOUNTS["m2"]), strict=True):
        counts = np.bincount(m.surface[m.used], minlength=4)
        assert (np.abs(m.mean_mm) < 4 * m.rms_mm / np.sqrt(counts)).all()
        where = np.hypot(*(pose.apply([0.0, 0.0, 23.5])[:2]))
        assert abs(m.eccentricity_mm - where) < 4 * m.u_eccentricity_mm
        assert m.held_out_rms_mm == pytest.approx(np.sqrt(np.mean(m.distances_mm[m.used] ** 2)), rel=0.1)
    assert found.table is not None
    assert (found.table.sigma < 4 * np.array([1e-4, 2e-3, 1e-3, 1e-4])).all()


def test_the_order_of_frames_and_the_sense_of_the_read_out_do_not_matter(clean):
    observations, found = clean
    rng = np.random.default_rng(4)

    def shuffled(values):
        return tuple(values[i] for i in rng.permutation(len(values)))

    def back(m):
        order = rng.permutation(len(m.stripes))
        names, stripes = (tuple(v[i] for i in order) for v in (m.frame_names, m.stripes))
        return replace(m, frame_names=names, stripes=stripes, angles_rad=-m.angles_rad[order])

    other = replace(
        observations,
        camera_views=shuffled(observations.camera_views),
        plate_views=shuffled(observations.plate_views),
        table_views=shuffled([replace(v, angle_rad=-v.angle_rad) for v in observations.table_views]),
        mounts=tuple(back(m) for m in observations.mounts),
    )
    turned = estimate(other)
    assert turned.turn_sense == -1
    assert_same(found, turned)


def test_another_rig(parts):
    """Camera on the other side of the laser, rolled; the table turns the other way."""
    plain = build_rig((640, 480), camera_side=1, turn_sense=-1, roll_deg=90.0)
    rig = replace(plain, laser=replace(plain.laser, sigma_mm=0.02, peak_e_per_ms=5000.0))
    found = estimate(observe(twin(FULL, rig), 3))
    assert found.turn_sense == -1
    assert_true(found, rig)


def test_outliers_hardly_matter(parts, clean):
    """3 % of the stripe points elsewhere, by as much as the stripe is off its neighbours."""
    found = estimate(observe(put_together(parts), outlier_fraction=0.03, outlier_px=5.0))
    assert_same(clean[1], found, share=0.5)
    for with_outliers, without in zip(found.groups, clean[1].groups, strict=True):
        if with_outliers.kind == "artifact":
            assert 0.96 < with_outliers.n_used / without.n_used < 0.985


def test_eccentricity_of_the_angle(parts):
    """The read-out errs by ``E sin(read + phase)``."""
    rig = replace(RIG, mechanics=Mechanics(angle_eccentricity_deg=0.06, angle_eccentricity_phase_deg=40.0))
    found = estimate(observe(put_together(parts, other=twin(("axis", "m1", "m2"), rig))))
    assert_true(found)
    assert on(found) == {"angle harmonics"}
    true = np.radians(0.06) * np.array([np.sin(np.radians(40.0)), np.cos(np.radians(40.0))])
    values, u = optional(found, "angle harmonics")
    assert (np.abs(values - true) < 4 * u).all()
    assert (u < 0.25 * np.radians(0.06)).all()
    assert (found.angle_error.cos_rad, found.angle_error.sin_rad) == pytest.approx(tuple(values))


def test_run_out(parts):
    """Half of it turns against the table: ``R / 2 (cos(a + phase), -sin(a + phase))``; the other half is taken for another place of what stands there."""
    rig = replace(RIG, mechanics=Mechanics(run_out_um=20.0, run_out_phase_deg=30.0))
    found = estimate(observe(put_together(parts, other=twin(("axis", "m1", "m2"), rig))))
    assert_true(found)
    assert on(found) == {"run-out once per turn"}
    camera = RIG.camera_from_base.inv().translation  # the base frame of a calibration has its x towards it
    direction = np.radians(-30.0) - np.arctan2(camera[1], camera[0])
    values, u = optional(found, "run-out once per turn")
    assert (np.abs(values - 0.01 * np.array([np.cos(direction), np.sin(direction)])) < 4 * u).all()
    assert (u < 0.003).all()


def test_errors_of_the_table_from_frame_to_frame(parts):
    """Their standard deviations, and they are no errors once per turn."""
    rig = replace(RIG, mechanics=Mechanics(angle_noise_deg=0.02, run_out_noise_um=5.0))
    found = estimate(observe(put_together(parts, other=twin(("axis", "m1", "m2"), rig))), print_errors=False)
    assert_true(found)
    assert on(found) == set()
    for k, true in enumerate((np.radians(0.02), 0.005)):
        assert abs(found.table.sigma[k] - true) < 4 * found.table.u_sigma[k]
        assert found.table.sigma[k] > 3 * found.table.u_sigma[k]
    assert (found.table.sigma[2:] < [2e-3, 1e-4]).all()  # it neither lifts nor wobbles


def _with_uncertain_angles(observations, sigma_deg, stated):
    """The angles of mount m2 with noise; with what is stated of all angles."""
    rng = np.random.default_rng(12)
    least, sigma = np.radians([1e-4, sigma_deg])
    mounts = []
    for m in observations.mounts:
        poor = m.name == "m2"
        angles = m.angles_rad + poor * sigma * rng.standard_normal(len(m.angles_rad))
        u = np.full(len(angles), sigma if poor else least)
        mounts.append(replace(m, angles_rad=angles, u_angles_rad=u if stated else None))
    table = tuple(replace(v, u_angle_rad=least if stated else 0.0) for v in observations.table_views)
    return replace(observations, mounts=tuple(mounts), table_views=table)


def test_angles_that_are_stated_to_be_less_certain(parts):
    """The noise of one capture's angles costs the others nothing: the axis stays where it is without that noise."""
    observations = observe(put_together(parts), seed=3)
    exact = estimate(observations)
    stated, unknown = (estimate(_with_uncertain_angles(observations, 0.1, stated=s)) for s in (True, False))
    assert_true(stated)
    assert stated.table.sigma[0] == pytest.approx(exact.table.sigma[0], rel=0.1)
    moved = {f: [abs(errors(f)[n] - errors(exact)[n]) for n in errors(exact)] for f in (stated, unknown)}
    assert max(moved[stated]) < 0.05
    assert max(moved[unknown]) > 3.0 * max(moved[stated])


def test_angles_that_are_stated_alike_change_nothing(clean):
    observations, found = clean
    u = np.radians(0.02)
    mounts = tuple(replace(m, u_angles_rad=np.full(len(m.angles_rad), u)) for m in observations.mounts)
    table = tuple(replace(v, u_angle_rad=u) for v in observations.table_views)
    other = estimate(replace(observations, mounts=mounts, table_views=table))
    assert (other.covariance.matrix == found.covariance.matrix).all()


def test_a_bowed_sheet(parts):
    """The ends of the fan, 137 mm to both sides at the waist, sag by 0.15 mm."""
    rig = replace(RIG, laser=replace(RIG.laser, bow_mm=0.15))
    found = estimate(observe(put_together(parts, other=twin(("laser", "m1", "m2"), rig))))
    assert on(found) == {"sheet curvature"}
    assert found.laser_curvature is not None
    laser = RIG.laser
    normal, beam = (RIG.camera_from_base.rotation.apply(v) for v in (laser.plane_base.normal, laser.beam_base))
    side = np.sign(normal @ found.laser_plane_camera.normal)
    p, q = np.stack(across(found.laser_plane_camera.normal)) @ np.cross(normal, beam)
    row = np.array([p * p, 2 * p * q, q * q])  # curvature along the fan
    sag = -side * float(
        row @ found.laser_curvature.coefficients
    )  # the function that is 0 on the sheet falls where the sheet rises
    first = found.covariance.names.index("curvature_uu")
    u = float(np.sqrt(row @ found.covariance.matrix[first : first + 3, first : first + 3] @ row))
    assert abs(sag - 2 * 0.15 / (laser.waist_mm * np.radians(laser.fan_deg / 2)) ** 2) < 4 * u
    assert sag > 6 * u
    z = errors(found)
    assert max(abs(v) for k, v in z.items() if not k.startswith("plane")) < 4.0  # the plane touches the sheet elsewhere


def test_a_wrong_pitch_of_the_target_in_the_sheet(parts):
    other = twin(("laser",), dots=Plate(DOTS, pitch_error=1e-3), poses=12)
    found = estimate(observe(put_together(parts, other=other)))
    assert_true(found)
    assert on(found) == {"pitch of dots 9 x 9"}
    values, u = optional(found, "pitch of dots 9 x 9")
    assert abs(values[0] - 1e-3) < 4 * u[0]
    assert u[0] < 1e-4


def test_a_bent_target_in_the_sheet(parts):
    """A paraboloid: x^2 and y^2 alike, 0.15 mm at the corners of the plate, whose print is smaller."""
    plate = Plate(DOTS, flatness_um=150.0)
    found = estimate(observe(put_together(parts, other=twin(("laser",), dots=plate))))
    assert_true(found)
    assert on(found) == {"bend of dots 9 x 9"}
    (xx, xy, yy), u = optional(found, "bend of dots 9 x 9")
    points = DOTS.points_board()[:, :2]
    height = plate.heights(points)[0] - plate.heights(points.mean(axis=0, keepdims=True))[0]
    assert [xx, xy, yy] == pytest.approx([height, 0.0, height], abs=4 * u.max())


def test_sizes_of_the_artefact_within_their_tolerance(clean):
    """Stated 20 and 30 um off, known to 50 um: the other sizes and the pitch of the targets tell."""
    observations, sure = clean
    stated = replace(STEPPED_CYLINDER, diameter_large=36.026, height_small=21.973, tolerance=0.05)
    found = estimate(replace(observations, mounts=tuple(replace(m, artifact=stated) for m in observations.mounts)))
    assert_true(found)
    sizes = found.mounts[0].artifact
    for name in ("diameter_small", "diameter_large", "height_small"):
        assert getattr(sizes, name) == pytest.approx(getattr(STEPPED_CYLINDER, name), abs=0.012), name
    assert found.mounts[1].artifact == sizes
    scale = "scale of radii"
    assert _u_of(found, scale) > _u_of(sure, scale)


def _u_of(found, quantity):
    return next(w.u for w in found.weak_directions if w.quantity == quantity)


def test_noise_that_neighbours_share_is_in_the_uncertainty(parts):
    """Errors of plane and axis over stated uncertainty, in several realisations; taken for independent, points would be worth twice too much."""
    session = put_together(parts, FULL[:4])
    z, lengths = [], []
    for seed in range(6):
        observations = observe(session, 20 + seed, correlated_px=0.1, correlation_px=12.0)
        found = estimate(observations, optional_parameters=False, print_errors=False)
        z.append([v for k, v in errors(found).items() if k.startswith(("plane", "axis"))])
        lengths.append(next(g.correlation_length for g in found.groups if g.kind == "artifact"))
    memory = np.exp(-SPACING_PX / 12.0)
    assert np.mean(lengths) == pytest.approx(1 + 0.8 * 2 * memory / (1 - memory), rel=0.25)
    assert 0.65 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_frame_whose_table_stood_elsewhere_and_a_bad_view(clean):
    observations, found = clean
    first, second = observations.mounts
    angles = first.angles_rad.copy()
    angles[5] += np.radians(3.0)
    views = list(observations.camera_views)
    bad = views[3].detection
    shift = 3.0 * np.sin(np.arange(len(bad.uv)))[:, None] * [1.0, -0.5]
    views[3] = replace(views[3], detection=replace(bad, uv=bad.uv + shift))
    other = estimate(
        replace(observations, camera_views=tuple(views), mounts=(replace(first, angles_rad=angles), second))
    )
    z = errors(other)
    assert max(np.abs(list(z.values()))) < 4.0, z
    assert other.table is not None
    without = errors(found)
    assert max(abs(z[name] - without[name]) for name in z) < 0.5  # a wrong frame and a bad view hardly move anything
    before, after = _uncertainties(found), _uncertainties(other)
    assert np.median([after[name] / before[name] for name in z]) < 2.0


_WAYS = {
    "without an artefact": ("camera", "laser", "axis"),
    "a sphere": ("camera", "laser", "axis", "ball"),
    "a cylinder of unknown height": ("camera", "laser", "axis", "rod"),
}


@pytest.mark.parametrize("names", _WAYS.values(), ids=_WAYS.keys())
def test_ways_to_calibrate(parts, names):
    found = estimate(observe(put_together(parts, names)))
    assert_true(found)
    assert [m.name for m in found.mounts] == [n for n in names if n in MOUNTS]
    assert on(found) == set()


def test_without_a_target_on_the_table(parts):
    """Feature points of the stepped cylinder need denser stripes to begin with."""
    dense = twin(("m1",), spacing_px=1.0, frames=12)
    found = estimate(observe(put_together(parts, ("camera", "laser", "m1"), dense)))
    assert_true(found)
    assert not [g for g in found.groups if g.kind == "table-target"]


def test_without_a_table(parts):
    found = estimate(observe(put_together(parts, ("camera", "laser"))))
    assert found.axis_camera is None
    assert found.table is None
    assert found.mounts == ()
    assert [n for n in found.covariance.names if n.startswith("axis")] == []
    truth = truth_of(RIG, SessionPlan({}, ()))
    for name in ("fx", "fy", "cx", "cy"):
        (quantity,) = [q for q in found.parameters if q.name == name]
        assert abs(quantity.value - getattr(truth.camera, name)) < 4 * quantity.u


def test_a_centred_mount_alone_leaves_the_axis_open(parts):
    """Without a target on the table: a rod that turns about itself looks the same at all angles, wherever the sheet passes the axis."""
    observations = observe(put_together(parts, ("camera", "laser", "axis", "centred", "m2")))
    start = replace(start_of(observations), axis=None)
    first = replace(observations, mounts=observations.mounts[:1])
    alone = estimate_jointly(first, replace(start, mounts=start.mounts[:1]))
    both = estimate_jointly(observations, start)
    quantity = "axis position across the laser plane"
    (weak,) = [w for w in alone.weak_directions if w.quantity == quantity]
    assert "too well centred (at most 0.1 mm off)" in weak.text
    assert f"uncertain by {weak.u * 1e3:.2g} um" in weak.text
    (known,) = [w for w in both.weak_directions if w.quantity == quantity]
    assert weak.u > 5 * known.u
    assert_true(both)
