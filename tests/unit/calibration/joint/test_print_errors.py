"""Errors of a target's points against one large mixed model; symmetric targets whose points are numbered differently in each view."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.linear import prior_rows, row_weights
from rotaline.calibration.joint.print_errors import (
    PrintView,
    information_with_print_errors,
    learn_print_errors,
    print_model,
    print_views,
    solve_with_print_errors,
)
from rotaline.calibration.joint.rows import Rows
from rotaline.calibration.joint.solve import eliminate, press
from rotaline.vision.targets.model import Checkerboard, DotGrid
from rotaline.vision.targets.ordering import symmetry_permutations

PRINT_MM = 0.004


@pytest.fixture(scope="module")
def problem(right_handed):
    """The checkerboard's views, held and on the table, with errors of its points and noise; those of the axis turned by half a turn."""
    case = right_handed
    found = case.solved()
    weights = list(row_weights(case.setting, found.noise, found.frames, final=True))
    target = next(t for t, b in enumerate(case.data.targets) if isinstance(b, Checkerboard))
    n_points = [len(t.points_board()) for t in case.data.targets]
    rng = np.random.default_rng(1)
    offsets = PRINT_MM * rng.standard_normal((n_points[target], 2))
    views, rows = {}, []
    frames = [*(f.points for f in case.data.plates), *(f.points for f in case.data.tables)]
    for k, found_frame in enumerate(found.frames):
        r = found_frame.rows
        residuals = rng.standard_normal(len(r.residuals)) * np.where(
            weights[k] > 0, 1 / np.maximum(weights[k], 1e-9), 0
        )
        if k < len(frames) and frames[k].target == target:
            turn = np.eye(2) if k < len(case.data.plates) else -np.eye(2)
            numbers = frames[k].numbers if turn[0, 0] > 0 else n_points[target] - 1 - frames[k].numbers
            views[k] = PrintView(target, numbers, turn)
            shown = np.einsum("nij,nj->ni", r.place, offsets[numbers] @ turn.T)
            residuals[: 2 * len(shown)] -= shown.ravel()  # minus: place is the derivative of the residual by the offset
        rows.append(replace(r, residuals=residuals))
    triangles = [press(r, w, t.motions, t.prior) for r, w, t in zip(rows, weights, found.triangles, strict=True)]
    prior = prior_rows(case.setting, found.layout, found.state)
    return case, found.layout, rows, weights, triangles, prior, views, target, n_points


def _model(problem):
    case, layout, rows, weights, triangles, prior, views, _, _ = problem
    eliminated = eliminate(triangles, layout)
    return eliminated, print_model(eliminated, triangles, layout, prior, rows, weights, views, case.data.targets)


def _dense(problem):
    """Rows of the global parameters, of the frames' own, and of the offsets of the target's points (without their prior)."""
    _, layout, rows, weights, triangles, prior, views, target, n_points = problem
    starts = layout.size + np.concatenate([[0], np.cumsum([r.local.shape[1] for r in rows])])
    first = starts[-1]
    width = first + 2 * n_points[target] + 1
    blocks = []
    for k, (r, w, t) in enumerate(zip(rows, weights, triangles, strict=True)):
        block = np.zeros((len(w) + len(t.prior), width))
        own = slice(starts[k], starts[k + 1])
        for name, columns in [*r.common.items(), *((n, r.local[:, :6] @ m) for n, m in t.motions.items())]:
            if name in layout:
                block[: len(w), layout.of(name)] += columns * w[:, None]
        block[: len(w), own] = r.local * w[:, None]
        block[: len(w), -1] = r.residuals * w
        if k in views:
            for i, number in enumerate(views[k].numbers):
                at = first + 2 * number
                block[2 * i : 2 * i + 2, at : at + 2] = r.place[i] @ views[k].turn * w[2 * i : 2 * i + 2, None]
        block[len(w) :, own] = np.diag(t.prior)
        blocks.append(block)
    known = np.zeros((len(prior), width))
    known[:, : layout.size], known[:, -1] = prior[:, :-1], prior[:, -1]
    return np.vstack([*blocks, known]), starts


def test_the_solution_is_that_of_one_large_mixed_model(problem):
    _, layout, _, _, triangles, _, views, target, n_points = problem
    eliminated, model = _model(problem)
    print_mm = np.zeros(len(n_points))
    print_mm[target] = PRINT_MM
    solution, offsets = solve_with_print_errors(model, eliminated, print_mm)

    whole, starts = _dense(problem)
    n = starts[-1]
    drawn = np.zeros((2 * n_points[target], whole.shape[1]))
    drawn[:, n:-1] = np.eye(len(drawn)) / PRINT_MM
    full = np.vstack([whole, drawn])
    matrix, right = full[:, :-1], full[:, -1]
    size = np.linalg.norm(matrix, axis=0)
    step = -np.linalg.lstsq(matrix / size, right, rcond=None)[0] / size
    inverse = np.linalg.inv(np.linalg.qr(matrix / size, mode="r"))
    covariance = inverse @ inverse.T / np.outer(size, size)
    u, p = np.sqrt(np.diag(covariance)), layout.size
    assert solution.step / u[:p] == pytest.approx(step[:p] / u[:p], abs=1e-5)
    units = np.outer(u[:p], u[:p])
    assert solution.covariance / units == pytest.approx(covariance[:p, :p] / units, abs=1e-5)
    first = sum(n_points[:target])
    assert offsets[first : first + n_points[target]].ravel() == pytest.approx(step[n:], abs=1e-7)
    for k in range(len(triangles)):
        own = slice(starts[k], starts[k + 1])
        assert solution.own_steps[k] / u[own] == pytest.approx(step[own] / u[own], abs=1e-5)
        assert np.sqrt(solution.own_variances[k]) == pytest.approx(u[own], rel=1e-5)
    left = right + matrix @ step
    assert solution.squares == pytest.approx(left @ left, rel=1e-8)
    factor, again = information_with_print_errors(model, print_mm, p)
    assert again == pytest.approx(solution.step)
    assert np.abs(factor) == pytest.approx(np.abs(solution.factor))
    assert len(views) > 10


def test_their_standard_deviation_has_the_largest_restricted_likelihood(problem):
    """-2 log of it, from the covariance matrix of all observations."""
    _, _, _, _, _, _, _, target, n_points = problem
    _, model = _model(problem)
    whole, starts = _dense(problem)
    n = starts[-1]
    fixed, random, right = whole[:, :n], whole[:, n:-1], whole[:, -1]
    fixed = fixed / np.linalg.norm(fixed, axis=0)
    basis = np.linalg.qr(fixed)[0]
    random, right = random - basis @ (basis.T @ random), right - basis @ (basis.T @ right)  # what the fixed part leaves

    def criterion(sigma):
        inner = np.eye(random.shape[1]) / sigma**2 + random.T @ random
        explained = np.linalg.solve(inner, random.T @ right)
        return right @ right - right @ random @ explained + np.linalg.slogdet(sigma**2 * inner)[1]

    sigma = learn_print_errors(model, np.zeros(len(n_points)), [target])
    assert np.count_nonzero(sigma) == 1
    best = sigma[target]
    assert best == pytest.approx(PRINT_MM, rel=0.2)
    assert criterion(best) < min(criterion(0.95 * best), criterion(1.05 * best))


def test_targets_that_are_right_get_none(problem):
    case, layout, rows, weights, _, prior, views, target, n_points = problem
    rng = np.random.default_rng(5)
    noise = [
        replace(r, residuals=rng.standard_normal(len(w)) * np.where(w > 0, 1 / np.maximum(w, 1e-9), 0))
        for r, w in zip(rows, weights, strict=True)
    ]
    triangles = [press(r, w, t.motions, t.prior) for r, w, t in zip(noise, weights, problem[4], strict=True)]
    model = print_model(
        eliminate(triangles, layout), triangles, layout, prior, noise, weights, views, case.data.targets
    )
    assert not learn_print_errors(model, np.zeros(len(n_points)), [target]).any()


@pytest.mark.parametrize("target", [DotGrid((6, 6), 5.0, 2.5), DotGrid((7, 5), 5.0, 2.5), Checkerboard((7, 5), 4.0)])
def test_views_of_a_symmetric_target_are_brought_into_one_order(target):
    """Each view numbers the points of the turned target from its own corner; frames on the table share an order."""
    rng = np.random.default_rng(3)
    places = target.points_board()[:, :2]
    offsets = 0.02 * rng.standard_normal(places.shape)
    symmetries = symmetry_permutations(target)
    assert len(symmetries) > 1
    centred = places - places.mean(axis=0)
    rows, numbers, together = [], [], []
    fields = []
    for view in range(12):
        which = symmetries[2 % len(symmetries) if view >= 9 else int(rng.integers(len(symmetries)))]
        turn = np.round(np.linalg.lstsq(centred, centred[which], rcond=None)[0].T, 9)
        field = np.empty_like(offsets)
        field[which] = offsets @ turn.T
        seen = np.sort(rng.permutation(len(places))[: len(places) - 5])
        place = np.eye(2) * 30.0 + rng.standard_normal((len(seen), 2, 2))
        shift = 1.0 * rng.standard_normal(2)  # of the pose
        residuals = -np.einsum("nij,nj->ni", place, field[seen] + shift) + 0.1 * rng.standard_normal((len(seen), 2))
        rows.append(_rows(residuals, place))
        numbers.append((0, seen))
        together.append(-1 if view >= 9 else view)
        fields.append(field)
    views = print_views([target], numbers, rows, together)
    assert sorted(views) == list(range(12))
    in_one_order = np.full((12, *offsets.shape), np.nan)
    for k, view in views.items():
        in_one_order[k, view.numbers] = fields[k][numbers[k][1]] @ view.turn  # the inverse turn
    assert np.nanmax(np.nanstd(in_one_order, axis=0)) < 1e-9


def test_targets_with_too_few_views_are_left_alone():
    target = DotGrid((6, 6), 5.0, 2.5)
    place = np.broadcast_to(np.eye(2), (36, 2, 2))
    rows = [_rows(np.zeros((36, 2)), place)] * 3
    numbers = [(0, np.arange(36)), (0, np.arange(36)), None]
    assert print_views([target], numbers, rows, [0, 1, 2]) == {}


def _rows(residuals, place):
    n = 2 * len(residuals)
    none = np.zeros(n, dtype=int)
    return Rows(
        residuals=residuals.ravel(),
        local=np.zeros((n, 6)),
        common={},
        group=none,
        u=np.ones(n),
        point=np.repeat(np.arange(n // 2), 2),
        piece=none,
        mm_per_px=np.full(n, np.nan),
        place=np.array(place),
    )
