"""The linear problem by frames against one large matrix of all rows and all parameters."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.linear import prior_rows, row_weights
from rotaline.calibration.joint.solve import eliminate, global_factor, press, solve, solve_factor


@pytest.fixture(scope="module")
def problem(right_handed):
    """Rows with residuals by chance, so that steps are not rounding; weights, triangles and what is known beforehand."""
    found = right_handed.solved()
    rng = np.random.default_rng(1)
    rows = [replace(f.rows, residuals=f.rows.residuals + 0.02 * rng.standard_normal(len(f.raw))) for f in found.frames]
    weights = list(row_weights(right_handed.setting, found.noise, found.frames, final=True))
    weights[0][:6] = 0.0
    weights[-1][:] = 0.0  # a frame that says nothing
    triangles = [press(r, w, t.motions, 2.0 * t.prior) for r, w, t in zip(rows, weights, found.triangles, strict=True)]
    prior = prior_rows(right_handed.setting, found.layout, found.state)
    return found.layout, rows, weights, triangles, prior


def _dense(layout, rows, weights, triangles, prior):
    """Weighted rows of all parameters with the right side: the global ones first, then each frame's own."""
    starts = layout.size + np.concatenate([[0], np.cumsum([r.local.shape[1] for r in rows])])
    blocks = []
    for k, (r, w, t) in enumerate(zip(rows, weights, triangles, strict=True)):
        block = np.zeros((len(w) + len(t.prior), starts[-1] + 1))
        own = slice(starts[k], starts[k + 1])
        for name, columns in r.common.items():
            if name in layout:
                block[: len(w), layout.of(name)] += columns * w[:, None]
        for name, motion in t.motions.items():
            if name in layout:
                block[: len(w), layout.of(name)] += r.local @ motion * w[:, None]
        block[: len(w), own] = r.local * w[:, None]
        block[: len(w), -1] = r.residuals * w
        block[len(w) :, own] = np.diag(t.prior)
        blocks.append(block)
    known = np.zeros((len(prior), starts[-1] + 1))
    known[:, : layout.size], known[:, -1] = prior[:, :-1], prior[:, -1]
    return np.vstack([*blocks, known]), starts


def test_the_solution_is_that_of_one_large_problem(problem):
    layout, _, _, triangles, prior = problem
    whole, starts = _dense(*problem)
    matrix, right = whole[:, :-1], whole[:, -1]
    size = np.linalg.norm(matrix, axis=0)
    step = -np.linalg.lstsq(matrix / size, right, rcond=None)[0] / size
    inverse = np.linalg.inv(np.linalg.qr(matrix / size, mode="r"))
    covariance = inverse @ inverse.T / np.outer(size, size)
    u = np.sqrt(np.diag(covariance))
    p = layout.size
    assert np.abs(step[:p] / u[:p]).max() > 0.1

    solution = solve(eliminate(triangles, layout), prior)
    assert solution.step / u[:p] == pytest.approx(step[:p] / u[:p], abs=1e-6)
    units = np.outer(u[:p], u[:p])
    assert solution.covariance / units == pytest.approx(covariance[:p, :p] / units, abs=1e-6)
    for k in range(len(triangles)):
        own = slice(starts[k], starts[k + 1])
        assert solution.own_steps[k] / u[own] == pytest.approx(step[own] / u[own], abs=1e-6)
        assert np.sqrt(solution.own_variances[k]) == pytest.approx(u[own], rel=1e-6)
    left = right + matrix @ step
    assert solution.squares == pytest.approx(left @ left, rel=1e-9)


def test_pressed_rows_say_what_the_rows_say(problem):
    _, rows, weights, triangles, _ = problem
    for r, w, t in zip(rows, weights, triangles, strict=True):
        width = 1 + t.local.shape[1] + sum(c.shape[1] for c in t.common.values())
        assert len(t.rhs) == min(np.count_nonzero(w), width)
        before = np.column_stack([r.local, *r.common.values(), r.residuals]) * w[:, None]
        after = np.column_stack([t.local, *t.common.values(), t.rhs])
        gram = before.T @ before
        scale = np.sqrt(np.outer(np.diag(gram), np.diag(gram))) + 1e-300
        assert np.abs(after.T @ after - gram).max() / scale.max() < 1e-9


def test_what_nothing_determines_stays_where_it_is():
    factor = np.array([[2.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1e3, 5e3], [0.0, 0.0, 0.0, 7.0]])
    assert solve_factor(factor) == pytest.approx([0.5, 0.0, -5.0])
    rng = np.random.default_rng(2)
    parts, prior = [rng.standard_normal((k, 4)) for k in (2, 1, 40)], rng.standard_normal((1, 4))
    whole = np.vstack([*parts, prior])
    together = global_factor(parts, prior)
    assert together.T @ together == pytest.approx(whole.T @ whole)
    few = global_factor(parts[1:2], np.zeros((0, 4)))
    assert few.shape == (4, 4)
    assert few.T @ few == pytest.approx(parts[1].T @ parts[1])
