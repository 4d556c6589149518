"""extract_stripe on whole images: what is found, what is not, and what it is told."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe

METHODS = ("gray-gravity", "improved-gray-gravity", "steger", "profile-fit")
SCENE = StripeScene(image_size=(120, 100), angle_deg=25.0)


def image_of(scene, seed=0):
    return render_stripe(scene, np.random.default_rng(seed))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((1, 1), dtype=np.uint8),
        np.zeros((1, 1, 3), dtype=np.uint8),
        np.zeros((60, 5), dtype=np.uint8),
        np.zeros((80, 90), dtype=np.uint16),
        np.full((80, 90), 255, dtype=np.uint8),
        np.full((80, 90, 3), 255, dtype=np.uint8),
        np.random.default_rng(0).normal(90, 9, (80, 90)).astype(np.uint8),
        np.tile(np.linspace(0, 255, 90).astype(np.uint8), (80, 1)),
        (np.indices((80, 90)).sum(axis=0) // 40 % 2 * 200).astype(np.uint8),
    ],
    ids=["1x1", "1x1 colour", "narrow", "black", "white", "white colour", "noise", "ramp", "checkers"],
)
def test_no_stripe_no_points(image, method):
    points = extract_stripe(image, None, StripeOptions(method=method))
    assert len(points) == 0
    assert points.uv.shape == (0, 2)


@pytest.mark.parametrize("method", METHODS)
@given(angle_deg=st.floats(0.0, 180.0), offset_px=st.floats(-3.0, 3.0))
@settings(max_examples=12, deadline=None)
def test_every_direction(method, angle_deg, offset_px):
    scene = replace(SCENE, angle_deg=angle_deg, offset_px=offset_px)
    points = extract_stripe(image_of(scene), None, StripeOptions(method=method))
    inner = ((points.uv > 8) & (points.uv < np.array([111, 91]))).all(axis=1)
    assert inner.sum() > 50
    assert np.abs(scene.error(points.uv)[inner]).max() < 0.2
    np.testing.assert_allclose(np.abs(points.normal[inner] @ scene.normal), 1.0, atol=0.01)
    np.testing.assert_allclose(points.width_px[inner], 2.0, atol=0.4)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_turns_with_the_image(method, turn):
    image = image_of(replace(SCENE, curve="arc", radius_px=60.0))
    options = StripeOptions(method=method)
    points = extract_stripe(image, None, options)
    turned = extract_stripe(np.ascontiguousarray(np.rot90(image, turn)), None, options)
    w, h = 119.0, 99.0
    u, v = points.uv.T
    expected = {0: (u, v), 1: (v, w - u), 2: (w - u, h - v), 3: (h - v, u)}[turn]
    far = np.hypot(turned.uv[:, None, 0] - expected[0], turned.uv[:, None, 1] - expected[1]).min(axis=1)
    # whether rows or columns suit an oblique piece is a matter of taste at 45 deg
    assert abs(len(turned) - len(points)) <= (0.2 if method == "gray-gravity" else 0.05) * len(points) + 3
    assert np.median(far) < 0.6  # the points need not fall on the same places along the stripe
    assert far.max() < 3.0 or method == "gray-gravity"


def shifted_pair(du, dv):
    """A stripe that fades out before the border of a patch, without a kink in its centre, and the patch moved by (du, dv)."""
    frame = np.full((140, 160), 10, dtype=np.uint8)
    stripe = image_of(replace(SCENE, image_size=(80, 60), noise=0.0, background=10.0))
    rise = np.sin(0.5 * np.pi * np.minimum(1.0, np.arange(80) / 15.0)) ** 2
    fade = rise * rise[::-1]
    patch = np.rint(10 + (stripe - 10.0) * fade).astype(np.uint8)
    still, moved = frame.copy(), frame.copy()
    still[40:100, 40:120] = patch
    moved[40 + dv : 100 + dv, 40 + du : 120 + du] = patch
    return extract_stripe(still), extract_stripe(moved)


@given(du=st.integers(-3, 3), dv=st.integers(-3, 3))
@settings(max_examples=10, deadline=None)
def test_moves_by_exactly_the_image_shift(du, dv):
    """By multiples of 4 px, so that the smaller images in which the stripe is sought move by whole pixels too."""
    a, b = shifted_pair(4 * du, 4 * dv)
    assert len(a) == len(b) > 40
    np.testing.assert_allclose(b.uv - a.uv, np.tile([4.0 * du, 4.0 * dv], (len(a), 1)), atol=1e-6)
    np.testing.assert_allclose(b.u_normal_px, a.u_normal_px, rtol=1e-6)


@given(du=st.integers(-9, 9), dv=st.integers(-9, 9))
@settings(max_examples=10, deadline=None)
def test_the_curve_moves_by_the_image_shift(du, dv):
    """By any whole number of pixels, as a curve: the places along it may differ."""
    a, b = shifted_pair(du, dv)
    moved = a.uv + np.array([du, dv])
    order = np.argsort(moved[:, 0])
    inner = (b.uv[:, 0] > moved[:, 0].min() + 5) & (b.uv[:, 0] < moved[:, 0].max() - 5)
    v = np.interp(b.uv[inner, 0], moved[order, 0], moved[order, 1])
    assert (np.abs(b.uv[inner, 1] - v) < 4 * np.sqrt(2) * b.u_normal_px[inner] + 0.005).all()


def test_points_are_in_order_about_one_a_pixel():
    points = extract_stripe(image_of(replace(SCENE, angle_deg=50.0)))
    assert np.unique(points.segment).tolist() == [0]
    step = np.hypot(*np.diff(points.uv, axis=0).T)
    np.testing.assert_allclose(step, 1.0, atol=0.1)


def test_pieces_of_a_stepped_part_each_once():
    """Flat, steep and oblique pieces that meet at corners, as on a stepped cylinder seen from above."""
    corners = np.array([[20.0, 30.0], [80.0, 32.0], [82.0, 100.0], [150.0, 160.0]])
    v, u = np.mgrid[0:190, 0:180].astype(float)
    nearest = np.full(u.shape, np.inf)
    for p, q in pairwise(corners):
        t = np.clip(((u - p[0]) * (q - p)[0] + (v - p[1]) * (q - p)[1]) / ((q - p) @ (q - p)), 0, 1)
        nearest = np.minimum(nearest, np.hypot(u - p[0] - t * (q - p)[0], v - p[1] - t * (q - p)[1]))
    light = 120 * np.exp(-0.5 * (nearest / 1.5) ** 2) + np.random.default_rng(2).normal(5, 1, u.shape)
    points = extract_stripe(np.rint(light.clip(0, 255)).astype(np.uint8))
    length = np.hypot(*np.diff(corners, axis=0).T).sum()
    assert 0.92 * length < len(points) < 1.02 * length
    separation = np.hypot(
        points.uv[:, None, 0] - points.uv[None, :, 0], points.uv[:, None, 1] - points.uv[None, :, 1]
    ) + np.diag(np.full(len(points), 9.0))
    assert separation.min() > 0.4
    away = np.hypot(points.uv[:, None, 0] - corners[:, 0], points.uv[:, None, 1] - corners[:, 1]).min(axis=1) > 6
    index = np.rint(points.uv).astype(int)
    assert nearest[index[away, 1], index[away, 0]].max() < 1.0


def test_a_dim_piece_beside_a_bright_one():
    """The stripe on the part has a height of 200, that on the table 10, with noise 1.5."""
    v, u = np.mgrid[0:200, 0:300].astype(float)
    bright = 200 * np.exp(-0.5 * ((v - 60.3) / 1.5) ** 2) * (u > 150)
    dim = 10 * np.exp(-0.5 * ((v - 120.0 - 0.3 * (u - 75)) / 1.5) ** 2) * (u < 150)
    image = np.rint((bright + dim + np.random.default_rng(0).normal(3, 1.5, u.shape)).clip(0, 255)).astype(np.uint8)
    points = extract_stripe(image)
    on_dim = points.uv[:, 0] < 148
    assert 130 < on_dim.sum() < 160
    error = (points.uv[on_dim, 1] - 120.0 - 0.3 * (points.uv[on_dim, 0] - 75)) / np.hypot(1, 0.3)
    assert np.abs(error).max() < 5 * np.median(points.u_normal_px[on_dim])
    assert np.median(points.u_normal_px[~on_dim]) < 0.1 * np.median(points.u_normal_px[on_dim])


def test_saturation_is_reported_and_costs_no_bias():
    scene = replace(SCENE, peak=600.0, offset_px=0.4)
    points = extract_stripe(image_of(scene))
    assert points.saturated.all()
    assert abs(scene.error(points.uv)[10:-10].mean()) < 0.01
    assert not extract_stripe(image_of(SCENE)).saturated.any()


def test_the_background_frame_takes_away_what_is_not_the_stripe():
    scene = replace(SCENE, background=80.0, one_sided=60.0, edge_px=1.0, peak=60.0)
    without = replace(scene, peak=0.0)
    # a bar that looks like a stripe, in both frames
    image, ground = image_of(scene, 1), image_of(without, 2)
    image[20:24, 60:], ground[20:24, 60:] = 220, 220
    points = extract_stripe(image, (ground * 0.98).astype(np.uint8))
    error = scene.error(points.uv)
    assert np.abs(error).max() < 0.5
    assert abs(error.mean()) < 0.02
    assert np.sqrt(np.mean(points.u_normal_px**2)) / error.std() == pytest.approx(1.0, abs=0.25)


def test_background_of_another_type_is_a_wrong_call():
    with pytest.raises(ValueError, match=r"uint16, the image \(100, 120\) uint8"):
        extract_stripe(image_of(SCENE), np.zeros((100, 120), dtype=np.uint16))


def red_on_white(core_clipped):
    """A red laser on white paper in a bright room: halo in red, core white; a blue bar and a dark edge beside."""
    rng = np.random.default_rng(4)
    scene = replace(SCENE, image_size=(200, 160), noise=0.0, background=0.0, peak=1.0, bits=16, sigma_px=2.5)
    core = render_stripe(scene, rng) / 257.0
    halo = render_stripe(replace(scene, sigma_px=9.0), rng) / 257.0
    green = 170.0 + 95.0 * core * (1.3 if core_clipped else 0.5)
    image = np.stack([205.0 + 80.0 * halo + 200.0 * core, green, green + 2.0], axis=-1)
    image[:, 185:] *= 0.2
    image[:, :10] = [60.0, 90.0, 200.0]
    image += rng.normal(0.0, 1.5, image.shape)
    return np.rint(image.clip(0, 255)).astype(np.uint8), scene


@pytest.mark.parametrize("core_clipped", [False, True])
def test_red_laser_on_white_paper_is_measured_in_green(core_clipped):
    image, scene = red_on_white(core_clipped)
    points = extract_stripe(image)
    paper = (points.uv[:, 0] > 18) & (points.uv[:, 0] < 177)
    assert paper.sum() > 150
    error = scene.error(points.uv[paper])
    assert np.sqrt(np.mean(error**2)) < 0.15
    np.testing.assert_allclose(np.median(points.width_px[paper]), 2.5, rtol=0.25)
    assert (~paper).sum() < 30


def test_a_white_core_is_found_after_the_background_was_subtracted():
    """A red laser on white paper, so strong that its core is as white as the paper; the camera chose its exposure itself."""
    rng = np.random.default_rng(9)
    scene = replace(SCENE, image_size=(240, 160), angle_deg=3.0, noise=0.0, background=0.0, peak=1.0, bits=16)
    core = render_stripe(replace(scene, sigma_px=3.6), rng) / 257.0
    halo = render_stripe(replace(scene, sigma_px=10.0), rng) / 257.0
    paper = np.full((160, 240, 3), 180.0)
    paper[:, :40] = 60.0
    paper[20:30, 60:] = 12.0
    light = np.stack([60.0 * halo + 130.0 * core, 110.0 * core - 6.0 * halo, 120.0 * core], axis=-1)
    ground = np.rint((1.04 * paper - 4.0 + rng.normal(0.0, 1.5, paper.shape)).clip(0, 255)).astype(np.uint8)
    image = np.rint((paper + light + rng.normal(0.0, 1.5, paper.shape)).clip(0, 255)).astype(np.uint8)
    points = extract_stripe(image, ground)
    on_paper = (points.uv[:, 0] > 48) & (points.uv[:, 0] < 230)
    assert on_paper.sum() > 170
    assert np.sqrt(np.mean(scene.error(points.uv[on_paper]) ** 2)) < 0.15
    assert np.abs(scene.error(points.uv)).max() < 2.0  # nothing else


def test_red_laser_in_the_dark_is_measured_in_red():
    rng = np.random.default_rng(1)
    grey = render_stripe(replace(SCENE, noise=0.0, background=0.0), rng).astype(float)
    image = np.stack([grey, 0.1 * grey, 70.0 + 0.1 * grey], axis=-1) + rng.normal(2, 1, (*grey.shape, 3))
    points = extract_stripe(np.rint(image.clip(0, 255)).astype(np.uint8))
    assert np.median(points.intensity) == pytest.approx(197, rel=0.05)
    assert np.abs(SCENE.error(points.uv)).max() < 0.1


def test_the_user_names_channel_and_colour():
    rng = np.random.default_rng(1)
    grey = render_stripe(replace(SCENE, noise=0.0, background=0.0), rng).astype(float)
    image = np.stack([grey, 0.5 * grey, 0.1 * grey], axis=-1) + rng.normal(4, 1, (*grey.shape, 3))
    image = np.rint(image.clip(0, 255)).astype(np.uint8)
    green = extract_stripe(image, None, StripeOptions(channel="green"))
    assert np.median(green.intensity) == pytest.approx(98, rel=0.05)
    assert len(extract_stripe(image, None, StripeOptions(laser_colour="red"))) > 100
    assert len(extract_stripe(image, None, StripeOptions(laser_colour="blue"))) == 0


def test_sixteen_bits_give_the_same_centres():
    coarse = extract_stripe(image_of(SCENE))
    fine = extract_stripe(image_of(replace(SCENE, bits=16)))
    assert len(coarse) == len(fine)
    assert np.median(np.abs(SCENE.error(fine.uv))) < 0.02
    assert np.median(fine.intensity) == pytest.approx(257 * np.median(coarse.intensity), rel=0.01)


def test_of_two_lines_the_brightest_may_be_kept():
    scene = replace(SCENE, angle_deg=5.0)
    first = image_of(scene).astype(int)
    second = image_of(replace(scene, offset_px=30.0, peak=60.0, background=0.0, noise=0.0))
    image = np.clip(first + second, 0, 255).astype(np.uint8)
    both = extract_stripe(image)
    one = extract_stripe(image, None, StripeOptions(keep="brightest"))
    inner = (one.uv[:, 0] > 8) & (one.uv[:, 0] < 111)
    assert len(both) > 1.8 * len(one)
    assert inner.sum() > 90
    assert np.abs(scene.error(one.uv[inner])).max() < 0.1


def row_of_dashes(length_px, gap_px, angle_deg, row_deg, n=8, sigma_px=0.9, line=False):
    """Pieces of stripe one after the other along a row, as on a thread, and where they are: image and (n, 2) centres."""
    v, u = np.mgrid[0 : 160 * 4, 0 : 160 * 4] / 4.0 - 0.375
    along, row = np.radians([angle_deg, row_deg])
    t = (np.arange(n) - 0.5 * (n - 1)) * (length_px + gap_px)
    centres = np.array([79.7, 80.2]) + t[:, None] * [np.cos(row), np.sin(row)]
    light = np.zeros(u.shape)
    for x, y in centres:
        d = -np.sin(along) * (u - x) + np.cos(along) * (v - y)
        s = np.cos(along) * (u - x) + np.sin(along) * (v - y)
        light += np.exp(-0.5 * (d / sigma_px) ** 2) * (np.abs(s) < 0.5 * length_px)
    if line:
        light += np.exp(-0.5 * ((u - 12.0) / sigma_px) ** 2) * (v > 100)
    light = light.reshape(160, 4, 160, 4).mean(axis=(1, 3))
    noise = np.random.default_rng(4).normal(5.0, 1.5, light.shape)
    return np.rint((120 * light + noise).clip(0, 255)).astype(np.uint8), centres


def across(points, centre, angle_deg):
    angle = np.radians(angle_deg)
    return (points.uv - centre) @ [-np.sin(angle), np.cos(angle)]


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 70.0, 90.0])
def test_a_row_of_short_pieces_is_found(angle_deg):
    """Of 8 px each; in a smaller image the row looks like one line in another direction."""
    image, centres = row_of_dashes(8.0, 6.0, angle_deg, angle_deg + 65.0)
    points = extract_stripe(image)
    assert np.unique(points.segment).size == len(centres)
    for k in range(len(centres)):
        piece = points.select(points.segment == k)
        centre = centres[np.argmin(np.hypot(*(centres - piece.uv.mean(axis=0)).T))]
        error = across(piece, centre, angle_deg)
        assert 4 <= len(piece) <= 9
        assert (np.abs(error) < 4.0 * piece.u_normal_px).all()
        assert np.abs(error[1:-1]).max() < 0.1


def test_short_pieces_beside_a_long_one():
    image, centres = row_of_dashes(7.0, 5.0, 30.0, 95.0, line=True)
    points = extract_stripe(image)
    near = np.hypot(points.uv[:, None, 0] - centres[:, 0], points.uv[:, None, 1] - centres[:, 1]).min(axis=0)
    assert (near < 1.0).sum() >= 7


def test_the_ends_of_short_pieces_say_that_they_are_doubtful():
    image, _ = row_of_dashes(10.0, 8.0, 20.0, 85.0, n=6)
    points = extract_stripe(image)
    for k in range(6):
        u = points.u_normal_px[points.segment == k]
        assert min(u[0], u[-1]) > 0.2 > 0.05 > u[len(u) // 2]


def with_spots(spot, places, seed=3):
    """A long stripe, and spots beside it."""
    v, u = np.mgrid[0:120, 0:160].astype(float)
    light = 150 * np.exp(-0.5 * ((u - 30.4 - 0.1 * v) / 1.0) ** 2) + np.random.default_rng(seed).normal(5, 1.5, u.shape)
    for x, y in places:
        light += spot(u - x, v - y)
    points = extract_stripe(np.rint(light.clip(0, 255)).astype(np.uint8))
    return np.abs(points.uv[:, 0] - 30.4 - 0.1 * points.uv[:, 1]), np.unique(points.segment).size


@pytest.mark.parametrize(
    ("spot", "places"),
    [
        (lambda x, y: 250.0 * ((x == 0) & (y == 0)), [(60, 40), (90, 70), (100, 20)]),
        (lambda x, y: 250.0 * ((np.abs(x) <= 1) & (np.abs(y) <= 1)), [(50, 40), (56, 52), (100, 20)]),
        (lambda x, y: 150.0 * np.exp(-0.5 * (x * x + y * y)), [(50, 40), (57, 47)]),
        (lambda x, y: 250.0 * np.exp(-0.5 * (x * x + y * y) / 4.0), [(50, 40), (60, 55)]),
        (lambda x, y: 150.0 * np.exp(-0.5 * x * x) * (np.abs(y) < 4), [(110, 60)]),
        (lambda x, y: 15.0 * np.exp(-0.5 * x * x) * (np.abs(y) < 4), [(52, 60)]),
    ],
    ids=["bright pixels", "hot spots", "round spots", "glints", "alone", "faint"],
)
def test_spots_of_light_are_not_short_pieces(spot, places):
    far, pieces = with_spots(spot, places)
    assert len(far) > 100
    assert far.max() < 1.0
    assert pieces == 1


def test_salt_noise_is_not_short_pieces():
    u = np.mgrid[0:200, 0:240][1].astype(float)
    rng = np.random.default_rng(6)
    light = 150 * np.exp(-0.5 * ((u - 60.4) / 1.0) ** 2) + rng.normal(5, 1.5, u.shape)
    light[(rng.random(u.shape) < 0.002) & (u > 75)] = 255.0
    points = extract_stripe(np.rint(light.clip(0, 255)).astype(np.uint8))
    assert len(points) > 170
    assert np.abs(points.uv[:, 0] - 60.4).max() < 0.5


def test_short_dashes_of_which_no_piece_stays():
    v, u = np.mgrid[:96, :128]
    for seed in range(300):
        rng = np.random.default_rng(seed)
        light = rng.normal(6.0, 1.0, u.shape)
        for _ in range(rng.integers(1, 4)):
            y, x = rng.integers(8, 88), rng.integers(8, 120)
            length, angle, height, sigma = rng.integers(3, 8), *rng.uniform((0.0, 3.0, 0.5), (np.pi, 40.0, 2.5))
            across = (u - x) * np.sin(angle) - (v - y) * np.cos(angle)
            along = (u - x) * np.cos(angle) + (v - y) * np.sin(angle)
            light += height * np.exp(-0.5 * (across / sigma) ** 2) * (np.abs(along) < length)
        points = extract_stripe(np.rint(light.clip(0.0, 255.0)).astype(np.uint8))
        assert np.isfinite(points.uv).all()
