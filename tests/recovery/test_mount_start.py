"""Where artefacts stand, from the stripes of a few frames: every kind, any sense, inclined sheets, with what else is on the table."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.mount_start import start_from_artifact, start_mounts
from rotaline.calibration.observations import MountObservation
from rotaline.errors import CalibrationError
from rotaline.geometry.primitives import KnownCylinder, KnownSphere, Line, Plane, SteppedCylinder, unit
from rotaline.geometry.transforms import base_from_axis
from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.shapes import Ball, Block, Rod, SteppedRod
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import Rig, build_rig

STEPPED = SteppedCylinder(23.051, 36.006, 22.003, 25.005)
ARTIFACTS = {
    "stepped": (SteppedRod(STEPPED), STEPPED, 0.0),
    "ball": (Ball(28.475), KnownSphere(28.475), 28.475 / 2),
    "rod": (Rod(38.004, 40.0), KnownCylinder(38.004, 40.0), 0.0),
}


def _rolled(rig: Rig, angle_deg: float) -> Rig:
    """The sheet of light turned about its beam."""
    laser = rig.laser
    normal = Rotation.from_rotvec(np.radians(angle_deg) * laser.beam_base).apply(laser.plane_base.normal)
    return replace(rig, laser=replace(laser, plane_base=Plane(normal, -float(normal @ laser.position_base))))


RIGS = {
    "article": build_rig((640, 480)),
    "other side and sense, rolled camera": build_rig((640, 480), camera_side=1, turn_sense=-1, roll_deg=90.0),
    "sheet at 45 deg": _rolled(build_rig((640, 480)), 45.0),
    "sheet at -45 deg": _rolled(build_rig((640, 480), turn_sense=-1), -45.0),
}
POSES = {"centred": mount(0.3, -0.2), "8 mm off, leaning": mount(6.0, -5.3, tilt_deg=1.0, tilt_towards_deg=50.0)}


def _observed(rig, parts, artifact, *, name="m", n=12, seed=1, sigma_px=0.2, **noise):
    angles_deg = tuple(360.0 * i / n for i in range(n))
    scan = trace_scan(rig, parts, angles_deg, spacing_px=2.0)
    names = tuple(f"{name}/{i}.png" for i in range(n))
    return MountObservation(name, artifact, names, scan.angles_rad, scan.observed(sigma_px, seed, **noise))


def _start(rig, *mounts):
    return start_mounts(rig.camera, rig.laser_plane_camera, rig.rotation_axis_camera, rig.turn_sense, mounts)


def _errors(rig, start, table_from_part, low_mm, high_mm, axis=None):
    """Largest distance of two points of the artefact's axis from where they are, and the angle between both axes."""
    truth = base_from_axis(axis or rig.rotation_axis_camera) * rig.camera_from_base * table_from_part
    ends = np.array([[0.0, 0.0, low_mm], [0.0, 0.0, high_mm]])
    shift = ends - [0.0, 0.0, low_mm if low_mm == high_mm else 0.0]
    gap_mm = float(np.linalg.norm(start.table_from_part.apply(shift) - truth.apply(ends), axis=1).max())
    cosine = start.table_from_part.rotation.as_matrix()[:, 2] @ truth.rotation.as_matrix()[:, 2]
    return gap_mm, float(np.degrees(np.arccos(min(cosine, 1.0))))


@pytest.mark.parametrize("kind", ARTIFACTS)
@pytest.mark.parametrize(
    ("where", "table_seen"), [("centred", True), ("8 mm off, leaning", True), ("8 mm off, leaning", False)]
)
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_twelve_frames_show_where_an_artefact_stands(rig, where, kind, table_seen):
    pose, (shape, artifact, centre_mm) = POSES[where], ARTIFACTS[kind]
    parts = [Placed(shape, pose), *([table_disc(rig)] if table_seen else [])]
    starts, warnings = _start(rig, _observed(rig, parts, artifact))
    assert warnings == ()
    assert starts[0].name == "m"
    gap_mm, tilt_deg = _errors(rig, starts[0], pose, centre_mm, centre_mm or 40.0)
    assert gap_mm < 0.1
    assert kind == "ball" or tilt_deg < 0.1


@pytest.mark.parametrize("kind", ARTIFACTS)
def test_what_holds_the_artefact_and_stray_light_do_not_count(kind):
    rig, pose = RIGS["article"], POSES["8 mm off, leaning"]
    shape, artifact, centre_mm = ARTIFACTS[kind]
    stand = Placed(Block(44.0, 30.0, 6.0), mount(6.0, -5.3))
    raised = pose * RigidTransform.from_translation([0.0, 0.0, 7.0])
    mount_seen = _observed(
        rig, [Placed(shape, raised), stand, table_disc(rig)], artifact, outlier_fraction=0.2, outlier_px=400.0
    )
    starts, warnings = _start(rig, mount_seen)
    assert warnings == ()
    assert _errors(rig, starts[0], raised, centre_mm, centre_mm or 40.0)[0] < 0.1


def test_a_cylinder_without_a_stated_height_stands_where_its_side_begins():
    rig, pose = RIGS["article"], POSES["8 mm off, leaning"]
    parts = [Placed(Rod(38.004, 40.0), pose), table_disc(rig)]
    starts, _ = _start(rig, _observed(rig, parts, KnownCylinder(38.004)))
    truth = base_from_axis(rig.rotation_axis_camera) * rig.camera_from_base * pose
    bottom = truth.inv().apply(starts[0].table_from_part.apply(np.zeros(3)))
    assert np.hypot(*bottom[:2]) < 0.1
    assert 0.0 < bottom[2] < 2.0  # the lowest stripe point is a few pixels above the edge
    assert _errors(rig, starts[0], pose, 0.0, 0.0)[1] < 0.1


def test_a_poor_axis_still_gives_a_start():
    """Half a millimetre and half a degree off: the artefact then seems to stand elsewhere by about as much."""
    rig, pose = RIGS["article"], POSES["8 mm off, leaning"]
    axis = rig.rotation_axis_camera
    poor = Line(axis.point + np.array([0.5, 0.0, 0.5]), unit(axis.direction + 0.01 * np.array([0.7, 0.1, 0.6])))
    for kind, (shape, artifact, centre_mm) in ARTIFACTS.items():
        seen = _observed(rig, [Placed(shape, pose), table_disc(rig)], artifact)
        starts, warnings = start_mounts(rig.camera, rig.laser_plane_camera, poor, rig.turn_sense, [seen])
        assert warnings == (), kind
        assert _errors(rig, starts[0], pose, centre_mm, centre_mm or 40.0, poor)[0] < 1.5, kind


def test_mounts_that_are_not_found_are_named_with_what_to_do():
    rig, pose = RIGS["sheet at 45 deg"], POSES["8 mm off, leaning"]
    parts = [Placed(SteppedRod(STEPPED), pose), table_disc(rig)]
    good = _observed(rig, parts, STEPPED, name="good")
    other = _observed(rig, parts, SteppedCylinder(11.5, 18.0, 22.003, 25.005), name="other")
    back = replace(good, name="back", angles_rad=-good.angles_rad)
    few = replace(
        good, name="few", angles_rad=good.angles_rad[:3], stripes=good.stripes[:3], frame_names=("a", "b", "c")
    )
    dark = replace(good, name="dark", stripes=tuple(s.select(np.zeros(len(s), dtype=bool)) for s in good.stripes))
    starts, warnings = _start(rig, other, good, back, few, dark)
    assert [start.name for start in starts] == ["good"]
    assert [warning.split(":")[0] for warning in warnings] == ["other", "back", "few", "dark"]
    assert "the right artefact with its sizes" in warnings[0]
    assert "turned the other way" in warnings[1]
    assert "in 3 frames; at least" in warnings[2]
    assert "there are 0 stripe points in 0 frames" in warnings[3]


def test_stepped_cylinders_alone_give_a_start_axis():
    rig = RIGS["other side and sense, rolled camera"]
    seen = [
        _observed(rig, [Placed(SteppedRod(STEPPED), pose), table_disc(rig)], STEPPED, name=str(k), sigma_px=0.1)
        for k, pose in enumerate([mount(0.3, -0.2), mount(4.0, -3.3, tilt_deg=0.3)])
    ]
    ball = _observed(rig, [Placed(Ball(28.475), mount(1.0, 0.0))], KnownSphere(28.475), name="ball")
    axis, sense = start_from_artifact(rig.camera, rig.laser_plane_camera, [ball, *seen], rig.turn_sense)
    truth = rig.rotation_axis_camera
    assert sense == rig.turn_sense
    assert truth.distance_to(axis.point[None])[0] < 0.1
    assert np.degrees(np.arccos(min(axis.direction @ truth.direction, 1.0))) < 0.2
    starts, warnings = start_mounts(rig.camera, rig.laser_plane_camera, axis, sense, [ball, *seen])
    assert (len(starts), warnings) == (3, ())
    with pytest.raises(CalibrationError, match="Add an axis capture"):
        start_from_artifact(rig.camera, rig.laser_plane_camera, [ball], rig.turn_sense)
