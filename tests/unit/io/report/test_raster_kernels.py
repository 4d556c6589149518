"""The kernels of the renderer against plain array code."""

import numpy as np

from rotaline.io.report.raster_kernels import draw_discs, finish

WIDTH, HEIGHT, STEP, FAR = 60, 44, 2, 24.0


def scene(n=400):
    rng = np.random.default_rng(2)
    xyz = rng.uniform((-5, -5, 0), (WIDTH + 5, HEIGHT + 5, 50), (n, 3))
    xyz[::17, 1] = np.nan
    return xyz, rng.uniform(0, 1, (n, 3))


def test_the_nearest_point_is_seen():
    xyz, _ = scene()
    disc = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    depth, which = np.empty((HEIGHT, WIDTH)), np.empty((HEIGHT, WIDTH), dtype=np.int64)
    draw_discs(xyz, disc, depth, which)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    shift = np.stack([u, v], axis=-1)[:, :, None, :] - np.rint(xyz[:, :2])
    covers = np.isfinite(xyz[:, 1]) & (np.abs(shift).sum(axis=-1) <= 1)
    z = np.where(covers, xyz[:, 2], -np.inf)
    assert (covers.any(axis=2).mean() > 0.2) & (covers.any(axis=2).mean() < 0.9)
    np.testing.assert_array_equal(which, np.where(covers.any(axis=2), z.argmax(axis=2), -1))
    np.testing.assert_array_equal(depth, np.where(covers.any(axis=2), z.max(axis=2), np.nan))


def test_edges_are_darkened_and_pixels_averaged():
    xyz, colours = scene()
    depth, which = np.empty((HEIGHT, WIDTH)), np.empty((HEIGHT, WIDTH), dtype=np.int64)
    draw_discs(xyz, np.array([[0, 0], [1, 0], [0, 1]]), depth, which)
    picture = np.empty((HEIGHT // 2, WIDTH // 2, 3), dtype=np.uint8)
    finish(colours, which, depth, 0.9, STEP, FAR, picture)
    padded = np.pad(depth, STEP, constant_values=np.nan)
    nearer = np.zeros_like(depth)
    for du, dv in ((STEP, 0), (-STEP, 0), (0, STEP), (0, -STEP)):
        beside = padded[STEP + dv : STEP + dv + HEIGHT, STEP + du : STEP + du + WIDTH]
        nearer += np.nan_to_num(np.clip(beside - depth, 0.0, FAR)) / FAR
    shaded = np.where(which[:, :, None] >= 0, colours[which] * np.exp(-0.9 * nearer)[:, :, None], 1.0)
    plain = shaded.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3)) * 255
    assert nearer.max() > 1.0
    np.testing.assert_allclose(picture, plain, rtol=0, atol=0.5 + 1e-9)
