"""Camera calibration: what it refuses, leaves out and warns of."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.intrinsics import CameraOptions, calibrate_camera
from rotaline.calibration.model import TargetView
from rotaline.errors import CalibrationError
from rotaline.simulation.ideal.observations import observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target, TargetDetection

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
TARGET = Checkerboard((11, 9), 6.0)
SIGMA = 0.03


def views_of(poses: Sequence[RigidTransform], seed: int = 0, target: Target = TARGET) -> list[TargetView]:
    """What a good detector sees."""
    rng = np.random.default_rng(seed)
    return [
        TargetView(f"camera/{k:04d}.png", observe_target(CAMERA, pose, target, SIGMA, rng))
        for k, pose in enumerate(poses)
    ]


def good_views(n: int = 10, seed: int = 0) -> list[TargetView]:
    """Boards all over the image."""
    rng = np.random.default_rng(seed)
    return views_of(random_board_poses(CAMERA, TARGET, n, rng, spread=0.5, distance_mm=(200.0, 350.0)), seed)


def with_uv(view: TargetView, uv: np.ndarray) -> TargetView:
    """The view with other image points."""
    return replace(view, detection=replace(view.detection, uv=uv))


def test_good_views_give_no_warning() -> None:
    """Ten tilted boards all over the image: nothing to complain about, and the residuals are the noise."""
    result = calibrate_camera(good_views(), CAMERA.image_size)
    assert result.warnings == ()
    assert all(view.used and view.reason == "" for view in result.views)
    assert result.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.05)
    assert result.mean_error_px == pytest.approx(SIGMA * np.sqrt(np.pi / 2), rel=0.05)
    assert result.parameter_names == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def test_half_turned_orders_change_nothing() -> None:
    """A symmetric board may be read from either end."""
    views = good_views()
    turned = [with_uv(v, v.detection.uv[::-1].copy()) if k % 2 else v for k, v in enumerate(views)]
    a, b = calibrate_camera(views, CAMERA.image_size), calibrate_camera(turned, CAMERA.image_size)
    assert b.camera.fx == pytest.approx(a.camera.fx, rel=1e-6)
    assert b.camera.cx == pytest.approx(a.camera.cx, rel=1e-6)


def test_different_targets_work_together() -> None:
    """A session may show a checkerboard and a dot plate to the same camera."""
    rng = np.random.default_rng(3)
    dots = DotGrid((7, 7), 8.0, 4.0)
    views = good_views(5) + views_of(random_board_poses(CAMERA, dots, 5, rng, spread=0.4), 1, dots)
    result = calibrate_camera(views, CAMERA.image_size)
    assert all(view.used for view in result.views)
    assert result.camera.fx == pytest.approx(CAMERA.fx, abs=4 * result.u_parameters[0])


def test_bad_points_and_views_are_left_out_and_named() -> None:
    """Glare on single points, a blurred image, rows and columns mixed up, a view of three points."""
    rng = np.random.default_rng(4)
    views = good_views(12)
    views[1].detection.uv[[5, 60]] += 15.0
    blurred = with_uv(views[4], views[4].detection.uv + rng.normal(0, 1.0, (99, 2)))
    mixed = with_uv(views[7], views[7].detection.uv.reshape(9, 11, 2).transpose(1, 0, 2).reshape(-1, 2))
    d = views[9].detection
    short = replace(views[9], detection=replace(d, point_ids=d.point_ids[:3], uv=d.uv[:3]))
    views[4], views[7], views[9] = blurred, mixed, short
    result = calibrate_camera(views, CAMERA.image_size)
    assert [k for k, view in enumerate(result.views) if not view.used] == [4, 7, 9]
    assert "times that of the other views" in result.views[4].reason
    assert "only 3 points" in result.views[9].reason
    assert np.flatnonzero(np.isnan(result.views[1].residuals_px[:, 0])).tolist() == [5, 60]
    text = "\n".join(result.warnings)
    assert all(name in text for name in ("camera/0004.png", "camera/0007.png", "camera/0009.png"))
    assert "camera/0001.png" not in text  # two points of 99 are nothing that the user should look into
    for name, value, u in zip(result.parameter_names, result.u_parameters, result.u_parameters, strict=True):
        assert abs(getattr(result.camera, name) - getattr(CAMERA, name)) < 4 * max(value, u)


def test_many_bad_points_are_a_warning() -> None:
    """Glare over a corner of the board."""
    views = good_views(8)
    views[2].detection.uv[:9] += np.linspace(1.0, 3.0, 9)[:, None]
    result = calibrate_camera(views, CAMERA.image_size)
    assert any("9 of 99 points of camera/0002.png were left out" in text for text in result.warnings)
    assert result.views[2].used


def test_a_view_that_starts_mirrored_is_put_right() -> None:
    """Among bad views, the start of a good one may be the mirror image of its pose; it is no outlier for that."""
    rng = np.random.default_rng(0)
    views = views_of(random_board_poses(CAMERA, TARGET, 12, rng, spread=0.4), 0)
    mixed = with_uv(views[7], views[7].detection.uv.reshape(9, 11, 2).transpose(1, 0, 2).reshape(-1, 2))
    views[7] = mixed
    views[4] = with_uv(views[4], views[4].detection.uv + rng.normal(0, 1.0, (99, 2)))
    result = calibrate_camera(views, CAMERA.image_size)
    assert [k for k, view in enumerate(result.views) if not view.used] == [4, 7]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_views_are_refused(n: int) -> None:
    """The message says how many are needed."""
    with pytest.raises(CalibrationError, match=f"at least 3 views .* found {n}"):
        calibrate_camera(good_views(3)[:n], CAMERA.image_size)


def test_boards_parallel_to_the_image_are_refused() -> None:
    """They leave the focal length open; the message says so, and what to add."""
    poses = [
        RigidTransform.from_components([x, y, z], Rotation.from_rotvec([0.0, 0.0, roll]))
        for x, y, z, roll in ((-30, -24, 300, 0.0), (-40, -20, 340, 0.1), (-20, -30, 320, 0.2), (-35, -25, 380, -0.1))
    ]
    with pytest.raises(CalibrationError, match=r"focal length open .* turned by 20 to 45 deg"):
        calibrate_camera(views_of(poses), CAMERA.image_size)


def test_few_small_boards_lean_on_what_lenses_look_like() -> None:
    """Where the views do not give the principal point, it stays near the centre, and a warning says why."""
    target = Checkerboard((6, 5), 4.0)
    rng = np.random.default_rng(5)
    poses = random_board_poses(CAMERA, target, 5, rng, spread=0.05, tilt_deg=(15.0, 25.0), distance_mm=(300.0, 310.0))
    noisy = [TargetView(f"v{k}", observe_target(CAMERA, p, target, 0.3, rng)) for k, p in enumerate(poses)]
    result = calibrate_camera(noisy, CAMERA.image_size)
    free = calibrate_camera(noisy, CAMERA.image_size, CameraOptions(weak_parameters="free"))
    assert any("do not determine the camera by themselves" in text for text in result.warnings)
    assert any("Weakly determined" in text for text in free.warnings)
    assert any("Only 5 views" in text for text in result.warnings)
    assert any("Poor coverage" in text for text in result.warnings)
    diagonal = float(np.hypot(*CAMERA.image_size))
    assert np.hypot(result.camera.cx - 639.5, result.camera.cy - 479.5) < 2 * 0.08 * diagonal
    assert abs(result.camera.cx - CAMERA.cx) < 0.6 * abs(free.camera.cx - CAMERA.cx)
    assert abs(result.camera.cx - CAMERA.cx) < 4 * result.u_parameters[2]
    assert abs(result.camera.fx - CAMERA.fx) < 4 * result.u_parameters[0]


def test_little_tilt_is_a_warning() -> None:
    """Boards all turned by less than 10 deg."""
    poses = random_board_poses(CAMERA, TARGET, 12, np.random.default_rng(6), tilt_deg=(4.0, 9.0), spread=0.4)
    result = calibrate_camera(views_of(poses), CAMERA.image_size)
    assert any("Poor tilt" in text for text in result.warnings)


def test_parallel_boards_are_a_warning() -> None:
    """Boards tilted, but all in the same way."""
    rotation = Rotation.from_rotvec([0.5, 0.2, 0.0])
    poses = [
        RigidTransform.from_components([x, y, z], rotation)
        for x, y, z in (
            (-30, -24, 300),
            (-70, -40, 320),
            (-10, -50, 330),
            (-20, 0, 350),
            (-60, 5, 340),
            (-30, -20, 380),
        )
    ]
    result = calibrate_camera(views_of(poses), CAMERA.image_size)
    assert any("parallel to within 0 deg" in text for text in result.warnings)


def bent_views(shape: Callable[[np.ndarray, np.ndarray, int], np.ndarray], n: int = 12) -> list[TargetView]:
    """A board with the heights ``shape(x, y, view)``, coordinates about its centre, taken for flat by who detects it."""
    rng = np.random.default_rng(7)
    points = TARGET.points_board()
    x, y, _ = (points - points.mean(axis=0)).T
    views = []
    for k, pose in enumerate(random_board_poses(CAMERA, TARGET, n, rng, spread=0.3)):
        bent = points + np.outer(shape(x, y, k), [0.0, 0.0, 1.0])
        detection = observe_target(CAMERA, pose, TARGET, 0.0, rng)
        uv = CAMERA.project(pose.apply(bent)) + 0.02 * rng.standard_normal((len(bent), 2))
        views.append(TargetView(f"v{k}", replace(detection, uv=uv)))
    return views


def test_a_bent_target_is_found_out() -> None:
    """The camera is as good as from a flat one, the target's shape is known, and the user is told."""
    views = bent_views(lambda x, y, _: 0.0006 * (x * x - 300) + 0.0003 * x * y)
    result = calibrate_camera(views, CAMERA.image_size)
    flat = calibrate_camera(views, CAMERA.image_size, CameraOptions(board="flat"))
    assert any("not flat: its points lie up to" in text for text in result.notes)
    assert result.rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.05)
    assert flat.rms_px > 1.5 * result.rms_px
    for name, u in zip(result.parameter_names, result.u_parameters, strict=True):
        assert abs(getattr(result.camera, name) - getattr(CAMERA, name)) < 4 * u
    found = result.with_target_as_found(views[0].detection)
    x, y, _ = (TARGET.points_board() - TARGET.points_board().mean(axis=0)).T
    height = 0.0006 * x * x + 0.0003 * x * y
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    height = height - plane @ np.linalg.lstsq(plane, height, rcond=None)[0]
    assert np.abs(found.points_board[:, 2] - height).max() < 0.02 * np.ptp(height)
    assert np.abs(flat.u_parameters[0] / result.u_parameters[0]) > 2
    assert flat.with_target_as_found(views[0].detection) is views[0].detection


def printed_views(target: Target, offset_mm: float, n: int) -> list[TargetView]:
    """Views of a bowed print whose points are off by ``offset_mm``, taken for exact by who detects it."""
    rng = np.random.default_rng(11)
    points = replace(target, bend=(0.05, 0.0, 0.05)).points_board()
    points[:, :2] += offset_mm * rng.standard_normal((len(points), 2))
    views = []
    for k, pose in enumerate(random_board_poses(CAMERA, target, n, rng, spread=0.3)):
        uv = CAMERA.project(pose.apply(points)) + 0.02 * rng.standard_normal((len(points), 2))
        views.append(TargetView(f"v{k}", TargetDetection(target, np.arange(len(points)), uv, 0.02)))
    return views


def error_of_rays_px(camera: CameraModel) -> float:
    """RMS distance of the images of a grid of directions."""
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.18, 0.18, 7))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return float(np.sqrt(np.mean(np.sum((camera.project(rays) - CAMERA.project(rays)) ** 2, axis=1))))


@pytest.mark.parametrize("n", [5, 15])
def test_a_bad_print_gives_a_good_camera(n: int) -> None:
    """The camera is better than with the stated target, the points are known, and the user is told; few views or many."""
    target = Checkerboard((10, 7), 6.0)
    views = printed_views(target, 0.02, n)
    result = calibrate_camera(views, CAMERA.image_size)
    stated = calibrate_camera(views, CAMERA.image_size, CameraOptions(board="flat"))
    assert any("off their places by 0.0" in text for text in result.notes)
    assert result.rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.25)
    assert error_of_rays_px(result.camera) < error_of_rays_px(stated.camera) / 3
    for name, u in zip(result.parameter_names, result.u_parameters, strict=True):
        assert abs(getattr(result.camera, name) - getattr(CAMERA, name)) < 4 * u
    assert np.shape(result.with_target_as_found(views[0].detection).target.offsets) == (70, 2)
    assert stated.targets == ()
    assert not any("off their places" in text for text in stated.notes)


def test_a_bend_is_not_taken_for_offsets() -> None:
    """A bowed plate with an exact print has its bend, and no offsets."""
    result = calibrate_camera(printed_views(Checkerboard((10, 7), 6.0), 0.0, 12), CAMERA.image_size)
    assert [target.offsets for target in result.targets] == [()]


def test_points_of_a_symmetric_target_are_taken_as_stated() -> None:
    """Which of its points is which, no view tells."""
    result = calibrate_camera(printed_views(Checkerboard((8, 6), 6.0), 0.02, 10), CAMERA.image_size)
    assert all(target.offsets == () for target in result.targets)


def test_outliers_are_found_among_the_points_of_a_bad_print() -> None:
    """A point of one view that is off by less than the print's errors, and by far more than the noise."""
    views = printed_views(Checkerboard((10, 7), 6.0), 0.05, 12)
    views[3].detection.uv[25] += [0.4, 0.0]
    result = calibrate_camera(views, CAMERA.image_size)
    assert np.flatnonzero(np.isnan(result.views[3].residuals_px[:, 0])).tolist() == [25]
    assert all(view.used for view in result.views)


def test_a_target_that_changes_its_shape_enlarges_the_standard_deviations() -> None:
    """Loose paper disturbs every view in its own way: the views disagree more than their noise explains."""
    views = bent_views(lambda x, _, k: 0.0006 * (x * x - 300) * (-1) ** k)
    result = calibrate_camera(views, CAMERA.image_size)
    assert result.targets == ()
    assert any("may not be flat" in text for text in result.warnings)
    assert result.u_parameters[0] > 2 * calibrate_camera(good_views(12), CAMERA.image_size).u_parameters[0]


def test_one_bad_view_bends_no_target() -> None:
    """A bend that a single view brings in is none."""
    views = good_views(10)
    d = views[3].detection
    views[3] = with_uv(views[3], d.uv + 0.002 * np.outer((d.points_board[:, 0] - 30) ** 2 / 10, [1.0, 0.5]))
    result = calibrate_camera(views, CAMERA.image_size)
    assert result.targets == ()


def test_a_square_dot_plate_may_be_read_from_four_sides() -> None:
    """Only a bend that looks the same from all sides is estimated, and the order of the points does not matter."""
    plate = DotGrid((7, 7), 8.0, 4.0)
    rng = np.random.default_rng(8)
    bent = replace(plate, bend=(0.15, 0.0, 0.15))
    views = []
    for k, pose in enumerate(random_board_poses(CAMERA, bent, 10, rng, spread=0.3)):
        detection = observe_target(CAMERA, pose, bent, 0.02, rng)
        turned = detection.uv.reshape(7, 7, 2)[::-1].transpose(1, 0, 2).reshape(-1, 2) if k % 2 else detection.uv
        views.append(TargetView(f"v{k}", replace(detection, target=plate, uv=turned)))
    result = calibrate_camera(views, CAMERA.image_size)
    assert np.allclose(result.targets[0].bend, bent.bend, atol=0.01)
    assert result.camera.fx == pytest.approx(CAMERA.fx, abs=4 * result.u_parameters[0])


@pytest.mark.parametrize(
    ("distortion", "names"),
    [("none", ()), ("k1", ("k1",)), ("k1k2", ("k1", "k2")), ("k1k2p1p2k3", ("k1", "k2", "p1", "p2", "k3"))],
)
def test_distortion_terms_are_those_asked_for(distortion: str, names: tuple[str, ...]) -> None:
    """Terms that are not asked for stay zero."""
    result = calibrate_camera(good_views(), CAMERA.image_size, CameraOptions(distortion=distortion))
    assert result.parameter_names[4:] == names
    for name in {"k1", "k2", "p1", "p2", "k3"} - set(names):
        assert getattr(result.camera, name) == 0.0
