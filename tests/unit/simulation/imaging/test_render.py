"""What the renderer puts together: parts, shadows, light of both kinds, speckle, sensor. Exactness: test_render_reference."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.imaging.pixels import corner_xy, edge_pixels, seen_at_corners
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_frame, render_irradiance
from rotaline.simulation.imaging.scene import Scene
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.shapes import Ball, Block, Rod
from rotaline.simulation.rig import Laser, Optics, Rig, Sensor, build_rig
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard

CAMERA = CameraModel((120, 90), 400.0, 398.0, 61.3, 43.9, k1=-0.1, k2=0.05, p1=0.001, p2=-0.0007)
NO_BLUR = Optics(blur_px=0.0)
PEAK = 200.0


def _rig_that_is_its_camera(camera=CAMERA, plane=None):
    """Base frame = camera frame; the laser stands to the right of the camera."""
    position = np.array([100.0, 0.0, 0.0])
    if plane is None:
        normal = np.array([0.9, 0.1, 0.42])
        normal /= np.linalg.norm(normal)
        plane = Plane(normal, -float(normal @ [2.0, 1.0, 200.0]))
        position = position - (normal @ position + plane.offset) * normal
    beam = unit(np.array([2.0, 1.0, 200.0]) - position)
    laser = Laser(plane, position, beam, sigma_mm=0.6, peak_e_per_ms=PEAK, speckle_contrast=0.0)
    return Rig(camera, RigidTransform.identity(), laser, optics=NO_BLUR)


def _oblique_plate():
    board = Checkerboard((2, 2), 60.0)
    pose = RigidTransform.from_components([-4.0, -33.0, 200.0], Rotation.from_rotvec([0.35, -0.3, 0.07]))
    return Placed(Plate(board), pose)


class _White(Plate):
    """A plate without print."""

    def __init__(self, plate):
        super().__init__(plate.target, plate.margin)

    def albedo(self, points, faces):
        return np.ones(len(points))


def _level_scene():
    rig = replace(build_rig((160, 120)), optics=NO_BLUR)
    table = Placed(Rod(200.0, 8.0, -8.0, Material(1.0)), RigidTransform.identity())
    rod = Placed(Rod(20.0, 30.0), RigidTransform.identity())
    return rig, table, rod


def _pixel(rig, point_base):
    u, v = rig.camera.project(rig.camera_from_base.apply(np.array([point_base])))[0]
    return round(v), round(u)


def test_a_part_throws_a_shadow_and_hides_what_is_behind_it():
    rig, table, rod = _level_scene()
    free = render_irradiance(rig, [table], laser_on=True, ambient_e_per_ms=3.0).laser
    shadowed = render_irradiance(rig, [table, rod], laser_on=True, ambient_e_per_ms=3.0).laser
    along = np.cross(rig.laser.plane_base.normal, [0.0, 0.0, 1.0])
    along *= np.sign(along @ rig.laser.position_base)
    foot = -rig.laser.plane_base.offset * rig.laser.plane_base.normal
    before, behind = _pixel(rig, foot + 25.0 * along), _pixel(rig, foot - 24.0 * along)
    assert free[before] == pytest.approx(shadowed[before], rel=1e-9)
    assert free[before] > 50.0
    assert free[behind] > 50.0
    assert shadowed[behind] == 0.0


def test_no_light_on_a_side_that_faces_away_from_the_laser():
    rig = replace(build_rig((160, 120)), optics=NO_BLUR)
    behind = replace(rig, laser=replace(rig.laser, position_base=-rig.laser.position_base * [1.0, 1.0, -1.0]))
    ball = Placed(Ball(40.0), RigidTransform.identity())
    front = render_irradiance(rig, [ball], laser_on=True, ambient_e_per_ms=0.0).laser
    back = render_irradiance(behind, [ball], laser_on=True, ambient_e_per_ms=0.0).laser
    lower = slice(_pixel(rig, [0.0, 0.0, 20.0])[0], None)
    assert front[lower].sum() > 100.0
    assert back[lower].sum() < 0.05 * front[lower].sum()


def test_no_light_on_the_front_of_a_thin_plate_that_is_lit_from_behind():
    rig = _rig_that_is_its_camera()
    plate = _oblique_plate()
    behind = replace(rig, laser=replace(rig.laser, position_base=np.array([-20.0, 0.0, 500.0])))
    front = render_irradiance(rig, [plate], laser_on=True, ambient_e_per_ms=0.0).laser
    back = render_irradiance(behind, [plate], laser_on=True, ambient_e_per_ms=0.0).laser
    assert front.max() > 50.0
    assert np.all(back == 0.0)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 70.0])
def test_ambient_light_falls_with_the_angle_to_the_viewer(tilt_deg):
    rig = _rig_that_is_its_camera()
    plate = _White(Plate(Checkerboard((9, 9), 20.0)))
    rotation = Rotation.from_rotvec([0.0, np.radians(tilt_deg), 0.0])
    pose = RigidTransform.from_components([0.0, 0.0, 300.0] - rotation.apply(plate.centre_board()), rotation)
    light = render_irradiance(rig, [Placed(plate, pose)], laser_on=False, ambient_e_per_ms=100.0)
    assert np.all(light.laser == 0.0)
    middle = light.ambient[round(CAMERA.cy), round(CAMERA.cx)]
    assert middle == pytest.approx(100.0 * (0.55 + 0.45 * np.cos(np.radians(tilt_deg))), rel=0.005)


def test_speckle_has_the_stated_contrast():
    rig, table, _ = _level_scene()
    quiet = Sensor(read_noise_e=0.0, full_well_e=1e9, bit_depth=16, black_level_dn=0.0)
    wide = replace(rig.laser, sigma_mm=50.0, speckle_contrast=0.1, peak_e_per_ms=8e7)
    rig = replace(rig, laser=wide, sensor=quiet)
    light = render_irradiance(rig, [table], laser_on=True, ambient_e_per_ms=0.0).laser
    image = render_frame(rig, [table], laser_on=True, ambient_e_per_ms=0.0, exposure_ms=10.0, seed=5) / 65535 * 1e8
    bright = light > 1e7
    ratio = image[bright] / light[bright]
    assert ratio.std() == pytest.approx(0.1, rel=0.1)
    assert ratio.mean() == pytest.approx(1.0, abs=0.01)


def test_the_seed_alone_fixes_the_image():
    rig, table, rod = _level_scene()

    def frame(seed):
        return render_frame(rig, [table, rod], laser_on=True, ambient_e_per_ms=12.0, exposure_ms=10.0, seed=seed)

    with ThreadPoolExecutor(3) as pool:
        images = list(pool.map(frame, (7, 7, 8, (7, 1), 7)))
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[4])
    assert np.any(images[0] != images[2])
    assert np.any(images[0] != images[3])


def test_a_red_laser_shows_in_the_first_channel():
    rig, table, _ = _level_scene()
    rig = replace(rig, sensor=Sensor(colour=True))
    image = render_frame(rig, [table], laser_on=True, ambient_e_per_ms=12.0, exposure_ms=10.0, seed=1)
    assert image.shape == (120, 160, 3)
    red, green, blue = (int(image[:, :, k].max()) for k in range(3))
    assert red > 100
    assert green < 0.3 * red
    assert blue < 0.2 * red


def test_a_target_is_bright_without_laser_and_dark_with_it():
    rig = build_rig((160, 120))
    plate = Plate(Checkerboard((5, 4), 10.0))
    camera_from_board = RigidTransform.from_components([-20.0, -15.0, 290.0], Rotation.from_rotvec([0.2, 0.1, 0.0]))
    parts = [Placed(plate, rig.camera_from_base.inv() * camera_from_board)]
    light = rig.light
    off = render_frame(rig, parts, laser_on=False, ambient_e_per_ms=light.ambient_e_per_ms, exposure_ms=10.0, seed=1)
    dim = light.ambient_e_per_ms * light.ambient_on_fraction
    on = render_frame(rig, parts, laser_on=True, ambient_e_per_ms=dim, exposure_ms=10.0, seed=1)
    assert np.median(off[off > 20]) > 100
    assert np.median(on) < 10 < 100 < on.max()


def test_an_empty_scene_is_black_and_has_the_noise_of_the_sensor():
    rig = build_rig((160, 120))
    image = render_frame(rig, [], laser_on=True, ambient_e_per_ms=760.0, exposure_ms=10.0, seed=1)
    assert image.mean() == pytest.approx(rig.sensor.black_level_dn, abs=0.05)


def test_light_goes_on_at_the_border_of_the_image():
    rig = replace(build_rig((160, 120)), optics=Optics(blur_px=1.5))
    floor = Placed(Block(2000.0, 2000.0, 10.0), RigidTransform.from_translation([0.0, 0.0, -10.0]))
    wide = replace(rig, laser=replace(rig.laser, sigma_mm=200.0))
    light = render_irradiance(wide, [floor], laser_on=True, ambient_e_per_ms=100.0)
    for image in (light.ambient, light.laser):
        steps = np.abs(np.diff(image[:, 80])) / image.max()
        assert image.min() > 0.1 * image.max()
        assert steps[[0, 1, -2, -1]].max() < 1.5 * np.median(steps)


def test_a_part_that_reaches_behind_the_camera_is_seen():
    rig = _rig_that_is_its_camera()
    # a long bar that starts below the camera's back and runs forward
    bar = Placed(Block(10.0, 20.0, 600.0), RigidTransform.from_translation([30.0, 0.0, -100.0]))
    image = render_irradiance(rig, [bar], laser_on=False, ambient_e_per_ms=1.0).ambient
    seen = CAMERA.project(np.array([[25.0, 0.0, 300.0]]))[0]
    assert image[round(seen[1]), round(seen[0])] > 0.3


def test_parts_are_the_same_in_any_order_and_hide_each_other():
    rig, table, rod = _level_scene()
    one, other = (
        render_irradiance(rig, parts, laser_on=True, ambient_e_per_ms=9.0) for parts in ([table, rod], [rod, table])
    )
    np.testing.assert_array_equal(one.ambient, other.ambient)
    np.testing.assert_array_equal(one.laser, other.laser)
    assert set(np.unique(one.part)) == {-1, 0, 1} or set(np.unique(one.part)) == {0, 1}


def test_gloss_brightens_the_mirror_direction_only():
    rig = _rig_that_is_its_camera()
    rig = replace(rig, laser=replace(rig.laser, sigma_mm=60.0))
    half = unit(unit(rig.laser.position_base - [0.0, 0.0, 200.0]) + np.array([0.0, 0.0, -1.0]))
    turn = Rotation.align_vectors([half], [[0.0, 0.0, 1.0]])[0]

    def middle(rotation, gloss):
        block = Block(40.0, 40.0, 5.0, Material(0.3, gloss, 6.0))
        pose = RigidTransform.from_components([0.0, 0.0, 200.0] - rotation.apply([0.0, 0.0, 5.0]), rotation)
        light = render_irradiance(rig, [Placed(block, pose)], laser_on=True, ambient_e_per_ms=0.0).laser
        return float(light[round(CAMERA.cy), round(CAMERA.cx)])

    away = Rotation.from_rotvec([np.radians(25.0), 0.0, 0.0]) * turn
    assert middle(turn, 0.4) > 3.0 * middle(turn, 0.0) > 0.0
    assert middle(away, 0.4) == pytest.approx(middle(away, 0.0), rel=0.02)


def test_only_edges_of_a_fine_mesh_are_split():
    rig, _, _ = _level_scene()
    ball = Placed(_Facetted(40.0), RigidTransform.identity())
    smooth = Placed(Ball(40.0), RigidTransform.identity())
    scenes = [Scene.of(rig, [part]) for part in (ball, smooth)]
    xy = corner_xy(rig.camera, 0)
    counts = [int(edge_pixels(seen_at_corners(scene, xy, False), rig.camera.fx).sum()) for scene in scenes]
    assert 50 < counts[0] <= 1.2 * counts[1]


class _Facetted(Ball):
    """Every point has a face of its own, as with the triangles of a fine mesh."""

    def intersect(self, origin, directions):
        t, faces = super().intersect(origin, directions)
        return t, np.arange(len(faces))
