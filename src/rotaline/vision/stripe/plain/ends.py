"""The ends of a piece of stripe: points there that do not belong to it."""

import numpy as np
from jaxtyping import Bool, Float

from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.ends import LEAST_CHECKED, MOST, REFERENCE


def sound_ends(chains: Chains, width_px: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """False for points at the ends of chains that do not continue what the piece shows further in.

    Beside a jump, at a corner and where a stripe stops, a profile holds light of two places. Such a point is wider or
    narrower than the twelve points further in, or lies off the parabola through them. An end is cut behind the last such
    point among its outermost six.
    """
    keep = np.ones(len(chains), dtype=bool)
    for start, stop in chains.spans():
        if stop - start < LEAST_CHECKED:
            continue
        for order in (np.arange(start, stop), np.arange(start, stop)[::-1]):
            end, reference = order[:MOST], order[MOST : MOST + REFERENCE]
            unsound = np.flatnonzero(~_continue(chains.uv, width_px, end, reference))
            keep[end[: unsound[-1] + 1 if len(unsound) else 0]] = False
    return keep


def _continue(uv: np.ndarray, width_px: np.ndarray, end: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Whether points have the width of the reference points and lie on the parabola through them."""
    widths = width_px[reference]
    usual = np.median(widths)
    alike = np.abs(width_px[end] - usual) <= 0.06 * usual + 6.0 * np.median(np.abs(widths - usual))
    chord = uv[reference[-1]] - uv[reference[0]]
    axes = np.array([chord, [-chord[1], chord[0]]]) / max(np.hypot(chord[0], chord[1]), 1e-9)
    along, across = axes @ (uv[reference] - uv[reference[0]]).T
    design = np.column_stack([np.ones_like(along), along, along**2])
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ across
    scatter = np.sqrt(np.mean((across - design @ coefficients) ** 2))
    t, place = axes @ (uv[end] - uv[reference[0]]).T
    beyond = np.column_stack([np.ones_like(t), t, t**2])
    doubt = scatter * np.sqrt(1.0 + ((beyond @ inverse) ** 2).sum(axis=1))
    return np.asarray(alike & (np.abs(place - beyond @ coefficients) <= 0.1 + 5.0 * doubt))
