"""Rendered light against a second renderer: slow, simple, and without a line in common.

The reference knows a scene as a function that is negative inside the solids. It walks along each ray until that function changes
its sign, halves the last step, and takes the normal from the function's differences. A pixel is a dense regular grid of such
rays, weighted with pixel area and blur.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import erf

from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_irradiance
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.shapes import Block, Rod
from rotaline.simulation.rig import Laser, Optics, Rig
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard

CAMERA = CameraModel((96, 72), 400.0, 398.0, 49.3, 34.9, k1=-0.1, k2=0.05, p1=0.001, p2=-0.0007)
MM_PER_PX = 200.0 / 400.0


@dataclass(frozen=True)
class Reference:
    """A scene in the camera frame: negative inside solids; albedo; first and last depth and the step; what may throw a shadow."""

    inside: Callable
    albedo: float | Callable = 0.8
    depths_mm: tuple[float, float, float] = (188.0, 212.0, 1.0)
    blocker: Callable | None = None

    def hits(self, rays):
        """First points of rays ``(x, y, 1)`` where the sign changes; nan if there is none."""
        low, high = np.full(len(rays), np.nan), np.full(len(rays), np.nan)
        for depth in np.arange(*self.depths_mm):
            new = np.isnan(high) & (self.inside(depth * rays) < 0)
            low[new], high[new] = depth - self.depths_mm[2], depth
        for _ in range(22):
            middle = (low + high) / 2
            within = self.inside(middle[:, None] * rays) < 0
            low, high = np.where(within, low, middle), np.where(within, middle, high)
        return high[:, None] * rays

    def light(self, points, laser):
        """Ambient light that points send, or that of a laser, per unit."""
        f, h = self.inside, 1e-4 * np.eye(3)
        normals = np.stack([f(points + h[k]) - f(points - h[k]) for k in range(3)], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        albedo = self.albedo(points) if callable(self.albedo) else self.albedo
        if laser is None:
            cos = np.abs((normals * points).sum(axis=1)) / np.linalg.norm(points, axis=1)
            return np.nan_to_num(albedo * (0.55 + 0.45 * cos))
        off = (points @ laser.plane_base.normal + laser.plane_base.offset) / laser.sigma_mm
        to_laser = laser.position_base - points
        distance = np.linalg.norm(to_laser, axis=1)
        cos = (normals * to_laser).sum(axis=1) / distance
        light = np.exp(-0.5 * off**2) * np.maximum(cos, 0.0) * laser.waist_mm / distance * albedo
        if self.blocker is not None:
            (bright,) = np.nonzero(light > 1e-4)
            for share in np.arange(0.17, 0.33, 0.001):
                light[bright[self.blocker(points[bright] + share * to_laser[bright]) < 0]] = 0.0
        return np.nan_to_num(light)

    def row(self, row, columns, blur_px, laser=None):
        """Light of some pixels of a row; ``blur_px`` a number, or a function of the depth of each point."""
        largest = blur_px if isinstance(blur_px, float) else 2.0
        reach = int(np.ceil(3.5 * largest + 0.5)) if largest > 0 else 0
        fine_u, fine_v = (32, 8) if largest > 0 else (64, 20)
        u = columns[0] - reach - 0.5 + (np.arange(fine_u * (len(columns) + 2 * reach)) + 0.5) / fine_u
        v = row - reach - 0.5 + (np.arange(fine_v * (1 + 2 * reach)) + 0.5) / fine_v
        u, v = np.meshgrid(u, v)
        # every line begins elsewhere within a ray's share: no two rays stand above each other
        u += (np.random.default_rng(1).random((len(v), 1)) - 0.5) / fine_u
        rays = CAMERA.rays(np.column_stack([u.ravel(), v.ravel()]))
        points = self.hits(rays)
        light = self.light(points, laser) / (fine_u * fine_v)
        sigma = blur_px if isinstance(blur_px, float) else blur_px(points[:, 2])
        along_v = light * _share(v.ravel() - row, sigma)
        return np.array([float(along_v @ _share(u.ravel() - column, sigma)) for column in columns])


def _share(x, sigma_px):
    """Share of the light of a point that a pixel gets along one direction: the blur's part between the pixel's borders."""
    if np.all(sigma_px == 0):
        return np.abs(x) < 0.5
    return (erf((x + 0.5) / sigma_px / np.sqrt(2)) - erf((x - 0.5) / sigma_px / np.sqrt(2))) / 2


def _rig(sheet_px=0.6, blur_px=0.0, optics=None):
    """Base frame = camera frame; the laser stands to the right of the camera."""
    normal = unit(np.array([0.9, 0.1, 0.42]))
    plane = Plane(normal, -float(normal @ [2.0, 1.0, 200.0]))
    position = np.array([100.0, 0.0, 0.0])
    position = position - (normal @ position + plane.offset) * normal
    beam = unit(np.array([2.0, 1.0, 200.0]) - position)
    laser = Laser(plane, position, beam, sigma_mm=sheet_px * MM_PER_PX, fan_deg=90.0, peak_e_per_ms=1.0)
    return Rig(CAMERA, RigidTransform.identity(), laser, optics=optics or Optics(blur_px=blur_px))


def _edge(window):
    """Where a row changes from one level to the other, px from its first pixel; the levels may slope."""
    i = np.arange(len(window))
    left, right = np.polyfit(i[:4], window[:4], 1), np.polyfit(i[-4:], window[-4:], 1)
    share = (window - np.polyval(left, i)) / (np.polyval(right, i) - np.polyval(left, i))
    return i[-1] + 0.5 - share.sum()


def _centroid(window):
    return float(np.arange(len(window)) @ window / window.sum())


TILT = Rotation.from_rotvec([0.35, -0.3, 0.07])


def _print(roll_deg):
    """A plate whose edge between black and white passes the image's middle, and the same for the reference."""
    rotation = TILT * Rotation.from_rotvec([0.0, 0.0, np.radians(roll_deg)])
    pose = RigidTransform.from_components([0.0, 0.0, 200.0] - rotation.apply([0.0, 30.0, 0.0]), rotation)
    to_plate = pose.inv()

    def albedo(points):
        x, y = to_plate.apply(points).T[:2]
        return np.where((np.floor(x / 60.0) + np.floor(y / 60.0)) % 2 == 0, 0.06, 0.85)

    # a plate is thin; behind its front all is solid here
    reference = Reference(lambda points: -to_plate.apply(points)[:, 2], albedo)
    edge_uv = CAMERA.project(pose.apply(np.array([[0.0, y, 0.0] for y in np.linspace(5.0, 55.0, 500)])))
    return Placed(Plate(Checkerboard((2, 2), 60.0)), pose), reference, edge_uv[np.argsort(edge_uv[:, 1])]


@pytest.mark.parametrize(("blur_px", "roll_deg"), [(0.0, 0.0), (0.0, 40.0), (0.4, -20.0), (1.5, 10.0)])
def test_the_edge_of_a_print_is_where_it_projects_to(blur_px, roll_deg):
    plate, reference, edge_uv = _print(roll_deg)
    ambient = render_irradiance(_rig(blur_px=blur_px), [plate], laser_on=False, ambient_e_per_ms=1.0).ambient
    errors = []
    for row in range(22, 50):
        true_u = np.interp(row, edge_uv[:, 1], edge_uv[:, 0])
        columns = np.arange(int(true_u) - 11, int(true_u) + 13)
        errors.append(columns[0] + _edge(ambient[row, columns]) - true_u)
        if row in (28, 42):
            expected = reference.row(row, columns, blur_px)
            assert abs(_edge(ambient[row, columns]) - _edge(expected)) < 0.01
            np.testing.assert_allclose(ambient[row, columns], expected, atol=0.01)
    assert np.abs(errors).max() < 0.005


def test_the_lens_blurs_what_is_out_of_focus():
    # 400 px of 5 um are a focal length of 2 mm; the disc's diameter is f^2 / N / (s - f) * |z - s| / z
    optics = Optics(pixel_pitch_um=5.0, f_number=0.2, focus_mm=150.0, blur_px=0.3)
    plate, reference, edge_uv = _print(0.0)
    ambient = render_irradiance(_rig(optics=optics), [plate], laser_on=False, ambient_e_per_ms=1.0).ambient

    def blur_px(depth):
        return np.hypot(0.3, (2.0**2 / 0.2 / 148.0) * (depth - 150.0) / depth / 5e-3 / 4)

    assert np.ptp(blur_px(reference.hits(CAMERA.rays(np.array([[48.0, 12.0], [48.0, 56.0]])))[:, 2])) > 0.2
    for row in (16, 52):
        u = np.interp(row, edge_uv[:, 1], edge_uv[:, 0])
        columns = np.arange(int(u) - 11, int(u) + 13)
        expected = reference.row(row, columns, blur_px)
        np.testing.assert_allclose(ambient[row, columns], expected, atol=0.004)
        assert abs((ambient[row, columns] - expected).sum()) / np.ptp(expected) < 0.01


def _plane():
    pose = RigidTransform.from_components([0.0, 0.0, 200.0], TILT * Rotation.from_rotvec([np.pi, 0.0, 0.0]))
    block = Placed(Block(120.0, 120.0, 5.0), pose * RigidTransform.from_translation([0.0, 0.0, -5.0]))
    normal = pose.rotation.apply([0.0, 0.0, 1.0])
    return block, Reference(lambda points: (points - [0.0, 0.0, 200.0]) @ normal)


def _upright_rod():
    """A cylinder of 30 mm, oblique, that faces the camera at a depth of about 200 mm."""
    rotation = Rotation.from_rotvec([np.pi / 2 - 0.3, 0.0, 0.0])
    pose = RigidTransform.from_components([2.0, 0.0, 215.0] - rotation.apply([0.0, 0.0, 50.0]), rotation)
    inverse = pose.inv()

    def inside(points):
        return np.hypot(*inverse.apply(points).T[:2]) - 15.0

    return Placed(Rod(30.0, 100.0), pose), Reference(inside, depths_mm=(194.0, 224.0, 0.5))


@pytest.mark.parametrize("scene", [_plane, _upright_rod])
@pytest.mark.parametrize(("sheet_px", "blur_px"), [(0.2, 0.0), (0.2, 0.4), (0.6, 0.0), (0.6, 1.5)])
def test_the_stripe(scene, sheet_px, blur_px):
    rig = _rig(sheet_px, blur_px)
    part, reference = scene()
    laser = render_irradiance(rig, [part], laser_on=True, ambient_e_per_ms=0.0).laser
    for row in (20, 47):
        peak = int(laser[row].argmax())
        columns = np.arange(peak - 7, peak + 8)
        expected = reference.row(row, columns, blur_px, rig.laser)
        assert abs(_centroid(laser[row, columns]) - _centroid(expected)) < 0.01
        np.testing.assert_allclose(laser[row, columns], expected, atol=0.015 * expected.max())


@pytest.mark.parametrize("blur_px", [0.0, 0.8])
def test_the_outline_of_a_part(blur_px):
    part, reference = _upright_rod()
    ambient = render_irradiance(_rig(blur_px=blur_px), [part], laser_on=False, ambient_e_per_ms=1.0).ambient
    for row in (25, 36):
        lit = np.flatnonzero(ambient[row] > 0.2)
        columns = np.arange(lit[0] - 8, lit[0] + 3)
        expected = reference.row(row, columns, blur_px)
        # how far the outline is moved: the light that is too much over the light of a pixel just inside
        assert abs((ambient[row, columns] - expected).sum()) / ambient[row, lit[0] + 1] < 0.01
        np.testing.assert_allclose(ambient[row, columns], expected, atol=0.01)


@pytest.mark.parametrize("blur_px", [0.0, 0.8])
def test_the_edge_of_a_shadow(blur_px):
    """A rod, not seen by the camera at these rows, shades one end of the stripe on a plane."""
    rig = _rig(0.6, blur_px)
    plane, reference = _plane()
    axis_from = RigidTransform.from_components([40.0, 12.0, 150.0], Rotation.from_rotvec([0.0, np.pi / 2, 0.3]))
    rod = Placed(Rod(16.0, 60.0, -30.0), axis_from)
    inverse = axis_from.inv()

    def blocker(points):
        x, y, z = inverse.apply(points).T
        return np.maximum(np.hypot(x, y) - 8.0, np.abs(z) - 30.0)

    reference = Reference(reference.inside, blocker=blocker)
    laser = render_irradiance(rig, [plane, rod], laser_on=True, ambient_e_per_ms=0.0).laser
    rows, peak = np.arange(36, 41), int(laser[35].argmax())
    columns = np.arange(peak - 5, peak + 6)
    expected = np.array([reference.row(row, columns, blur_px, rig.laser) for row in rows])
    # along the stripe the light ends at the shadow: where, in rows
    assert laser[44:].max() < 1e-3 * laser[33].max()
    assert abs((laser[rows][:, columns] - expected).sum()) / expected[0].sum() < 0.01
    np.testing.assert_allclose(laser[rows][:, columns], expected, atol=0.02 * expected.max())
