"""How far neighbours err alike."""

import numpy as np
from jaxtyping import Bool, Float, Int

_MAX_LAG = 60
_ENOUGH = 50


def correlation_length(
    values: Float[np.ndarray, " n"], piece: Int[np.ndarray, " n"], kept: Bool[np.ndarray, " n"]
) -> float:
    """How many neighbours count as one: ``1 + 2 sum of the autocorrelations`` up to where they drown in their own noise.

    ``piece``: values of one piece follow each other along a stripe. The values scatter about 0; only those that are ``kept`` count.
    """
    values = np.where(kept, values, 0.0)
    power = float(np.sum(values**2))
    n = int(np.count_nonzero(kept))
    if n < _ENOUGH or power == 0.0:
        return 1.0
    length = 1.0
    for lag in range(1, _MAX_LAG + 1):
        pairs = (piece[lag:] == piece[:-lag]) & kept[lag:] & kept[:-lag]
        n_pairs = int(np.count_nonzero(pairs))
        if n_pairs < _ENOUGH:
            break
        rho = float(values[lag:][pairs] @ values[:-lag][pairs]) / n_pairs / (power / n)
        if rho < max(2.0 / np.sqrt(n_pairs), 0.01):
            break
        length += 2.0 * rho
    return length
