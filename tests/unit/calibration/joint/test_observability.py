"""Directions that the data leave open: what a quantity is, from points of the sheet moved by the parameters; what is said of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.joint.estimate import JointOptions, estimate_jointly
from rotaline.calibration.joint.observability import point_errors, u_of_points, weak_directions
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.geometry.transforms import base_from_axis


@pytest.fixture(scope="module")
def found(right_handed):
    return estimate_jointly(
        right_handed.observations, right_handed.start, JointOptions(optional_parameters=False, print_errors=False)
    )


def _with(found, name, step):
    """The system after a small change of one parameter, as the covariance counts it; the motion of the base frame about the axis' pivot."""
    camera, plane, axis = found.camera, found.laser_plane_camera, found.axis_camera
    pivot = found.covariance.plane_pivot_camera
    if hasattr(camera, name):
        return replace(camera, **{name: getattr(camera, name) + step}), plane, axis, RigidTransform.identity()
    change = RigidTransform.identity()
    if name.startswith("plane"):
        e = dict(zip(("plane_turn_1", "plane_turn_2"), across(plane.normal), strict=True)).get(name, np.zeros(3))
        raw = plane.normal + step * e
        offset = plane.offset - step * e @ pivot + (step if name == "plane_offset" else 0.0)
        plane = Plane(unit(raw), offset / np.linalg.norm(raw))
    else:
        direction = np.eye(3)["xy".index(name[-1])]
        if "turn" in name:
            change = RigidTransform.from_rotation(Rotation.from_rotvec(step * direction))
        else:
            change = RigidTransform.from_translation(step * direction)
    return camera, plane, axis, change


def test_points_move_as_the_parameters_say(found):
    """Pixels stay; points are where their rays meet the sheet, seen from the base frame with its origin at the axis' pivot."""
    errors = point_errors(found)
    base = base_from_axis(found.axis_camera).rotation
    pivot = found.covariance.axis_pivot_camera
    points_camera = base.inv().apply(errors.points_base) + pivot
    assert np.abs(found.laser_plane_camera.signed_distance_to(points_camera)).max() < 1e-9
    uv = found.camera.project(points_camera)

    def seen(name, step):
        camera, plane, _, change = _with(found, name, step)
        rays = camera.rays(uv)
        points = rays * (-plane.offset / (rays @ plane.normal))[:, None]
        in_base = change.inv().apply(base.apply(points - pivot))
        in_base[:, 2] -= in_base[0, 2]
        return in_base

    for k, name in enumerate(found.covariance.names):
        size = 1e-4 if hasattr(found.camera, name) else 1e-6
        difference = (seen(name, size) - seen(name, -size)) / (2 * size)
        scale = np.abs(difference).max()
        assert np.abs(errors.sensitivity[:, :, k] - difference).max() < 1e-4 * scale, name


def test_shares_are_what_knowing_a_quantity_would_take_away(found):
    """The covariance may be anything: with one uncertain parameter its quantity explains all."""
    names = found.covariance.names
    only = np.zeros((len(names), len(names)))
    only[names.index("plane_offset"), names.index("plane_offset")] = 0.01**2
    weak = weak_directions(replace(found, covariance=replace(found.covariance, matrix=only)))
    across_plane = next(w for w in weak if w.quantity == "axis position across the laser plane")
    assert across_plane.u == pytest.approx(0.01)
    assert across_plane.share == pytest.approx(1.0)
    assert weak[0].share == pytest.approx(1.0)
    usual = weak_directions(found)
    assert [w.share for w in usual] == sorted((w.share for w in usual), reverse=True)
    assert all(0.0 <= w.share <= 1.0 for w in usual)
    doubled = replace(found, covariance=replace(found.covariance, matrix=4.0 * found.covariance.matrix))
    assert u_of_points(doubled) == pytest.approx(2.0 * u_of_points(found))
    assert [w.share for w in weak_directions(doubled)] == pytest.approx([w.share for w in usual])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gap_and_lean_are_those_of_the_geometry(found, seed):
    """With all parameters uncertain together along one direction, u of a quantity is its change along this direction."""
    names = found.covariance.names
    base, pivot = base_from_axis(found.axis_camera).rotation, found.covariance.axis_pivot_camera
    step = np.random.default_rng(seed).standard_normal(len(names))

    def changed(name, size):
        _, plane, _, change = _with(found, name, size)
        origin = base.inv().apply(change.translation) + pivot
        direction = base.inv().apply(change.rotation.apply([0.0, 0.0, 1.0]))
        return np.array([plane.normal @ origin + plane.offset, plane.normal @ direction])

    slopes = [(changed(name, 1e-6) - changed(name, -1e-6)) / 2e-6 for name in names]
    gap, lean = np.abs(step @ np.array(slopes))
    known = replace(found.covariance, matrix=np.outer(step, step))
    weak = {w.quantity: w.u for w in weak_directions(replace(found, covariance=known))}
    assert weak["axis position across the laser plane"] == pytest.approx(gap, rel=1e-5)
    assert weak["lean of the axis against the laser plane"] == pytest.approx(lean, rel=1e-5)


def test_words_tell_what_to_do(found):
    mounts = found.mounts
    centred = replace(found, mounts=tuple(replace(m, eccentricity_mm=0.1) for m in mounts))
    off = replace(found, mounts=tuple(replace(m, eccentricity_mm=7.0) for m in mounts))
    none = replace(found, mounts=())

    def said(result):
        return next(w for w in weak_directions(result) if w.quantity == "axis position across the laser plane")

    assert "too well centred (at most 0.1 mm off)" in said(centred).text
    assert f"{said(centred).u * 1e3:.2g} um across the laser plane" in said(centred).text
    assert "5 to 8 mm off centre" in said(centred).action
    assert "7.0 mm off centre" in said(off).text
    assert "no artefact" in said(none).text
    assert "stepped cylinder" in said(none).action


def test_without_plane_or_axis_nothing_is_said(found):
    assert weak_directions(replace(found, axis_camera=None)) == ()
    assert np.isnan(u_of_points(replace(found, laser_plane_camera=None)))
    line = Line(found.axis_camera.point, found.laser_plane_camera.normal)  # the sheet lies across the axis
    assert weak_directions(replace(found, axis_camera=line))
