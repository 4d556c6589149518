"""The stripe is found where the plain way, which works on every pixel in three sizes, finds it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import KDTree

from rotaline.vision.stripe import find as find_module
from rotaline.vision.stripe.find import find, find_chains
from rotaline.vision.stripe.options import StripeOptions
from rotaline.vision.stripe.settle_kernels import median
from rotaline.vision.stripe.signal import find_stripe, split_frame
from rotaline.vision.stripe.tile_kernels import (
    BLOCK_COLUMNS,
    FIRST,
    SMOOTH_SIZE,
    smooth_border_tile,
    smooth_rows,
    sweep,
)

SHAPE = (240, 320)
V, U = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
OPTIONS = StripeOptions()


def line(distance, sigma, height):
    return height * np.exp(-0.5 * (distance / sigma) ** 2)


def ramp(start, stop, along, soft=1.0):
    """1 between two places, 0 elsewhere."""
    return 1.0 / (1.0 + np.exp(-(along - start) / soft)) / (1.0 + np.exp((along - stop) / soft))


def camera(light, noise=0.4, seed=1, dtype=np.uint8, dark=2.5):
    top = np.iinfo(dtype).max
    grey = dark + light + np.random.default_rng(seed).normal(0.0, noise, light.shape)
    return np.rint(grey.clip(0, 255) * (top / 255.0)).astype(dtype)


TILTED = (U - 160.0 + 0.3 * (V - 120.0)) / np.hypot(1.0, 0.3)
BLOCKS = np.random.default_rng(5).uniform(0, 60, (15, 20)).repeat(16, axis=0).repeat(16, axis=1)
GRAIN = np.random.default_rng(6).uniform(0, 25, SHAPE)
DOTS = 120.0 * (np.hypot((U % 20) - 10, (V % 20) - 10) < 2.0)
THREADS = sum(ramp(20 + 14 * k, 27 + 14 * k, V, 0.3) for k in range(14))

STRIPES = {
    "vertical": line(U - 100.3, 1.3, 90.0),
    "horizontal": line(V - 80.6, 1.3, 90.0),
    "between": line(TILTED, 1.3, 90.0),
    "diagonal": line((U - V - 30.0) / np.sqrt(2.0), 1.2, 60.0),
    "thin": line(TILTED, 0.5, 60.0),
    "wide": line(TILTED, 4.0, 90.0),
    "very wide": line(TILTED, 9.0, 120.0),
    "wide in part": line(TILTED, 1.2 + 4.0 * ramp(140, 300, V), 90.0),
    "curved": line(np.hypot(U - 150, V + 20) - 130.0, 1.4, 70.0),
    "circle": line(np.hypot(U - 160, V - 120) - 70.0, 1.4, 70.0),
    "pieces": line(TILTED - 40.0 * (V > 80) + 70.0 * (V > 160), 1.3, 90.0),
    "bright and faint": line(U - 60, 1.3, 200.0) + line(U - 180.0, 1.3, 14.0),
    "thin with a wide ghost": line(U - 60, 1.2, 150.0) + line(U - 84.0, 4.0, 25.0),
    "faint": line(TILTED, 1.3, 4.5),
    "faint and wide": line(TILTED, 4.5, 4.5),
    "zigzag": line((U - 150.0 - np.abs(V % 60 - 30)) / np.sqrt(2.0), 1.2, 80.0),
    "crossing": np.maximum(line(TILTED, 1.2, 80.0), line((U - V - 30.0) / np.sqrt(2.0), 1.2, 80.0)),
    "parallel": sum(line((U - 30.0 - 9.0 * k + 0.2 * V) / np.hypot(1.0, 0.2), 1.1, 20.0 + 5.0 * k) for k in range(8)),
    "joining": np.maximum(
        line(U - 150.0, 1.2, 80.0) * (V > 100),
        line((np.abs(U - 150.0) + 0.5 * (V - 100.0)) / np.hypot(1.0, 0.5), 1.2, 60.0) * (V <= 100),
    ),
    "star": np.maximum.reduce(
        [line((U - 160.0) * np.cos(a) + (V - 120.0) * np.sin(a), 1.2, 50.0) for a in np.linspace(0.0, np.pi, 7)[1:]]
    ),
    "at the border": line(U - 3.5, 1.3, 90.0) + line(V - 236.2, 1.3, 50.0),
    "scene": BLOCKS + line(TILTED, 1.3, 60.0),
    "grain": GRAIN + line(TILTED, 1.3, 90.0),
    "dots": DOTS + line(U - 150, 1.5, 40.0),
}


def plain(image, background=None):
    ridges, crowded = find_stripe(split_frame(image, background), "auto", 6.0, 2.0, 10.0)
    return np.concatenate([r.uv for r in ridges]) if ridges else np.zeros((0, 2)), crowded


def shares(found, expected):
    """Part of the expected points that were found, and part of the found points that are expected."""
    if len(found) == 0 or len(expected) == 0:
        return float(len(expected) == 0), float(len(found) == 0)
    near, back = (KDTree(a).query(b)[0] <= 1.5 for a, b in ((found, expected), (expected, found)))
    return near.mean(), back.mean()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("name", STRIPES)
def test_finds_what_the_plain_way_finds(name, dtype):
    image = camera(STRIPES[name], dtype=dtype)
    expected, crowded = plain(image)
    assert len(expected) > 50
    stripe, plane = find(image, None, OPTIONS)
    assert plane.value is image
    assert stripe.crowded == crowded
    assert min(shares(stripe.uv, expected)) >= 0.99


@pytest.mark.parametrize("name", ["between", "wide in part", "scene", "faint and wide", "dots"])
def test_looking_everywhere_is_the_plain_way(name):
    image = camera(STRIPES[name])
    expected, _ = plain(image)
    found = find_chains(image, 6.0, 2.0, 10.0, 1.0, everywhere=True).stripe
    assert min(shares(found.uv, expected)) >= 0.99


def test_a_row_of_short_pieces():
    """In a smaller image they are one chain, which the plain way takes where it is stronger than any piece; here they stay what they are."""
    image = camera(line(U - 150.4, 1.2, 80.0) * THREADS)
    expected, _ = plain(image)
    on = THREADS[np.rint(expected[:, 1]).astype(int), 0] > 0.5
    stripe, _ = find(image, None, OPTIONS)
    assert shares(stripe.uv, expected[on])[0] == 1.0
    assert np.abs(stripe.uv[:, 0] - 150.4).max() < 1.5
    assert len(stripe.scale_px) == 14


@pytest.mark.parametrize(("noise", "height"), [(0.05, 3.6), (0.7, 5.0), (1.5, 9.0), (3.0, 16.0), (6.0, 30.0)])
@pytest.mark.parametrize("sigma", [0.6, 1.3, 4.5])
def test_faint_stripes_in_any_noise(noise, height, sigma):
    light = line(TILTED, sigma, height * (1.4 if sigma < 1.0 else 1.0))
    found = expected = 0.0
    for seed in range(3):
        image = camera(light, noise, seed, dark=20.0)
        points, _ = plain(image)
        stripe, _ = find(image, None, OPTIONS)
        on = [np.abs(uv[:, 0] - 160.0 + 0.3 * (uv[:, 1] - 120.0)) < 3.0 for uv in (stripe.uv, points)]
        found, expected = found + on[0].sum(), expected + on[1].sum()
    assert expected > 60
    assert found >= 0.97 * expected


@pytest.mark.parametrize("dark", [0.0, 8.0, 20.0])
@pytest.mark.parametrize("noise", [0.5, 1.0, 2.0, 4.0])
def test_the_noise_of_a_camera_changes_nothing(noise, dark):
    for seed, (name, height) in enumerate(
        [("vertical", 0.35), ("horizontal", 0.35), ("between", 1.0), ("curved", 2.8)]
    ):
        image = camera(height * STRIPES[name], noise, seed, dark=dark)
        expected, crowded = plain(image)
        stripe, _ = find(image, None, OPTIONS)
        assert stripe.crowded == crowded
        assert min(shares(stripe.uv, expected)) >= 0.97


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("size", [(48, 64), (37, 53), (7, 7), (17, 33)])
def test_the_sweep_sees_every_pixel(dtype, size):
    image = np.random.default_rng(7).uniform(0, 255, size).astype(dtype)
    h, w = size
    rows, columns = -(-h // 16), -(-w // 16)
    tops, lows = np.empty((2, rows, columns), dtype=dtype)
    sweep(image, tops, lows)
    for a in range(rows):
        high = np.pad(image[16 * a : 16 * a + 16].max(axis=0).astype(float), (0, 16 * columns + 1 - w), mode="edge")
        means = np.floor(0.5 * (high[:-1] + high[1:] + 1.0)).reshape(columns, 16)
        assert np.array_equal(tops[a], means.max(axis=1))
        assert np.array_equal(lows[a], high[:-1].reshape(columns, 16)[:, ::4].min(axis=1))


@pytest.mark.parametrize("size", [(48, 64), (17, 33), (20, 20)])
def test_rows_for_the_noise_are_smoothed_like_tiles(size):
    image = np.random.default_rng(7).uniform(0, 255, size).astype(np.uint8)
    half, rows = np.zeros(SMOOTH_SIZE + 6, dtype=np.float32), np.empty(SMOOTH_SIZE, dtype=np.float32)
    row, column = smooth_rows(image, 0.5, 1, 1, half, rows)
    expected = np.pad(image.astype(float), 48, mode="reflect")
    weights = np.exp(-0.5 * np.arange(-3.0, 4.0) ** 2)
    for axis in (0, 1):
        expected = np.apply_along_axis(np.convolve, axis, expected, weights / weights.sum(), mode="same")
    for i in range(7):
        at, from_column = row + 3 * i + 48, column + 48
        values = rows[5 + i * BLOCK_COLUMNS :][:16]
        np.testing.assert_allclose(values, 0.5 * expected[at, from_column : from_column + 16], rtol=1e-4)
    tile = np.empty_like(rows)
    smooth_border_tile(image, 0.5, 1, 1, half, tile)
    expected_tile = 0.5 * expected[64 : 48 + size[0], 64:80]
    for i, values in enumerate(expected_tile[:16]):
        n = min(16, size[1] - 16)
        np.testing.assert_allclose(tile[FIRST + i * BLOCK_COLUMNS :][:n], values[:n], rtol=1e-4)


@pytest.mark.parametrize("n", [1, 2, 5, 6, 801])
def test_median(n):
    values = np.random.default_rng(n).normal(3.0, 2.0, n).astype(np.float32)
    assert np.isclose(median(values), np.median(values), rtol=0.0, atol=1e-4)
    values[n // 2 :] += 100.0  # two groups: what lies between them matters
    assert np.isclose(median(values), np.median(values), rtol=0.0, atol=1e-3)
    assert median(np.full(n, 2.5, dtype=np.float32)) == 2.5


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 4.0])
def test_noise_alone_is_no_stripe(noise):
    for seed in range(3):
        image = camera(np.zeros(SHAPE), noise, seed, dark=20.0)
        assert len(find(image, None, OPTIONS)[0].uv) == 0


def test_a_thin_stripe_in_the_dark_needs_no_smaller_size_and_a_wide_one_does():
    """What is fast stays fast."""
    for name in ("vertical", "horizontal", "between", "diagonal", "curved", "pieces", "bright and faint"):
        assert find_module._search(camera(STRIPES[name]), 1.0, 6.0, 2.0, 10.0, 1.0, False)[2], name
    for name in ("wide", "very wide", "faint and wide", "thin with a wide ghost"):
        assert not find_module._search(camera(STRIPES[name]), 1.0, 6.0, 2.0, 10.0, 1.0, False)[2], name


@pytest.mark.parametrize(
    "name", ["vertical", "horizontal", "between", "diagonal", "thin", "pieces", "bright and faint"]
)
def test_a_stripe_that_is_followed_is_what_a_search_of_the_tiles_finds(name, monkeypatch):
    image = camera(STRIPES[name])
    searched = []
    search = find_module.candidates
    monkeypatch.setattr(find_module, "candidates", lambda *arguments: searched.append(1) or search(*arguments))
    followed, _ = find(image, None, OPTIONS)
    assert not searched
    monkeypatch.setattr(find_module, "_LINES_OF_TILES", 0)
    expected, _ = find(image, None, OPTIONS)
    assert searched
    assert followed.clear == expected.clear
    assert min(shares(followed.uv, expected.uv)) >= 0.99
    distance, nearest = KDTree(expected.uv).query(followed.uv)
    same = distance < 0.1
    assert same.mean() > 0.97
    assert distance[same].max() < 1e-4
    assert np.median(np.abs(followed.spread_px2 / expected.spread_px2[nearest] - 1.0)[same]) < 0.05


@pytest.mark.parametrize("height", [4.0, 5.0, 8.0])
def test_pieces_at_the_limit_beside_a_bright_stripe_are_found_as_by_a_search(height, monkeypatch):
    """What is so faint falls to pieces: all that a search of the tiles links is linked, also across gaps."""
    faint = line((U - 180.0 + 0.4 * V) / np.hypot(1.0, 0.4), 0.8, height) + line(V - 120.4 - 0.1 * U, 0.8, height) * (
        U > 200
    )
    searched = []
    search = find_module.candidates
    for seed in range(4):
        image = camera(line(U - 60.0 - 0.05 * V, 1.2, 100.0) + faint, 0.4, seed)
        monkeypatch.setattr(find_module, "candidates", lambda *arguments: searched.append(1) or search(*arguments))
        followed, _ = find(image, None, OPTIONS)
        assert not searched
        monkeypatch.setattr(find_module, "candidates", search)
        monkeypatch.setattr(find_module, "_LINES_OF_TILES", 0)
        expected, _ = find(image, None, OPTIONS)
        monkeypatch.undo()
        assert shares(followed.uv, expected.uv)[0] >= 0.99
        assert len(followed.scale_px) <= len(expected.scale_px) + 1


@pytest.mark.parametrize("name", ["scene", "dots", "wide", "thin with a wide ghost"])
def test_tiles_are_searched_where_chains_that_are_followed_explain_too_little(name, monkeypatch):
    image = camera(STRIPES[name])
    followed, _ = find(image, None, OPTIONS)
    monkeypatch.setattr(find_module, "_LINES_OF_TILES", 0)
    expected, _ = find(image, None, OPTIONS)
    assert np.array_equal(followed.uv, expected.uv)


def test_light_that_is_no_ridge_needs_no_smaller_size():
    """A part that is lit a little, with an edge brighter than the rest, in noise; the stripe ends at two borders."""
    lit = 1.0 * (V > 90) + 1.5 * np.exp(-0.5 * ((V - 90.0) / 1.5) ** 2)
    for seed in range(3):
        image = camera(line(TILTED, 1.3, 60.0) + lit, 0.67, seed)
        assert find_module._search(image, 1.0, 6.0, 2.0, 10.0, 1.0, False)[2]
    faint_but_wide = camera(line(TILTED, 1.3, 60.0) + line(V - 90.0, 4.5, 6.0), 0.67)
    assert not find_module._search(faint_but_wide, 1.0, 6.0, 2.0, 10.0, 1.0, False)[2]


def test_room_for_candidates_grows():
    image = camera(STRIPES["dots"])
    before, _ = find(image, None, OPTIONS)
    space = find_module._spaces.of(*SHAPE)
    space.more_room(70)
    after, _ = find(image, None, OPTIONS)
    assert space.where.shape[1] > 70
    assert np.array_equal(before.uv, after.uv)


def test_chains_are_in_order_and_strongest_first():
    stripe, _ = find(camera(STRIPES["bright and faint"]), None, OPTIONS)
    first, second = (stripe.uv[stripe.chain == k] for k in (0, 1))
    assert np.abs(first[:, 0] - 60).max() < 1.5
    assert np.abs(second[:, 0] - 180).max() < 1.5
    assert len(first) == SHAPE[0]
    assert (np.diff(stripe.chain) >= 0).all()
    assert (np.diff(first[:, 1]) > 0).all()
    assert len(stripe.scale_px) == stripe.chain.max() + 1


@pytest.mark.parametrize("size", [(237, 317), (100, 33), (16, 320), (9, 90), (5, 60), (2, 1)])
def test_any_size_of_image_and_any_layout(size):
    image = camera(STRIPES["between"] + STRIPES["horizontal"])[: size[0], : size[1]]
    expected, _ = plain(np.ascontiguousarray(image))
    image.flags.writeable = False
    stripe, _ = find(image, None, OPTIONS)
    assert shares(stripe.uv, expected)[0] >= 0.98
    assert shares(stripe.uv, expected)[1] >= 0.95


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_background_and_colour(dtype):
    room = BLOCKS[:, :, None] * np.array([1.0, 0.9, 0.8]) + 20.0
    laser = STRIPES["between"][:, :, None] * np.array([1.0, 0.15, 0.1])
    lit = np.stack([camera(room[..., k], 1.0, k, dtype) for k in range(3)], axis=2)
    both = np.stack([camera(room[..., k] + laser[..., k], 1.0, 5 + k, dtype) for k in range(3)], axis=2)
    for image, background in ((both, lit), (both, None), (np.ascontiguousarray(both[..., 0]), lit[..., 0].copy())):
        expected, crowded = plain(image, background)
        stripe, plane = find(image, background, OPTIONS)
        assert stripe.crowded == crowded
        assert min(shares(stripe.uv, expected)) >= 0.98
        assert np.array_equal(plane.source, both[..., 0])
        if background is None:
            assert plane.value is plane.source
        else:
            assert plane.value.dtype == np.float32
            assert plane.lit
            assert abs(np.median(plane.value)) < 2.0 * plane.unit
    with pytest.raises(ValueError, match="the background is"):
        find(both, lit.astype(np.uint8 if dtype == np.uint16 else np.uint16), OPTIONS)


def test_threads_and_repeats_do_not_disturb_each_other():
    """The work space of a thread is used again and again."""
    names = ["between", "wide in part", "circle", "dots"]
    images = [camera(STRIPES[name]) for name in names]
    alone = [find(image, None, OPTIONS)[0] for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: find(images[k % 4], None, OPTIONS)[0], range(280)))
    for k, stripe in enumerate(together):
        assert np.array_equal(stripe.uv, alone[k % 4].uv)
        assert np.array_equal(stripe.chain, alone[k % 4].chain)
