"""Rendered light against slow references written here: edges, the stripe's centre, shadows; and the sensor's statistics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.boards import Plate
from rotaline.simulation.material import Material
from rotaline.simulation.render import (
    Placed,
    expose,
    render_frame,
    render_irradiance,
    subpixel_offsets,
)
from rotaline.simulation.rig import Laser, Optics, Rig, Sensor, build_rig
from rotaline.simulation.shapes import Ball, Rod
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


def test_an_edge_stands_where_its_projection_is():
    rig, plate = _rig_that_is_its_camera(), _oblique_plate()
    ambient, _ = render_irradiance(rig, [plate], laser_on=False, ambient_e_per_ms=200.0)
    # the edge between two squares, near-vertical in the image: x = 0, away from corners
    edge_mm = np.array([[0.0, y, 0.0] for y in np.linspace(8.0, 52.0, 400)])
    edge_uv = CAMERA.project(plate.frame_from_part.apply(edge_mm))
    rows = np.arange(max(int(edge_uv[:, 1].min()), 0) + 3, min(int(edge_uv[:, 1].max()), 90) - 3)
    expected = np.interp(rows, edge_uv[:, 1], edge_uv[:, 0])
    found = []
    for row, u in zip(rows, expected, strict=True):
        first = int(u) - 6
        window = ambient[row, first : first + 14]
        # levels on either side differ along the row by the shading: straight lines through the three outer pixels
        i = np.arange(14)
        left, right = np.polyfit(i[:3], window[:3], 1), np.polyfit(i[-3:], window[-3:], 1)
        share = (window - np.polyval(left, i)) / (np.polyval(right, i) - np.polyval(left, i))
        found.append(first + 13.5 - share.sum())
    error = np.array(found) - expected
    assert len(rows) > 15
    assert expected.min() > 10
    assert abs(error.mean()) < 0.005
    assert error.std() < 0.02


def test_the_stripe_on_a_tilted_plane_is_the_integral_of_its_profile():
    rig, plate = _rig_that_is_its_camera(), _oblique_plate()
    _, laser = render_irradiance(
        rig, [Placed(_White(plate.shape), plate.frame_from_part)], laser_on=True, ambient_e_per_ms=3.0
    )

    nodes, weights = np.polynomial.legendre.leggauss(6)
    du, dv = (grid.ravel() / 2 for grid in np.meshgrid(nodes, nodes))
    weight = np.outer(weights, weights).ravel() / 4
    normal = plate.frame_from_part.rotation.apply([0.0, 0.0, -1.0])
    through = plate.frame_from_part.translation
    checked = 0
    for row in range(30, 75, 5):
        columns = np.arange(120)
        uv = np.stack([columns[:, None] + du, np.broadcast_to(row + dv, (120, du.size))], axis=-1).reshape(-1, 2)
        rays = CAMERA.rays(uv)
        points = rays * ((through @ normal) / (rays @ normal))[:, None]
        to_laser = rig.laser.position_base - points
        cos = (to_laser @ normal) / np.linalg.norm(to_laser, axis=1)
        d = rig.laser.plane_base.signed_distance_to(points)
        light = (rig.laser.peak_e_per_ms * cos * np.exp(-0.5 * (d / rig.laser.sigma_mm) ** 2)).reshape(120, -1) @ weight
        assert np.abs(laser[row] - light).max() < 0.01 * light.max()
        centroid, expected = (float(columns @ values / values.sum()) for values in (laser[row], light))
        assert abs(centroid - expected) < 0.005
        checked += 1
    assert checked == 9


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
    _, free = render_irradiance(rig, [table], laser_on=True, ambient_e_per_ms=3.0)
    _, shadowed = render_irradiance(rig, [table, rod], laser_on=True, ambient_e_per_ms=3.0)
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
    _, front = render_irradiance(rig, [ball], laser_on=True, ambient_e_per_ms=0.0)
    _, back = render_irradiance(behind, [ball], laser_on=True, ambient_e_per_ms=0.0)
    lower = slice(_pixel(rig, [0.0, 0.0, 20.0])[0], None)
    assert front[lower].sum() > 100.0
    assert back[lower].sum() < 0.05 * front[lower].sum()


def test_no_light_on_the_front_of_a_thin_plate_that_is_lit_from_behind():
    rig = _rig_that_is_its_camera()
    plate = _oblique_plate()
    behind = replace(rig, laser=replace(rig.laser, position_base=np.array([-20.0, 0.0, 500.0])))
    _, front = render_irradiance(rig, [plate], laser_on=True, ambient_e_per_ms=0.0)
    _, back = render_irradiance(behind, [plate], laser_on=True, ambient_e_per_ms=0.0)
    assert front.max() > 50.0
    assert np.all(back == 0.0)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 70.0])
def test_ambient_light_falls_with_the_angle_to_the_viewer(tilt_deg):
    rig = _rig_that_is_its_camera()
    plate = _White(Plate(Checkerboard((9, 9), 20.0)))
    rotation = Rotation.from_rotvec([0.0, np.radians(tilt_deg), 0.0])
    pose = RigidTransform.from_components([0.0, 0.0, 300.0] - rotation.apply(plate.centre_board()), rotation)
    ambient, laser = render_irradiance(rig, [Placed(plate, pose)], laser_on=False, ambient_e_per_ms=100.0)
    assert np.all(laser == 0.0)
    middle = ambient[round(CAMERA.cy), round(CAMERA.cx)]
    assert middle == pytest.approx(100.0 * (0.55 + 0.45 * np.cos(np.radians(tilt_deg))), rel=0.005)


def test_sub_pixel_rays_are_spread_evenly_in_both_directions():
    offsets = subpixel_offsets(34, 21)
    for column in offsets.T:
        np.testing.assert_allclose(np.sort(column), (np.arange(34) + 0.5) / 34 - 0.5)
    gaps = np.linalg.norm(offsets[:, None] - offsets[None], axis=2) + np.eye(34)
    assert gaps.min() > 0.9 / np.sqrt(34)


@pytest.mark.parametrize(("bit_depth", "step"), [(8, 1.0), (16, 1 / 257)])
def test_the_noise_has_the_stated_variance(bit_depth, step):
    sensor = Sensor(bit_depth=bit_depth, full_well_e=255 * 30.0, read_noise_e=24.0, black_level_dn=3.0)
    image = expose(np.full((300, 400), 3000.0), sensor, np.random.default_rng(1)) * step
    variance = 0.8**2 + 100.0 / 30.0 + step**2 / 12
    assert image.mean() == pytest.approx(103.0, abs=4 * np.sqrt(variance / image.size))
    assert image.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / image.size))


def test_too_much_light_is_clipped():
    image = expose(np.full((5, 5), 12e3), Sensor(bit_depth=16), np.random.default_rng(1))
    assert np.all(image == 65535)


def test_speckle_has_the_stated_contrast():
    rig, table, _ = _level_scene()
    quiet = Sensor(read_noise_e=0.0, full_well_e=1e9, bit_depth=16, black_level_dn=0.0)
    wide = replace(rig.laser, sigma_mm=50.0, speckle_contrast=0.1, peak_e_per_ms=8e7)
    rig = replace(rig, laser=wide, sensor=quiet)
    _, light = render_irradiance(rig, [table], laser_on=True, ambient_e_per_ms=0.0)
    image = render_frame(rig, [table], laser_on=True, ambient_e_per_ms=0.0, exposure_ms=10.0, seed=5) / 65535 * 1e8
    bright = light > 1e7
    ratio = image[bright] / light[bright]
    assert ratio.std() == pytest.approx(0.1, rel=0.1)
    assert ratio.mean() == pytest.approx(1.0, abs=0.01)


def test_the_seed_alone_fixes_the_noise():
    rig, table, rod = _level_scene()
    images = [
        render_frame(rig, [table, rod], laser_on=True, ambient_e_per_ms=12.0, exposure_ms=10.0, seed=seed)
        for seed in (7, 7, 8)
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert np.any(images[0] != images[2])


def test_a_red_laser_shows_in_the_first_channel():
    rig, table, _ = _level_scene()
    rig = replace(rig, sensor=Sensor(colour=True))
    image = render_frame(rig, [table], laser_on=True, ambient_e_per_ms=12.0, exposure_ms=10.0, seed=1)
    assert image.shape == (120, 160, 3)
    red, green, blue = (int(image[:, :, k].max()) for k in range(3))
    assert red > 100
    assert green < 0.3 * red
    assert blue < 0.2 * red
