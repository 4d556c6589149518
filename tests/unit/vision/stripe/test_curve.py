"""Chains of points: windows, directions, spacing, breaks, joining."""

import numpy as np

from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.plain.curve import break_chains, join_chains, local_lines, resample


def chains_of(*pieces):
    return Chains(
        np.concatenate([np.asarray(p, dtype=float) for p in pieces]),
        np.concatenate([np.full(len(p), k, dtype=np.int64) for k, p in enumerate(pieces)]),
    )


def line(start, direction, n):
    return np.asarray(start) + np.arange(n)[:, None] * np.asarray(direction, dtype=float)


def test_spans_and_bounds():
    chains = chains_of(line([0, 0], [1, 0], 5), line([0, 9], [1, 0], 3))
    assert chains.spans() == [(0, 5), (5, 8)]
    start, stop = chains.bounds()
    np.testing.assert_array_equal(start, [0] * 5 + [5] * 3)
    np.testing.assert_array_equal(stop, [4] * 5 + [7] * 3)


def test_window_mean_does_not_leave_the_chain():
    chains = chains_of(line([0, 0], [1, 0], 4), line([0, 9], [1, 0], 4))
    np.testing.assert_allclose(chains.window_mean(np.repeat([1.0, 7.0], 4), 3), np.repeat([1.0, 7.0], 4))
    np.testing.assert_allclose(chains.window_median(np.repeat([1.0, 7.0], 4), 3), np.repeat([1.0, 7.0], 4))


def test_direction_of_a_line():
    chains = chains_of(line([3, 4], [0.6, 0.8], 30))
    smooth, tangent = local_lines(chains, 5)
    np.testing.assert_allclose(smooth, chains.uv, atol=1e-9)
    np.testing.assert_allclose(tangent, np.tile([0.6, 0.8], (30, 1)), atol=1e-9)


def test_direction_does_not_bend_around_a_corner():
    first = line([0, 0], [1, 0], 20)
    chains = chains_of(np.vstack([first, line([19, 1], [0, 1], 20)]))
    _, tangent = local_lines(chains, 6)
    assert np.abs(tangent[17] @ [0.0, 1.0]) < 0.1
    assert np.abs(tangent[22] @ [1.0, 0.0]) < 0.1


def test_resampling_gives_equal_spacing_and_keeps_the_curve():
    angle = np.sort(np.random.default_rng(0).uniform(0, 3, 400))
    chains = chains_of(50.0 * np.column_stack([np.cos(angle), np.sin(angle)]))
    dense = resample(chains, 1.0)
    np.testing.assert_allclose(np.hypot(*np.diff(dense.uv, axis=0).T), 1.0, atol=0.01)
    np.testing.assert_allclose(np.hypot(*dense.uv.T), 50.0, atol=0.05)


def test_breaks_at_a_jump_across_and_at_a_gap_along():
    uv = np.vstack([line([0, 0], [1, 0], 15), line([15, 2], [1, 0], 15), line([36, 2], [1, 0], 15)])
    chains, kept = break_chains(chains_of(uv), np.tile([1.0, 0.0], (45, 1)), np.ones(45, dtype=bool), 5)
    assert kept.all()
    assert chains.spans() == [(0, 15), (15, 30), (30, 45)]


def test_drops_short_pieces_and_points_that_go_back():
    uv = np.vstack([line([0, 0], [1, 0], 15), [[13.9, 0.1]], line([15, 0], [1, 0], 15), line([50, 0], [1, 0], 3)])
    chains, kept = break_chains(chains_of(uv), np.tile([1.0, 0.0], (34, 1)), np.ones(34, dtype=bool), 5)
    assert chains.spans() == [(0, 30)]
    assert not kept[15]
    assert not kept[31:].any()


def test_nothing_left_is_empty():
    chains, kept = break_chains(
        chains_of(line([0, 0], [1, 0], 3)), np.tile([1.0, 0.0], (3, 1)), np.zeros(3, dtype=bool), 5
    )
    assert len(chains) == 0
    assert not kept.any()


def test_joins_what_goes_on_and_turns_it_round():
    chains = chains_of(line([0, 0], [1, 0], 20), line([41, 0], [-1, 0], 20), line([0, 30], [1, 0], 20))
    tangent = np.repeat([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]], 20, axis=0)
    joined, order = join_chains(chains, tangent, 4.0)
    assert joined.spans() == [(0, 40), (40, 60)]
    np.testing.assert_allclose(joined.uv, chains.uv[order])
    first = joined.uv[:40]
    assert (np.abs(np.diff(first[:, 0])) <= 4.0).all()
    assert len(np.unique(np.sign(np.diff(first[:, 0])))) == 1


def test_does_not_join_around_a_corner():
    chains = chains_of(line([0, 0], [1, 0], 20), line([20, 1], [0, 1], 20))
    tangent = np.repeat([[1.0, 0.0], [0.0, 1.0]], 20, axis=0)
    assert len(join_chains(chains, tangent, 4.0)[0].spans()) == 2


def test_joins_a_ring():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = 30.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    tangent = np.column_stack([-np.sin(angle), np.cos(angle)])
    joined, order = join_chains(chains_of(ring[:100], ring[100:]), tangent, 4.0)
    assert len(joined.spans()) == 1
    assert sorted(order) == list(range(200))
