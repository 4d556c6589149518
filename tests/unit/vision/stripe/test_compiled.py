"""The compiled stripe stage against the plain one: step by step, and as a whole over known truth."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.vision.stripe import chain_kernels, extract
from rotaline.vision.stripe import measure as measuring
from rotaline.vision.stripe.background import fit_steps
from rotaline.vision.stripe.centre_kernels import subtract_sides, weighted_centroids
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.direction_kernels import local_lines
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe
from rotaline.vision.stripe.find import find
from rotaline.vision.stripe.fit_kernels import fit_gaussians
from rotaline.vision.stripe.gravity import clear_points_of
from rotaline.vision.stripe.gravity_kernels import line_normals
from rotaline.vision.stripe.judge_kernels import sound_ends
from rotaline.vision.stripe.measure_kernels import best_centres
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.piece_kernels import medians, points_together
from rotaline.vision.stripe.pieces import counting, doubtful_ends, long_enough
from rotaline.vision.stripe.plain import centres as plain_centres
from rotaline.vision.stripe.plain import curve as plain_curve
from rotaline.vision.stripe.plain import ends as plain_ends
from rotaline.vision.stripe.plain import uncertainty as plain_uncertainty
from rotaline.vision.stripe.plain.extract import extract_stripe_plain
from rotaline.vision.stripe.plain.strips import pixel_strips
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.profiles import sample_profiles
from rotaline.vision.stripe.row_kernels import whole_lines
from rotaline.vision.stripe.strip_kernels import BLOCK
from rotaline.vision.stripe.strips import strips_of
from rotaline.vision.stripe.trace import trace_stripe
from rotaline.vision.stripe.trace_kernels import normals
from rotaline.vision.stripe.uncertainty_kernels import scatter_and_floor

BASE = StripeScene(image_size=(160, 140), angle_deg=20.0)


def points_on(scene, n=90):
    t = np.linspace(-45.0, 45.0, n)[:, None]
    uv = scene.middle + t * scene.direction
    return np.ascontiguousarray(uv), np.tile(scene.normal, (n, 1))


@pytest.mark.parametrize("angle_deg", [0.0, 3.0, 37.0, 45.0, 80.0, 133.0, 271.0])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_a_strip_has_the_same_pixels(angle_deg, kind):
    """At all places, also where the image ends."""
    rng = np.random.default_rng(3)
    image = (rng.integers(0, 256, (60, 50)) * (257 if kind is np.uint16 else 1)).astype(kind)
    source = image if kind is not np.float32 else image.astype(np.uint8)
    angle = np.radians(angle_deg) + 1e-3 * rng.normal(size=40)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    uv = rng.uniform(0.0, [49.0, 59.0], (40, 2))
    reach = rng.uniform(3.0, 9.0, 40)
    plane = Plane(image, source)
    plain = pixel_strips(image.astype(np.float32), source >= plane.limit, uv, normal, reach)
    strips = strips_of(plane, uv, normal, reach)
    for i in range(40):
        own = slice(strips.first[i], strips.first[i] + BLOCK * strips.count[i], BLOCK)
        used, expected = strips.share[own] > 1e-4, plain.valid[i] & (plain.weight[i] > 1e-4)
        order, other = np.argsort(strips.distance[own][used]), np.argsort(plain.offset_px[i][expected])
        np.testing.assert_allclose(strips.distance[own][used][order], plain.offset_px[i][expected][other], atol=1e-4)
        total = (strips.share[own] * strips.level[own]).sum()
        assert total == pytest.approx((plain.weight * plain.value)[i].sum(), rel=1e-4)
        clipped = strips.share[own][strips.clipped[own]].sum() if strips.hits[i] else 0.0
        assert clipped == pytest.approx(plain.weight[i][plain.clipped[i]].sum(), abs=1e-3)


@pytest.mark.parametrize("sigma_px", [0.7, 1.5, 3.0])
@pytest.mark.parametrize("window", [1.0, 2.0])
def test_the_centroid_is_the_fixed_point_of_the_plain_one(sigma_px, window):
    """Steps end when they are short; what is left to the fixed point is nothing beside the uncertainty."""
    scene = replace(BASE, sigma_px=sigma_px, speckle_contrast=0.1)
    image = render_stripe(scene, np.random.default_rng(5))
    uv, normal = points_on(scene)
    n = len(uv)
    width, start = np.full(n, 1.05 * sigma_px), np.full(n, 0.1)
    reach = 3.5 * window * width + 2.0
    plain = pixel_strips(image.astype(np.float32), None, uv, normal, reach)
    ground = np.full_like(plain.value, scene.background)
    slope = np.full(n, 1e-4)
    expected = plain_centres.weighted_centroid(plain, ground, slope, start, width, window, 30)
    strips = strips_of(Plane(image, image), uv, normal, reach)
    shift, u, measured, height = (np.empty(n) for _ in range(4))
    level = strips.level - np.float32(scene.background)
    weighted_centroids(
        strips.first, strips.count, strips.distance, level, strips.share, slope, start, width, window, 1e-3,
        np.ones(n // BLOCK + 1, dtype=bool), shift, u, measured, height,
    )  # fmt: skip
    assert np.abs(shift - expected.shift_px).max() < 2e-2 * np.median(2.0 * expected.u_px)
    np.testing.assert_allclose(u, expected.u_px, rtol=2e-3)
    np.testing.assert_allclose(measured, expected.width_px, rtol=2e-3)
    np.testing.assert_allclose(height, expected.height, rtol=2e-3)


@pytest.mark.parametrize("angle_deg", [3.0, 45.0, 83.0])
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"sigma_px": 0.8},
        {"speckle_contrast": 0.1, "peak": 100.0, "sigma_px": 1.0},
        {"peak": 300.0},
        {"one_sided": 36.0},
    ],
)
def test_block_by_block_as_from_kept_strips(angle_deg, change, monkeypatch):
    """Centres, uncertainties, widths, heights, clipped pixels; the stripe leaves the image. Steps are left to the other way."""
    scene = replace(BASE, **{"sigma_px": 1.4, "angle_deg": angle_deg} | change)
    found, plane = find(render_stripe(scene, np.random.default_rng(5)), None, StripeOptions())
    trace = trace_stripe(found, plane, 4)
    assert trace is not None
    at_once = measuring._clear(trace, plane)
    monkeypatch.setattr(measuring, "_clear", lambda *_: None)
    kept = measuring.measure(trace, plane, StripeOptions())
    if scene.one_sided:
        assert at_once is None
        assert kept.u_edge_px.any()
        return
    assert at_once is not None
    np.testing.assert_array_equal(at_once.saturated, kept.saturated)
    assert at_once.saturated.any() == (scene.peak == 300.0)
    assert at_once.noise[0] == pytest.approx(kept.noise[0], rel=0.15)
    inner = slice(8, -8)
    new, old = at_once.centres, kept.centres
    u_px = np.hypot(old.u_px * kept.noise, kept.floor_px)[inner]
    assert np.sqrt(np.mean(((new.shift_px - old.shift_px)[inner] / u_px) ** 2)) < 0.3
    np.testing.assert_allclose(new.u_px[inner], old.u_px[inner], rtol=0.1)
    np.testing.assert_allclose(new.width_px[inner], old.width_px[inner], rtol=0.1)
    np.testing.assert_allclose(new.height[inner], old.height[inner], rtol=0.05)


def test_faint_centres_are_left_to_kept_strips():
    for peak, clear in ((100.0, True), (9.0, False)):
        image = render_stripe(replace(BASE, sigma_px=1.2, peak=peak, noise=1.0), np.random.default_rng(5))
        found, plane = find(image, None, StripeOptions())
        trace = trace_stripe(found, plane, 4)
        assert trace is not None
        assert (measuring._clear(trace, plane) is not None) == clear
        assert len(extract_stripe(image)) > 100


def test_grey_gravity_reads_only_its_own_strips():
    """A wide stripe is traced and then measured on strips of one pixel a line: the same bits each time, whatever stands in memory beside them."""
    image = render_stripe(replace(BASE, sigma_px=4.0), np.random.default_rng(2))
    options = StripeOptions(method="gray-gravity")
    first = extract_stripe(image, None, options)
    assert len(first) > 50
    for value in (np.nan, 0.0, 1e3):
        freed = [np.full(n, value, np.float32) for n in range(500, 40000, 500)]
        del freed
        again = extract_stripe(image, None, options)
        np.testing.assert_array_equal(again.uv, first.uv)
        np.testing.assert_array_equal(again.u_normal_px, first.u_normal_px)


def test_rows_and_columns_are_chosen_by_lengths():
    """Behind a corner the points of a chain found row by row are 2.2 px apart; the columns begin as soon as behind one found column by column."""
    v = np.arange(100.0)
    by_rows = np.column_stack([50.0 + 2.0 * np.maximum(v - 60.0, 0.0), v])
    u = np.arange(50.0, 131.0)
    by_columns = np.concatenate([by_rows[:60], np.column_stack([u, 60.0 + 0.5 * (u - 50.0)])])
    begin = []
    for chain in (by_rows, by_columns):
        uv, starts, along, *_ = whole_lines(chain, np.zeros(len(chain), dtype=np.int64), np.full(len(chain), 3.0))
        np.testing.assert_array_equal(along[starts[:-1]], [[1.0, 0.0], [0.0, 1.0]])
        begin.append(uv[starts[1], 0])
    assert 50.0 < begin[0] == pytest.approx(begin[1], abs=2.0)
    assert begin[0] < 60.0


@pytest.mark.parametrize("steep", [False, True])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_chains_on_whole_lines_stay_as_they_were_found(steep, sense):
    """A chain without a gap is taken as it is; one with a gap is crossed with the lines, which gives the same points again and one in the gap."""
    t = np.arange(200.0)
    place, line = 80.0 + 0.5 * t + 3.0 * np.sin(t / 20.0), 300.0 + sense * t
    chain = np.column_stack([place, line] if steep else [line, place])
    some = t != 70
    number, spread = np.zeros(200, dtype=np.int64), np.full(200, 4.0)
    uv, starts, along, stretch, wide = whole_lines(chain, number, spread)
    crossed, edges, lines, length, width = whole_lines(chain[some], number[some], spread[some])
    np.testing.assert_array_equal(starts, edges)
    np.testing.assert_array_equal(along, lines)
    np.testing.assert_array_equal(uv, chain)
    np.testing.assert_allclose(crossed[some], chain[some], atol=1e-9)
    np.testing.assert_allclose(stretch, length, rtol=0.03)
    np.testing.assert_allclose(wide, width, atol=0.1)


@pytest.mark.parametrize("angle_deg", [20.0, 51.0, 100.0])
@pytest.mark.parametrize(("peak", "rtol"), [(150.0, 0.1), (400.0, 0.5)])
def test_grey_gravity_from_the_tops_is_that_from_a_bell(angle_deg, peak, rtol, monkeypatch):
    """Also where the stripe leaves the image, and where its core is clipped."""
    scene = replace(BASE, image_size=(100, 140), sigma_px=1.2, angle_deg=angle_deg, peak=peak)
    image = render_stripe(scene, np.random.default_rng(5))
    options = StripeOptions(method="gray-gravity")
    found, plane = find(image, None, options)
    assert found.clear
    assert clear_points_of(found, plane, 4, options) is not None
    from_tops = extract_stripe(image, None, options)
    monkeypatch.setattr(extract, "clear_points_of", lambda *_: None)
    from_bell = extract_stripe(image, None, options)
    line = 0 if angle_deg < 45.0 else 1
    _, one, other = np.intersect1d(from_tops.uv[:, line], from_bell.uv[:, line], return_indices=True)
    assert len(one) >= max(len(from_tops), len(from_bell)) - 1
    u_px = from_bell.u_normal_px[other]
    off = (from_tops.uv[one] - from_bell.uv[other])[:, 1 - line] * from_bell.normal[other, 1 - line]
    assert np.sqrt(np.mean((off / u_px) ** 2)) < 0.3
    np.testing.assert_allclose(from_tops.u_normal_px[one].mean(), u_px.mean(), rtol=rtol)
    np.testing.assert_array_equal(from_tops.saturated[one], from_bell.saturated[other])


def test_grey_gravity_in_an_image_too_small_for_strips():
    image = render_stripe(replace(BASE, image_size=(160, 44), sigma_px=1.2, angle_deg=2.0), np.random.default_rng(5))
    options = StripeOptions(method="gray-gravity")
    found, plane = find(image, None, options)
    assert clear_points_of(replace(found, clear=True), plane, 4, options) is None
    assert len(extract_stripe(image, None, options)) > 150


@pytest.mark.parametrize("steep", [False, True])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_normals_of_points_on_whole_lines(steep, sense):
    t = np.arange(200.0)
    place = 5.0 + 0.3 * np.abs(t - 90.0) + np.random.default_rng(1).normal(0.0, 0.08, 200) + 4.0 * (t > 150)
    line, starts = 300.0 + sense * t, np.array([0, 60, 130, 135, 200])
    uv = np.column_stack([place, line] if steep else [line, place])
    along = np.tile([1.0, 0.0] if steep else [0.0, 1.0], (200, 1))
    np.testing.assert_allclose(line_normals(uv, starts, along), normals(uv, starts, 0.05), atol=1e-9)


@pytest.mark.parametrize("lanes", [1, 3])
def test_rough_centres_of_strips_of_one_and_of_three_lanes(lanes):
    scene = replace(BASE, noise=0.0, sigma_px=2.5)
    image = render_stripe(scene, np.random.default_rng(5))
    uv, normal = points_on(scene)
    n = len(uv)
    s = strips_of(Plane(image, image), uv, normal, np.full(n, 14.0), lanes)
    shift, *_ = best_centres(
        uv, np.array([0, n]), normal, np.full(n, 2.5), np.ones(n), s.first, s.count, s.distance,
        s.level - np.float32(scene.background), s.share, np.zeros(n), np.zeros(n), 1.0, False, 0.0, np.inf,
    )  # fmt: skip
    assert np.abs(shift).max() < 0.1


def test_the_sides_give_the_background():
    rows, columns = np.mgrid[0:80, 0:90]
    image = (9000.0 + 40.0 * columns - 25.0 * rows).astype(np.uint16)
    angle = np.radians(30.0)
    uv, normal = np.array([[40.3, 41.7]]), np.array([[np.cos(angle), np.sin(angle)]])
    strips = strips_of(Plane(image, image), uv, normal, np.array([12.0]))
    line, sides = np.empty((1, 3)), np.empty((1, 2))
    subtract_sides(
        strips.first, strips.count, strips.distance, strips.level, strips.share, strips.clipped, strips.hits, np.array([2.0]), line,
        sides,
    )  # fmt: skip
    assert line[0, 0] == pytest.approx(9000.0 + 40.0 * 40.3 - 25.0 * 41.7, abs=3.0)
    assert line[0, 1] == pytest.approx(40.0 * normal[0, 0] - 25.0 * normal[0, 1], abs=0.5)
    assert sides[0, 0] < sides[0, 1]


@pytest.mark.parametrize("fit_background", [False, True])
def test_the_fit_is_the_plain_fit(fit_background):
    scene = replace(BASE, peak=400.0, background=0.0, noise=1.0)
    image = render_stripe(scene, np.random.default_rng(6))
    uv, normal = points_on(scene, 40)
    n = len(uv)
    width, start, height = np.full(n, 2.1), np.full(n, 0.2), np.full(n, 300.0)
    reach = np.full(n, 10.0)
    plain = pixel_strips(image.astype(np.float32), image >= 253, uv, normal, reach)
    zero = np.zeros_like(plain.value)
    expected = plain_centres.fit_gaussian(plain, zero, start, width, height, fit_background)
    s = strips_of(Plane(image, image), uv, normal, reach)
    shift, u, wide, high = fit_gaussians(
        s.first, s.count, s.distance, s.level, s.share, s.clipped, s.hits, start, width, height, fit_background
    )
    np.testing.assert_allclose(shift, expected.shift_px, atol=1e-4)
    np.testing.assert_allclose(u, expected.u_px, rtol=1e-3)
    np.testing.assert_allclose(wide, expected.width_px, rtol=1e-3)
    np.testing.assert_allclose(high, expected.height, rtol=1e-3)


def wandering_chains(seed=2):
    """A smooth chain, one with a corner and a jump, one that goes back, and a short one."""
    rng = np.random.default_rng(seed)
    t = np.arange(80.0)
    smooth = np.column_stack([t, 20.0 + 0.01 * t**2])
    corner = np.column_stack([np.minimum(t, 40.0), 200.0 + np.maximum(t - 40.0, 0.0)])
    corner[60:, 0] += 4.0
    back = np.column_stack([t, np.full(80, 300.0)])
    back[30] -= [1.5, 0.0]
    short = np.column_stack([np.arange(5.0), np.full(5, 400.0)])
    uv = np.concatenate([smooth, corner, back, short]) + rng.normal(0.0, 0.05, (245, 2))
    return Chains(uv, np.repeat([0, 1, 2, 3], [80, 80, 80, 5]))


def test_chains_are_worked_on_alike():
    chains = wandering_chains()
    starts = chain_kernels.starts_of(chains.chain)
    np.testing.assert_array_equal(starts, [0, 80, 160, 240, 245])
    smooth, tangent = np.empty_like(chains.uv), np.empty_like(chains.uv)
    local_lines(chains.uv, starts, 6, 0.05, smooth, tangent)
    expected = plain_curve.local_lines(chains, 6)
    np.testing.assert_allclose(smooth, expected[0], atol=1e-6)
    np.testing.assert_allclose(tangent, expected[1], atol=1e-6)
    dense, edges, carried = chain_kernels.resample(chains.uv, starts, chains.uv[:, 0].copy())
    np.testing.assert_allclose(dense, plain_curve.resample(chains).uv, atol=1e-9)
    np.testing.assert_allclose(carried, dense[:, 0], atol=1e-9)
    assert edges[-1] == len(dense)
    good = np.random.default_rng(1).random(245) > 0.03
    index, pieces = chain_kernels.break_chains(chains.uv, tangent, good, starts, 6)
    broken, kept = plain_curve.break_chains(chains, tangent, good, 6)
    np.testing.assert_array_equal(index, np.flatnonzero(kept))
    assert list(zip(pieces[:-1].tolist(), pieces[1:].tolist(), strict=True)) == broken.spans()
    width = 2.0 + 0.02 * np.random.default_rng(4).normal(size=245)
    width[index[:3]] = 1.2
    begin, end = sound_ends(chains.uv, width, index, pieces)
    sound = plain_ends.sound_ends(broken, width[index])
    assert not sound.all()
    np.testing.assert_array_equal(
        np.concatenate([np.arange(*ends) for ends in zip(begin, end, strict=True)]), np.flatnonzero(sound)
    )
    out = np.empty(245)
    chain_kernels.window_mean(chains.uv[:, 0].copy(), starts, 10, out)
    np.testing.assert_allclose(out, chains.window_mean(chains.uv[:, 0], 10), atol=1e-9)


@pytest.mark.parametrize("turned", [False, True])
def test_chains_are_joined_alike(turned):
    t = np.arange(20.0)
    pieces = [np.column_stack([a + t, np.full(20, v)]) for a, v in ((0.0, 5.0), (23.0, 5.0), (46.0, 5.5), (0.0, 40.0))]
    if turned:
        pieces[1] = pieces[1][::-1]
    chains = Chains(np.concatenate(pieces), np.repeat(np.arange(4), 20))
    _, tangent = plain_curve.local_lines(chains, 6, 0.3)
    joined, order = plain_curve.join_chains(chains, tangent, 9.0)
    got, edges = chain_kernels.join_chains(chains.uv, tangent, np.arange(0, 81, 20), 9.0)
    np.testing.assert_array_equal(got, order)
    np.testing.assert_array_equal(edges, [0, 60, 80])
    assert len(joined.spans()) == 2


def test_points_of_another_width_are_told_apart():
    width = 2.0 + 0.05 * np.random.default_rng(0).normal(size=120)
    width[40:43], width[100] = 3.5, np.nan
    good = np.ones(120, dtype=bool)
    chain_kernels.alike(width, np.array([0, 120]), 0.2, good)
    assert np.flatnonzero(~good).tolist() == [40, 41, 42, 100]


def test_short_pieces_close_together_count_as_one():
    """Short ones in a row, one that does not fit among them, one alone, and one beside a long one."""
    places = [0.0, 15.0, 18.0, 30.0, 200.0, 400.0, 430.0]
    counts = [5, 5, 2, 4, 6, 20, 3]
    uv = np.concatenate([np.column_stack([a + np.arange(n), np.zeros(n)]) for a, n in zip(places, counts, strict=True)])
    segment = np.repeat(np.arange(7), counts)
    fits = np.array([True, True, False, True, True, True, True])
    assert points_together(uv, segment, fits, 10.0, 20.0).tolist() == [14, 14, 0, 14, 6, 23, 23]
    assert points_together(uv, segment, fits, 10.0, 5.0).tolist() == [5, 5, 0, 4, 6, 20, 3]
    assert medians(uv[:, 0].copy(), segment).tolist() == [np.median(uv[segment == k, 0]) for k in range(7)]


@pytest.mark.parametrize("crowded", [False, True])
def test_the_same_pieces_count(crowded):
    """One pass over all pieces, held against the two steps it stands for."""
    rng = np.random.default_rng(4)
    dropped = 0
    for _ in range(40):
        counts = rng.integers(4, 40, rng.integers(1, 9))
        segment = np.repeat(np.arange(len(counts)), counts)
        n = len(segment)
        uv = np.column_stack([np.arange(n) + rng.choice([2.0, 40.0], len(counts)).cumsum()[segment], np.zeros(n)])
        width = rng.choice([1.0, 1.2, 4.0], len(counts))[segment] + 0.05 * rng.random(n)
        height = rng.choice([10.0, 100.0, 120.0], len(counts))[segment] * (0.1 + 0.9 * rng.random(n))
        points = StripePoints(
            uv, np.tile([0.0, 1.0], (n, 1)), width, height, 0.1 * np.ones(n), np.zeros(n, dtype=bool), segment
        )
        expected = doubtful_ends(points if crowded else long_enough(points, 10.0))
        got = counting(points, 10.0, crowded)
        np.testing.assert_array_equal(got.uv, expected.uv)
        np.testing.assert_allclose(got.u_normal_px, expected.u_normal_px, rtol=1e-12)
        np.testing.assert_array_equal(got.segment, expected.segment)
        dropped += n - len(got)
    assert dropped > 100


@pytest.mark.parametrize("n", [30, 301])
def test_scatter_and_its_unexplained_part_are_the_plain_ones(n):
    rng = np.random.default_rng(9)
    uv = np.column_stack([np.arange(float(n)), np.zeros(n)])
    normal = np.tile([0.0, 1.0], (n, 1))
    shift, u = 0.05 * rng.normal(size=n), 0.02 + 0.002 * rng.random(n)
    chains = Chains(uv + shift[:, None] * normal, np.zeros(n, dtype=np.int64))
    expected = plain_uncertainty.scatter_and_floor(chains, normal, 1.5 * u)
    got = scatter_and_floor(uv, np.array([0, n]), normal, shift, u, np.full(n, 1.5))
    np.testing.assert_allclose(got, expected, rtol=0.03)


def test_order_statistics():
    rng = np.random.default_rng(3)
    for n in (1, 2, 3, 4, 7, 50, 501):
        values = rng.integers(0, 20, n).astype(float)
        assert chain_kernels.median_of(values.copy(), n) == np.median(values)


def test_no_step_is_seen_where_no_pixel_can_be_used():
    uv, normal = np.array([[20.0, 15.0], [20.0, 16.0]]), np.tile([1.0, 0.0], (2, 1))
    image = np.full((30, 40), 255.0, dtype=np.float32)
    profiles = sample_profiles(image, image > 250.0, uv, normal, np.full(2, 9.0))
    one = np.ones(2)
    steps = fit_steps(profiles, Chains(uv, np.zeros(2, dtype=np.int64)), 0.0 * one, one, one)
    assert not steps.taken.any()


SCENES = {
    "line": BASE,
    "steep": replace(BASE, angle_deg=83.0, offset_px=0.3),
    "45 deg": replace(BASE, angle_deg=45.0),
    "thin": replace(BASE, sigma_px=0.7),
    "wide": replace(BASE, sigma_px=4.0),
    "faint": replace(BASE, peak=40.0),
    "arc": replace(BASE, curve="arc", radius_px=80.0),
    "step": replace(BASE, curve="step"),
    "clipped": replace(BASE, peak=500.0),
    "edge": replace(BASE, one_sided=36.0, edge_px=1.0),
    "speckle": replace(BASE, speckle_contrast=0.1),
    "16 bit": replace(BASE, bits=16),
}


def errors_of(points, scene):
    inner = ((points.uv > 8) & (points.uv < np.array(scene.image_size) - 9.0)).all(axis=1)
    return scene.error(points.uv[inner]), points.u_normal_px[inner], points.width_px[inner]


@pytest.mark.parametrize("method", ["improved-gray-gravity", "gray-gravity", "steger", "profile-fit"])
def test_as_good_as_the_plain_one(method):
    """Root mean square error, number of points, stated uncertainty, width: scene by scene, and over all of them."""
    options = StripeOptions(method=method)
    ratios, stated, numbers = [], [], []
    for number, (name, scene) in enumerate(SCENES.items()):
        image = render_stripe(scene, np.random.default_rng(number))
        new, new_u, new_width = errors_of(extract_stripe(image, None, options), scene)
        old, old_u, old_width = errors_of(extract_stripe_plain(image, None, options), scene)
        ratios.append(np.sqrt(np.mean(new**2)) / np.sqrt(np.mean(old**2)))
        stated.append(np.median(new_u) / np.median(old_u))
        numbers.append((len(new), len(old)))
        assert ratios[-1] < 1.15, name  # one image: what scatters between two ways to measure it
        assert len(new) >= 0.97 * len(old) - 3, name
        assert np.median(new_width) == pytest.approx(np.median(old_width), rel=0.04), name
    assert np.exp(np.mean(np.log(ratios))) < 1.01
    assert np.exp(np.mean(np.log(stated))) == pytest.approx(1.0, abs=0.08)
    assert sum(n for n, _ in numbers) >= 0.995 * sum(n for _, n in numbers)


def test_colour_and_background_as_the_plain_one():
    rng = np.random.default_rng(1)
    grey = render_stripe(replace(BASE, noise=0.0, background=0.0), rng).astype(float)
    room = 60.0 + 40.0 * (np.indices(grey.shape).sum(axis=0) // 30 % 2)
    light = np.stack([room + 0.6 * grey, room + 0.1 * grey, 0.8 * room], axis=-1)
    ground = np.stack([room, room, 0.8 * room], axis=-1)
    image, ground = (np.rint((x + rng.normal(0, 1.5, x.shape)).clip(0, 255)).astype(np.uint8) for x in (light, ground))
    for background in (None, ground):
        new, old = extract_stripe(image, background), extract_stripe_plain(image, background)
        assert len(new) >= 0.97 * len(old) > 100
        rms, expected = (np.sqrt(np.mean(errors_of(p, BASE)[0] ** 2)) for p in (new, old))
        assert rms < 1.05 * expected
