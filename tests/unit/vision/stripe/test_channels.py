"""The channels of a frame against the plain way, which makes planes of all of them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rotaline.vision.stripe.channels import (
    STEPS,
    ZERO,
    Channels,
    channels_of,
    measuring_channel,
    plane_of,
    planes_of,
    score_image,
)
from rotaline.vision.stripe.find import find_chains
from rotaline.vision.stripe.profiles import sample_profiles
from rotaline.vision.stripe.ridges import Ridge
from rotaline.vision.stripe.signal import CHANNELS, match_exposure, measuring_plane, score_images, split_frame
from rotaline.vision.stripe.signal_kernels import _middle, heights

SHAPE = (200, 260)
V, U = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
BLOCKS = np.random.default_rng(5).uniform(20, 130, (13, 17)).repeat(16, axis=0).repeat(16, axis=1)[:200, :260]
ROOM = BLOCKS[:, :, None] * np.array([1.0, 0.9, 0.8])
LASER = np.exp(-0.5 * ((U - 120.0 + 0.2 * V) / 2.0) ** 2)[:, :, None] * np.array([1.0, 0.2, 0.1])
LAMP = 300.0 * (np.hypot(U - 230.0, V - 20.0) < 12.0)[:, :, None] * np.ones(3)


def camera(light, seed=1, dtype=np.uint8, noise=1.0):
    top = np.iinfo(dtype).max
    grey = light + np.random.default_rng(seed).normal(0.0, noise, light.shape)
    return np.rint(grey.clip(0, 255) * (top / 255.0)).astype(dtype)


PAIRS = {
    "another exposure": (0.9 * ROOM + 6.0 + 90.0 * LASER, ROOM),
    "the same": (ROOM, ROOM),
    "plain": (np.full((*SHAPE, 3), 88.0), np.full((*SHAPE, 3), 80.0)),
    "dark": (np.full((*SHAPE, 3), 6.0), np.full((*SHAPE, 3), 4.0)),
    "black": (ROOM, np.full((*SHAPE, 3), -9.0)),
    "another light": (0.5 * ROOM, ROOM),
    "clipped": (2.2 * ROOM, 2.2 * ROOM),
}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("name", PAIRS)
def test_exposure_is_matched_as_in_the_plain_way(name, dtype):
    image, background = (camera(light, seed, dtype) for seed, light in enumerate(PAIRS[name]))
    channels = channels_of(image, background)
    for k in range(3):
        expected = match_exposure(image[..., k], background[..., k])
        assert channels.lines[k, 0] == pytest.approx(expected[0], abs=1e-6)
        assert channels.lines[k, 1] == pytest.approx(expected[1], abs=1e-4 * channels.unit)
    frame = split_frame(image, background)
    assert channels.lit == frame.lit
    for k, expected_plane in enumerate(frame.planes):
        plane = plane_of(channels, k)
        assert np.abs(plane.value - expected_plane).max() < 1e-4 * channels.unit
        assert np.array_equal(plane.source, image[..., k])
        assert plane.lit == frame.lit


def test_the_middle_is_the_median():
    rng = np.random.default_rng(3)
    for n in (1, 2, 5, 400, 3001):
        for values in (
            rng.normal(0, 3, n),
            rng.integers(0, 5, n),
            np.full(n, 7.0),
            np.append(rng.normal(0, 1e-3, n), 6e4),
        ):
            x = values.astype(np.float32)
            times = rng.integers(1, 4, len(x)).astype(np.int32)
            inner, inner_times, count = np.empty_like(x), np.empty_like(times), np.empty(1024, np.int32)
            expected = float(np.median(np.repeat(x, times).astype(float)))
            assert _middle(x, times, inner, inner_times, count) == pytest.approx(expected, abs=1e-12)


SCENES = {
    "dark": 60.0 * LASER,
    "room": ROOM + 60.0 * LASER,
    "saturated": ROOM + 1500.0 * LASER,
    "saturated in a short piece": ROOM + 1500.0 * LASER * ((V > 80) & (V < 100))[:, :, None],
    "white in two places": ROOM + 1500.0 * LASER * (V > 120)[:, :, None] + LAMP,
}


def grey_values(channels: Channels, name):
    return (score_image(channels, planes_of(channels), name).astype(float) - ZERO) / STEPS


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("subtracted", [False, True])
@pytest.mark.parametrize("size", [(200, 260), (199, 260), (200, 259), (35, 41)])
@pytest.mark.parametrize("name", SCENES)
def test_scores_are_those_of_the_plain_way(name, size, subtracted, dtype):
    image = camera(SCENES[name], 1, dtype)[: size[0], : size[1]]
    background = camera(ROOM, 2, dtype)[: size[0], : size[1]] if subtracted else None
    channels, frame = channels_of(image, background), split_frame(image, background)
    for colour, score in score_images(frame, "auto"):
        difference = np.abs(grey_values(channels, colour) - score / frame.unit)
        assert np.quantile(difference, 0.9) <= 0.51 / STEPS
        assert difference.max() <= (0.51 if frame.white is None or colour == "grey" else 2.0) / STEPS


def test_a_white_core_is_filled():
    image = camera(SCENES["saturated"])
    white = image.min(axis=2) >= 217
    core = white & (np.abs(U - 120.0 + 0.2 * V) < 1.0)
    assert core.sum() > 100
    hollow = image[..., 0] - image[..., 1:].mean(axis=2)
    assert np.median(hollow[core]) < 20.0
    assert np.median(grey_values(channels_of(image, None), "red")[core]) > 40.0


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("subtracted", [False, True])
@pytest.mark.parametrize("steep", [False, True])
def test_heights_are_those_of_sampled_profiles(steep, subtracted, dtype):
    """Of points on pixels and between them, also near the border and beyond it."""
    rng = np.random.default_rng(4)
    image, background = camera(0.6 * ROOM + 400.0 * LASER, 1, dtype), camera(0.6 * ROOM, 2, dtype)
    channels = channels_of(image, background if subtracted else None)
    frame = split_frame(image, background if subtracted else None)
    middle = rng.uniform(0, 199, 300)
    uv = np.concatenate([np.column_stack([120.0 - 0.2 * middle, middle]), rng.uniform(-3, 263, (100, 2))])
    uv = np.rint(2.0 * uv) / 2.0
    scale = rng.choice([1.0, 2.0, 4.0], len(uv))
    height, clipped = np.empty((3, len(uv))), np.empty((3, len(uv)), dtype=bool)
    limit = 253.0 if dtype is np.uint8 else 64224.0
    heights(*channels.rows(), channels.lines, limit, uv, np.full(len(uv), steep), scale, height, clipped)
    normal = np.tile([1.0, 0.0] if steep else [0.0, 1.0], (len(uv), 1))
    assert clipped.any()
    for k in range(3):
        p = sample_profiles(frame.planes[k], frame.clipped[k], uv, normal, 6.0 * scale)
        near = p.valid & (np.abs(p.offset_px) <= 2.0 * scale[:, None])
        far = p.valid & (np.abs(p.offset_px) >= 4.0 * scale[:, None])
        peak = np.where(near, p.value, -np.inf).max(axis=1)
        side = (p.value * far).sum(axis=1) / np.maximum(far.sum(axis=1), 1)
        np.testing.assert_allclose(height[k], np.maximum(peak - side, 0.0), atol=1e-3 * channels.unit)
        np.testing.assert_array_equal(clipped[k], (p.clipped & near).any(axis=1))


@pytest.mark.parametrize(
    ("light", "expected"), [(60.0 * LASER, 0), (ROOM + 100.0 * LASER, 0), (0.4 * ROOM + 700.0 * LASER, 1)]
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_channel_is_the_one_of_the_plain_way(light, expected, dtype):
    image = camera(light, 1, dtype)
    channels = channels_of(image, None)
    found = find_chains(score_image(channels, planes_of(channels), "red"), 6.0, 2.0 * STEPS, 10.0, 0.0)
    s = found.stripe
    ridges = [
        Ridge(s.uv[s.chain == k], found.prominence[s.chain == k], bool(found.steep[k]), float(s.scale_px[k]))
        for k in range(len(s.scale_px))
    ]
    arguments = (s.uv, found.prominence, s.chain, found.steep, s.scale_px)
    assert measuring_plane(split_frame(image, None), "auto", ridges) == expected
    assert measuring_channel(channels, "auto", *arguments) == expected
    for k, wanted in enumerate(CHANNELS):
        assert measuring_channel(channels, wanted, *arguments) == k


def test_each_thread_has_its_own_work_space():
    images = [camera(light, seed) for seed, light in enumerate(SCENES.values())]

    def red(image):
        channels = channels_of(image, None)
        return score_image(channels, planes_of(channels), "red").copy()

    alone = [red(image) for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: red(images[k % 4]), range(80)))
    for k, score in enumerate(together):
        assert np.array_equal(score, alone[k % 4])
