"""Does one rotation explain the views of a plate on a turntable?

The plate is fixed to the table. Its homography to the image at the table angle t is, up to scale,

``H(t) = G0 + cos(t) G1 + sin(t) G2``,   ``G1 + i G2 = a b^T``

because a rotation is linear in 1, cos t and sin t, and because x and y of the table turn together: a (3 complex numbers) is made
of the camera and the axis, b of the plate's pose on the table. No calibration is needed. ``uv x H(t) (x, y, 1) = 0`` is linear in
the G; the condition of rank one is met by alternating between a and b.
"""

import itertools

import numpy as np
from jaxtyping import Float

_ALTERNATIONS = 12
_CLOSER_LOOKS = 12
_BEHIND = 1e3  # misfit of a view in which the plate would stand behind the camera


def frame_equations(
    turn_rad: float, plate: Float[np.ndarray, "m 2"], image: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "27 27"]:
    """Normal matrix of one view for the 27 numbers G[row of H, (1, cos, sin), column of H].

    ``plate`` and ``image`` in units that make them about 1.
    """
    basis = np.array([1.0, np.cos(turn_rad), np.sin(turn_rad)])
    terms = np.einsum("a,mb->mab", basis, np.column_stack([plate, np.ones(len(plate))])).reshape(-1, 9)
    u, v = image[:, :1], image[:, 1:]
    zero = np.zeros_like(terms)
    rows = np.concatenate([np.hstack([terms, zero, -u * terms]), np.hstack([zero, terms, -v * terms])])
    return rows.T @ rows


def fit_rotation(normal: Float[np.ndarray, "27 27"], rank_one: bool = True) -> Float[np.ndarray, "3 3 3"]:
    """G of one rotation from the sum of the views' normal matrices; without ``rank_one`` a quick first look."""
    g = np.linalg.eigh(normal)[1][:, 0].reshape(3, 3, 3)
    if not rank_one:
        return g
    left, size, right = np.linalg.svd(g[:, 1] + 1j * g[:, 2])
    a, b = left[:, 0] * size[0], right[0]
    fixed = np.zeros((27, 9))
    fixed[[9 * r + c for r in range(3) for c in range(3)], range(9)] = 1.0
    for k in range(_ALTERNATIONS):
        turning = _outer_map(a, given_left=True) if k % 2 == 0 else _outer_map(b, given_left=False)
        design = np.hstack([fixed, turning])
        # the rotation must not vanish: the constant and the turning part are kept at one scale by the normalised factor
        factor = np.linalg.norm(a) if k % 2 == 0 else np.linalg.norm(b)
        design[:, 9:] /= factor
        solution = np.linalg.eigh(design.T @ normal @ design)[1][:, 0]
        g = (design @ solution).reshape(3, 3, 3)
        free = solution[9:12] + 1j * solution[12:15]
        if k % 2 == 0:
            b, a = free, a / factor
        else:
            a, b = free, b / factor
    return g


def _outer_map(known: np.ndarray, given_left: bool) -> Float[np.ndarray, "27 6"]:
    """Derivative of G with respect to the real and imaginary parts of the other factor of ``a b^T``."""
    out = np.zeros((3, 3, 3, 6))
    for k in range(3):
        for part, unit in ((0, 1.0), (1, 1j)):
            factor = np.zeros(3, dtype=complex)
            factor[k] = unit
            product = np.outer(known, factor) if given_left else np.outer(factor, known)
            out[:, 1, :, 3 * part + k] = product.real
            out[:, 2, :, 3 * part + k] = product.imag
    return out.reshape(27, 6)


def rotation_misfit(
    g: Float[np.ndarray, "3 3 3"], turn_rad: float, plate: Float[np.ndarray, "m 2"], image: Float[np.ndarray, "m 2"]
) -> float:
    """RMS distance between the predicted and the seen places of a view, in the unit of ``image``."""
    h = g[:, 0] + np.cos(turn_rad) * g[:, 1] + np.sin(turn_rad) * g[:, 2]
    q = np.column_stack([plate, np.ones(len(plate))]) @ h.T
    if not (np.all(q[:, 2] > 0) or np.all(q[:, 2] < 0)):
        return _BEHIND
    return float(np.sqrt(np.mean((q[:, :2] / q[:, 2:] - image) ** 2)))


def choose_by_rotation(
    turn_rad: Float[np.ndarray, " n"],
    plate: Float[np.ndarray, "m 2"],
    images: Float[np.ndarray, "n s m 2"],
    groups: list[list[int]],
    seed_groups: int,
) -> list[int]:
    """Choose among the s possible images of each group of views the ones that one rotation explains.

    Parameters
    ----------
    turn_rad : (n,)   table angle of each view
    plate : (m, 2)   places on the plate
    images : (n, s, m, 2)   their images under each of s numberings
    groups : lists of views that share their choice, in the order of their angle
    seed_groups : int   number of groups that are tried in all combinations

    Returns
    -------
    One choice for each group; 0 for the first.
    """
    normals = [
        np.stack(
            [
                sum(frame_equations(float(turn_rad[k]), plate, images[k, c]) for k in group)
                for c in range(images.shape[1])
            ]
        )
        for group in groups
    ]

    def misfit(chosen: dict[int, int], rank_one: bool = True) -> float:
        g = fit_rotation(np.sum([normals[j][c] for j, c in chosen.items()], axis=0), rank_one)
        errors = [
            rotation_misfit(g, float(turn_rad[k]), plate, images[k, c]) for j, c in chosen.items() for k in groups[j]
        ]
        return float(np.sqrt(np.mean(np.square(errors))))

    seed = list(range(min(seed_groups, len(groups))))
    combinations = itertools.product(range(images.shape[1]), repeat=len(seed) - 1)
    tries = [dict(zip(seed, (0, *rest), strict=True)) for rest in combinations]
    tries = sorted(tries, key=lambda chosen: misfit(chosen, rank_one=False))[:_CLOSER_LOOKS]
    chosen = min(tries, key=misfit)
    for j in range(len(seed), len(groups)):
        chosen = min(({**chosen, j: c} for c in range(images.shape[1])), key=misfit)
    for j in range(1, len(groups)):
        chosen = min(({**chosen, j: c} for c in range(images.shape[1])), key=misfit)
    return [chosen[j] for j in range(len(groups))]
