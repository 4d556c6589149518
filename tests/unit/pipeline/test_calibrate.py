"""Both ways of calibrating, on observations of the twin; the joint estimate is replaced where only its place in the whole matters."""

from dataclasses import fields, replace
from typing import ClassVar

import numpy as np
import pytest

from rotaline.calibration.artifact import SENSE_ASSUMED
from rotaline.calibration.joint.model import EstimatedQuantity, JointCalibration, JointMount, ResidualGroup
from rotaline.calibration.model import AngleError, SystemCovariance, TableMotion
from rotaline.calibration.observations import SessionObservations
from rotaline.errors import CalibrationError
from rotaline.geometry.primitives import KnownSphere, Line, SheetCurvature
from rotaline.pipeline import calibrate_joint
from rotaline.pipeline.calibrate import calibrate_observations
from rotaline.pipeline.calibrate_article import axis_disagreement
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.options import CalibrationOptions, Options
from rotaline.pipeline.quality import quality_figures
from rotaline.pipeline.stage_runner import StageRunner, StoredStageRunner
from rotaline.pipeline.store import StageStore
from rotaline.pipeline.twin import trace_twin
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import small_plan

UP = np.array([0.0, -1.0, 0.0])
RIG = build_rig((640, 480), turn_sense=-1)
ARTICLE, JOINT = (Options(calibration=CalibrationOptions(method)) for method in ("article", "joint"))


@pytest.fixture(scope="module")
def seen():
    return trace_twin(RIG, small_plan(RIG), spacing_px=2.0).observed(0.02, 0.05, 1).observations


class NotingRunner(StageRunner):
    """Keeps what a user would see."""

    def __init__(self):
        super().__init__()
        self.notes = []

    def note(self, text):
        self.notes.append(text)


def joint_of(observations, start, options):
    """What a joint estimate could return: the start with all that only it can know."""
    names = (
        "fx",
        "plane_turn_1",
        "plane_turn_2",
        "plane_offset",
        *(f"axis_{k}" for k in ("turn_x", "turn_y", "shift_x", "shift_y")),
    )
    u = np.array([0.5, 2e-5, 1e-5, 8e-4, 3e-5, 2e-5, 1e-3, 2e-3])
    zero = np.zeros(3)
    mounts = tuple(
        JointMount(
            m.name, observations.mounts[0].artifact, m.table_from_part, 5.0, 0.001, 0.0, ("a/1",), np.zeros(1),
            np.zeros(2, dtype=int), np.zeros(2, dtype=int), np.zeros((2, 3)), np.zeros(2), np.zeros(2), np.array([1.0, 0.0]),
            ("large side",), np.array([0.0001]), np.array([0.0052]), np.nan,
        )
        for m in start.mounts
    )  # fmt: skip
    return JointCalibration(
        camera=replace(start.camera.camera, fx=1500.0),
        camera_names=("fx",),
        laser_plane_camera=start.plane_camera,
        laser_curvature=SheetCurvature(zero, (1e-6, 0.0, 0.0)),
        axis_camera=start.axis_camera,
        turn_sense=start.turn_sense,
        angle_error=AngleError(1e-4, 0.0),
        covariance=SystemCovariance(names, np.diag(u**2), zero, zero),
        parameters=(EstimatedQuantity("fx", 1500.0, 0.5, "px", "image"),),
        groups=tuple(
            ResidualGroup("target", name, (), 0.02, rms, 0.02, 1.0, n, n)
            for name, rms, n in (("camera", 0.03, 100), ("laser", 0.05, 300))
        ),
        mounts=mounts,
        table=None,
        optional=(),
        weak_directions=(),
        n_parameters=8,
        n_observations=400,
        n_iterations=3,
        converged=True,
        seconds=1.0,
        warnings=("something to know",),
        table_motion=TableMotion((2e-3, 0.0), (0.0, 3e-5), zero),
    )


def test_the_article_s_way_finds_the_rig_and_keeps_what_it_saw(seen):
    parts = calibrate_observations(seen, ARTICLE)
    assert parts.warnings == ()
    assert parts.joint is None
    assert parts.cross_ratio is not None
    assert parts.artifact is not None
    assert parts.system.turn_sense == -1
    true = RIG.rotation_axis_camera
    off_mm = [
        float(s.rotation_axis_camera.distance_to(true.point[None])[0]) for s in (parts.system, parts.system_initial)
    ]
    assert max(off_mm) < 0.3
    assert parts.observations.plate_views == seen.plate_views
    assert parts.observations.mounts == seen.mounts
    assert parts.observations.roles == seen.roles == {"camera", "laser-plane", "axis", "artifact"}


def test_the_joint_estimate_starts_from_the_stages_and_ends_the_calibration(seen, monkeypatch):
    starts = []
    monkeypatch.setattr(calibrate_joint, "estimate_jointly", lambda *given: starts.append(given[1]) or joint_of(*given))
    runner = NotingRunner()
    parts = calibrate_observations(seen, JOINT, runner)
    (start,) = starts
    assert start.turn_sense == -1
    (mount,) = start.mounts
    assert np.hypot(*mount.table_from_part.translation[:2]) == pytest.approx(np.hypot(4.1, 2.9), abs=0.3)
    assert parts.cross_ratio is None
    assert parts.artifact is None
    system, joint = parts.system, parts.joint
    assert system.camera.fx == parts.camera_model.fx == 1500.0
    assert (system.covariance, system.laser_curvature) == (joint.covariance, joint.laser_curvature)
    assert system.angle_error == AngleError(1e-4, 0.0)
    assert system.table_motion is joint.table_motion is not None
    assert parts.system_initial.camera == parts.camera.camera
    assert parts.system_initial.covariance is None
    assert [(w.stage, w.text, w.serious) for w in parts.warnings] == [("joint", "something to know", False)]
    assert runner.notes[-2:] == ["RMS targets 0.046 px", "stepped: large side 0.0052 mm RMS"]
    figures = quality_figures(parts)["joint"]
    assert figures["parameters"]["fx"] == {"value": 1500.0, "u": 0.5, "unit": "px", "frame": "image"}
    assert figures["mounts"]["stepped"]["rms_mm"] == {"large side": 0.0052}
    assert figures["mounts"]["stepped"]["n_points_used"] == 1


def test_the_whole_joint_way_finds_the_rig_as_well_as_it_says(seen):
    parts = calibrate_observations(seen, JOINT)
    assert [w for w in parts.warnings if w.serious] == []
    covariance = parts.system.covariance
    pivot = parts.system.rotation_axis_camera.closest_to(covariance.axis_pivot_camera[None])
    rows = [covariance.names.index(name) for name in ("axis_shift_x", "axis_shift_y")]
    u_mm = float(np.sqrt(np.linalg.eigvalsh(covariance.matrix[np.ix_(rows, rows)])[-1]))
    assert RIG.rotation_axis_camera.distance_to(pivot)[0] < 4 * u_mm < 0.5
    assert {g["name"] for g in quality_figures(parts)["joint"]["groups"]} >= {"camera", "laser", "axis", "stepped"}


def test_where_the_joint_estimate_fails_the_stages_before_it_count(seen, monkeypatch):
    def fail(*given):
        raise CalibrationError("no way")

    monkeypatch.setattr(calibrate_joint, "estimate_jointly", fail)
    parts = calibrate_observations(seen, JOINT)
    assert [(w.stage, w.text, w.serious) for w in parts.warnings] == [("joint", "no way", True)]
    assert parts.joint is None
    assert parts.system is parts.system_initial
    assert parts.system.rotation_axis_camera is parts.axis.axis_camera
    assert parts.plane_camera is parts.laser_plane.plane_camera


@pytest.mark.parametrize("options", [ARTICLE, JOINT], ids=["article", "joint"])
def test_without_a_target_on_the_table_the_artefact_gives_the_axis(options, seen, monkeypatch):
    monkeypatch.setattr(calibrate_joint, "estimate_jointly", joint_of)
    options = replace(options, artifact=replace(options.artifact, assumed_turn_sense=-1))
    parts = calibrate_observations(replace(seen, table_views=()), options)
    assert SENSE_ASSUMED in [w.text for w in parts.warnings]
    assert parts.axis is None
    true = RIG.rotation_axis_camera
    assert parts.system.turn_sense == -1
    assert float(parts.system.rotation_axis_camera.distance_to(true.point[None])[0]) < 1.0


def test_parts_that_are_not_there_are_left_out(seen, monkeypatch):
    monkeypatch.setattr(calibrate_joint, "estimate_jointly", joint_of)
    flat = replace(seen, table_views=(), mounts=())
    for options in (ARTICLE, JOINT):
        parts = calibrate_observations(flat, options)
        assert parts.laser_plane is not None
        assert parts.plane_camera is not None
        assert parts.system is parts.system_initial is None
    nothing = calibrate_observations(replace(seen, camera_views=()))
    assert [(w.stage, w.serious) for w in nothing.warnings] == [("camera", True)]
    assert "no capture with role 'camera'" in nothing.warnings[0].text
    assert nothing.camera is nothing.system is None


def test_other_artefacts_need_the_joint_estimate(seen):
    ball = replace(seen, mounts=(replace(seen.mounts[0], artifact=KnownSphere(20.0)),))
    parts = calibrate_observations(ball, ARTICLE)
    assert [(w.stage, w.serious) for w in parts.warnings] == [("artifact", True)]
    assert "stepped cylinder" in parts.warnings[0].text
    assert parts.system.rotation_axis_camera is parts.axis.axis_camera


class OneByOne(SessionObservations):
    """Of a session with every role; remembers which parts were asked for."""

    roles = frozenset({"camera", "laser-plane", "axis", "artifact"})
    asked: ClassVar[set[str]] = set()

    def __getattribute__(self, name):
        if name in ("camera_views", "plate_views", "table_views", "mounts"):
            object.__getattribute__(self, "asked").add(name)
        return super().__getattribute__(name)

    @staticmethod
    def of(observations, **changed):
        parts = {f.name: getattr(observations, f.name) for f in fields(observations)} | changed
        OneByOne.asked.clear()
        return OneByOne(**parts)


def test_what_no_stage_needs_is_not_looked_at(seen):
    source = OneByOne.of(seen, camera_views=seen.camera_views[:2])
    parts = calibrate_observations(source, ARTICLE)
    assert source.asked == {"camera_views"}
    assert [(w.stage, w.serious) for w in parts.warnings] == [("camera", True)]
    assert parts.observations.camera_views == seen.camera_views[:2]
    assert parts.observations.plate_views == ()


def test_a_role_in_which_nothing_was_seen_is_a_failure(seen):
    parts = calibrate_observations(OneByOne.of(seen, plate_views=()), ARTICLE)
    assert [(w.stage, w.serious) for w in parts.warnings] == [("laser-plane", True)]
    assert parts.system is None


class Listener(Silent):
    """Remembers which stages were done."""

    def __init__(self):
        self.done = []

    def stage(self, title, stored):
        if not stored:
            self.done.append(title)


def test_stages_are_done_again_only_if_what_they_need_has_changed(seen, tmp_path):
    inputs = {name: name for name in ("camera_views", "plate_views", "table_views", "mounts", "mounts/stepped")}

    def done(options, **changed):
        listener = Listener()
        runner = StoredStageRunner(StageStore(tmp_path, listener), listener)
        runner.keys.update(inputs | changed)
        calibrate_observations(seen, options, runner)
        return listener.done

    refined = ["Feature points in stepped", "Axis optimisation (stepped cylinder)"]
    plane = ["Laser plane", "Laser plane optimisation (cross-ratio)"]
    assert done(ARTICLE) == ["Camera", *plane, "Initial rotation axis", *refined]
    assert done(ARTICLE) == []
    other_axis = replace(ARTICLE, axis=replace(ARTICLE.axis, method="joint"))
    assert done(other_axis) == ["Initial rotation axis", *refined]
    assert done(other_axis, plate_views="others") == [*plane, *refined]
    weighted = replace(other_axis, artifact=replace(ARTICLE.artifact, method="least-squares"))
    assert done(weighted, plate_views="others") == refined[1:]


@pytest.mark.parametrize(
    ("moved_mm", "u_mm", "says"), [(0.05, 0.001, False), (0.5, 0.01, True), (0.5, 0.2, False), (8.0, 0.2, True)]
)
def test_an_initial_axis_that_the_artefact_contradicts_is_named(moved_mm, u_mm, says):
    initial = Line(np.array([0.0, 0.0, 300.0]), UP)
    final = Line(np.array([moved_mm, 5.0, 300.0]), UP)
    text = axis_disagreement(initial, final, u_mm)
    assert bool(text) == says
    assert not says or f"{moved_mm:.2f} mm" in text
