"""Which way a target on a turntable turns, and which of its frames fit one rotation.

Between two frames of a target that is fixed to the table, the board turns about one direction by the difference of the
angles. This holds for every pair, whatever the position of the axis; so it shows the direction of the axis, the sense of the
turntable, boards that were read in another order (a symmetric board looks the same after a half turn, a square dot plate
after a quarter turn), frames that do not belong, and angles that were read with a wrong scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

FITS_RAD = float(np.radians(4.0))
"""A frame fits the common rotation if its board stands within this angle of where it should; orders of a board differ by 90 deg."""

MIN_TURN_RAD = float(np.radians(2.0))
"""Pairs closer than this say nothing about the direction."""


@dataclass(frozen=True, eq=False)
class TurntableMotion:
    """The rotation that most frames share.

    Attributes
    ----------
    direction_camera : (3,)   unit; the angles are right-handed about it
    order : (f,)   which of the alternative orientations of each frame fits
    fits : (f,)   frames whose board stands within 4 deg of the common rotation
    turned_rad : (f,)   measured turn about the direction, from the first frame that fits, along ``angles_rad``
    scale : float   measured turn for one unit of the read angle; 1 if the angles are right
    u_scale : float   its standard uncertainty
    """

    direction_camera: Float[np.ndarray, "3"]
    order: Int[np.ndarray, " f"]
    fits: Bool[np.ndarray, " f"]
    turned_rad: Float[np.ndarray, " f"]
    scale: float
    u_scale: float


def find_turntable_motion(
    orientations: Sequence[Rotation], angles_rad: Float[np.ndarray, " f"]
) -> TurntableMotion | None:
    """Consensus of the turns between frames.

    Parameters
    ----------
    orientations : f stacks of rotations   ``camera_from_board`` of a frame, one for each order in which its points may stand
    angles_rad : (f,)   as read; any order, any wrap

    Returns
    -------
    TurntableMotion, or None if no two frames differ by an angle from which a direction follows
    """
    n_frames = len(orientations)
    matrices_of = [stack.as_matrix() for stack in orientations]
    best: tuple[int, float] = (-1, 0.0)
    chosen = None
    for scaled in (False, True):
        for i, j in _pairs(angles_rad):
            if best[0] == n_frames:
                break
            step = float(_wrap(angles_rad[j] - angles_rad[i]))
            for turn in matrices_of[j] @ matrices_of[i][0].T:
                vector = Rotation.from_matrix(turn).as_rotvec()
                measured = float(np.linalg.norm(vector))
                if measured < MIN_TURN_RAD or (not scaled and abs(measured - abs(step)) > FITS_RAD):
                    continue
                scale = measured / abs(step) if scaled else 1.0
                direction = vector / measured * np.sign(step)
                off, order = _misfit(matrices_of, angles_rad, i, direction, scale)
                fits = off < FITS_RAD
                score = (int(fits.sum()), -float(off[fits].sum()))
                if score > best:
                    best, chosen = score, (i, direction, scale, order, fits)
        if best[0] > 0.6 * n_frames:
            break  # the angles are right; no need to try other scales
    if chosen is None:
        return None
    i, direction, scale, order, fits = chosen
    matrices = np.array([stack[k] for stack, k in zip(matrices_of, order, strict=True)])
    direction, turned = _refine(matrices, angles_rad, i, direction, scale, fits)
    slope, u_slope = _slope(_wrap(angles_rad[fits] - angles_rad[i]), turned[fits])
    return TurntableMotion(direction, order, fits, turned, slope, u_slope)


def _wrap(angle: Float[np.ndarray, "..."] | float) -> Float[np.ndarray, "..."]:
    """The same angle between -pi and pi."""
    return np.asarray(np.angle(np.exp(1j * np.asarray(angle))))


def _pairs(angles_rad: Float[np.ndarray, " f"]) -> list[tuple[int, int]]:
    """Pairs of frames to try: each frame with some that stand well apart; at most about 300."""
    n = len(angles_rad)
    apart = np.abs(_wrap(angles_rad[None, :] - angles_rad[:, None]))
    pairs = []
    for i in np.unique(np.linspace(0, n - 1, min(n, 20)).astype(int)):
        useful = np.flatnonzero((apart[i] > MIN_TURN_RAD) & (apart[i] < np.radians(170)))
        far_first = useful[np.argsort(-apart[i, useful], kind="stable")]
        pairs += [(int(i), int(j)) for j in far_first[:: max(1, len(far_first) // 15)]]
    return pairs


def _misfit(
    matrices: Sequence[np.ndarray], angles_rad: Float[np.ndarray, " f"], i: int, direction: np.ndarray, scale: float
) -> tuple[Float[np.ndarray, " f"], Int[np.ndarray, " f"]]:
    """Angle by which the best order of each frame misses the prediction from frame i, and that order."""
    turns = Rotation.from_rotvec(np.outer(_wrap(angles_rad - angles_rad[i]) * scale, direction)).as_matrix()
    off, order = np.empty(len(matrices)), np.zeros(len(matrices), dtype=int)
    for f, (stack, turn) in enumerate(zip(matrices, turns, strict=True)):
        traces = np.einsum("kab,ab->k", stack, turn @ matrices[i][0])
        order[f] = int(np.argmax(traces))
        off[f] = np.arccos(np.clip((traces[order[f]] - 1) / 2, -1.0, 1.0))
    return off, order


def _refine(
    matrices: Float[np.ndarray, "f 3 3"],
    angles_rad: Float[np.ndarray, " f"],
    i: int,
    direction: np.ndarray,
    scale: float,
    fits: Bool[np.ndarray, " f"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, " f"]]:
    """Direction that the turn leaves in place best: board directions R_f^T d agree over the frames."""
    spread = np.zeros((3, 3))
    mean = matrices[fits].mean(axis=0)
    for matrix in matrices[fits]:
        spread += (matrix - mean) @ (matrix - mean).T
    refined = np.linalg.eigh(spread)[1][:, 0]
    refined = refined * np.sign(refined @ direction)
    if refined @ direction < np.cos(FITS_RAD):
        refined = direction  # the turns are too short to improve on the consensus
    relative = Rotation.from_matrix(matrices @ matrices[i].T).as_rotvec() @ refined
    expected = _wrap(angles_rad - angles_rad[i]) * scale
    return refined, expected + _wrap(relative - expected)


def _slope(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Slope of y against x and its standard uncertainty."""
    x, y = x - x.mean(), y - y.mean()
    power = float(x @ x)
    if len(x) < 3 or power == 0.0:
        return 1.0, float("inf")
    slope = float(x @ y) / power
    return slope, float(np.sqrt(np.sum((y - slope * x) ** 2) / (len(x) - 2) / power))
