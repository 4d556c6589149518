"""Which stages a session allows."""

from pathlib import Path

import pytest

from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.frame_images import ImageFile
from rotaline.io.session import Capture, Frame, Session
from rotaline.io.session_file import MeasurementRequest
from rotaline.pipeline.stages import planned_stages
from rotaline.vision.targets.model import Checkerboard, DotGrid

BOARD, DOTS = Checkerboard((9, 6), 5.0), DotGrid((9, 9), 6.0)
STEPPED, ROD, BALL = SteppedCylinder(20.0, 30.0, 15.0, 16.0), KnownCylinder(38.0), KnownSphere(28.0)


def _capture(folder, role, target, n_on=0, n_off=0):
    frames = tuple(
        Frame(ImageFile(f"{i}.png"), f"{folder}/{i}.png", 0.1 * i, i < n_on, str(i % max(n_on, 1)))
        for i in range(n_on + n_off)
    )
    return Capture(folder, role, role, target, frames)


CAMERA = _capture("camera", "camera", BOARD, n_off=5)
LASER = _capture("laser", "laser-plane", DOTS, n_on=4, n_off=4)
AXIS = _capture("axis", "axis", BOARD, n_off=9)


def _stages(*captures, measurements=()):
    session = Session(Path(), {}, captures, measurements, (64, 48))
    return {stage.name: (stage.possible, stage.text) for stage in planned_stages(session)}


def test_mounts_of_every_kind_are_named():
    artefacts = [
        _capture(f"a{i}", "artifact", target, n_on=9) for i, target in enumerate((STEPPED, STEPPED, BALL, ROD))
    ]
    stages = _stages(CAMERA, LASER, AXIS, *artefacts)
    kinds = "2 mounts of a stepped cylinder, 1 mount of a sphere, 1 mount of a cylinder"
    assert stages["joint estimate"] == (True, f"camera, laser plane, axis, {kinds}")
    assert stages["axis optimisation"] == (True, "2 mounts of a stepped cylinder, method article")
    assert stages["initial axis"] == (True, "9 frames of a target on the table")


@pytest.mark.parametrize("target", [BALL, ROD])
def test_only_a_stepped_cylinder_shows_the_axis_alone(target):
    stages = _stages(CAMERA, LASER, _capture("a", "artifact", target, n_on=9))
    assert stages["initial axis"] == (
        False,
        "no capture with role 'axis'; only a stepped cylinder shows the axis alone",
    )
    assert stages["joint estimate"] == (True, "camera, laser plane")
    assert not stages["scan"][0]
    alone = _stages(CAMERA, LASER, _capture("a", "artifact", STEPPED, n_on=9))
    assert alone["initial axis"] == (True, "no capture with role 'axis': from the stepped cylinder")
    assert alone["scan"][0]


def test_checks_are_counted():
    scan = _capture("ball", "scan", None, n_on=9)
    asked = [MeasurementRequest(capture="ball", feature="sphere", check=check) for check in (True, False)]
    stages = _stages(CAMERA, LASER, AXIS, scan, measurements=tuple(asked))
    assert stages["measurement"] == (True, "2 feature(s) asked for, 1 of them to check the calibration")
    assert stages["axis optimisation"] == (False, "only with a stepped cylinder, method article")


def test_without_a_camera_nothing_is_possible():
    stages = _stages(_capture("a", "artifact", STEPPED, n_on=9))
    assert not any(possible for name, (possible, _) in stages.items() if name != "measurement")
