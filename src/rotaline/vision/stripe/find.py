"""Where the stripe is, at the speed of the memory: what :mod:`rotaline.vision.stripe.ridges` finds, without working on every pixel.

One sweep over the image takes the highest value of each column in tiles of 16 x 16 pixels. Only tiles in which two neighbouring columns stand out
from the darkest ones around by what the faintest ridge would are looked at. Where these are few, chains are grown along the ridges in them
(:mod:`rotaline.vision.stripe.grow_kernels`) until no light is left. Where that does not explain them, or they are many, they are searched, and those
next to them that a chain runs into. The noise, where it sets the limit, is measured in some tiles only, and in more of them where no chain is clear;
tiles that are let in by chance cost time and change nothing.

The half and the quarter size of the image are looked at where the full size leaves something unexplained: a chain that is wide, or something
bright beside the chains that is a ridge in the half or quarter size of its tile. In a frame with a thin stripe in the dark that never happens.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8, UInt16

from rotaline.vision.images import Image
from rotaline.vision.stripe.assemble_kernels import assemble
from rotaline.vision.stripe.channels import (
    STEPS,
    channels_of,
    measuring_channel,
    plane_of,
    planes_of,
    score_image,
    steps_of,
)
from rotaline.vision.stripe.explain_kernels import ridges_beside
from rotaline.vision.stripe.find_kernels import CAREFUL, EVERYWHERE, QUICK, candidates, look
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.grow_kernels import grow
from rotaline.vision.stripe.options import StripeOptions
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.settle_kernels import BESIDE, choose, compete
from rotaline.vision.stripe.signal import CLEAR, score_names
from rotaline.vision.stripe.tile_kernels import TILE, half_size

Values = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]
_LEVELS = 3
_LEAST_SIZE = 16  # px; of a smaller image no half is made
_LEAST_SEARCHED = 7  # px
_CLEAR = 1.5  # limits: to a stripe as prominent the exact limit, and what stands out by less, does not matter
_LINES_OF_TILES = 4  # rows and columns of tiles; what is bright in more of them is no stripe in the dark
_FEW_LEFT = 24  # tiles; where more are not explained, the whole image is looked at


@dataclass(frozen=True, eq=False)
class Chains:
    """Chains of the three sizes of an image, and the parts of them that no stronger one covers.

    Attributes
    ----------
    line, place, prominence : (n,)   points, px of the size in which they were found; the line is the row of steep chains, the column of flat ones
    between, spread : (n,)   what is to be added to the place to get to the top, px; variance of the smoothed profile there, along the line, px^2
    start : (k + 1,)   where each chain begins
    steep, factor : (k,)   kind of each chain (1 for steep), and px of the full image for one of its own
    parts : (3, m)   where the parts begin and end, and the chains they are of
    """

    line: Int32[np.ndarray, " n"]
    place: Int32[np.ndarray, " n"]
    prominence: Float32[np.ndarray, " n"]
    between: Float32[np.ndarray, " n"]
    spread: Float32[np.ndarray, " n"]
    start: Int32[np.ndarray, " k1"]
    steep: Int32[np.ndarray, " k"]
    factor: Int32[np.ndarray, " k"]
    parts: Int32[np.ndarray, "3 m"]


@dataclass(frozen=True, eq=False)
class Chosen:
    """The stripe that one image shows.

    Attributes
    ----------
    stripe : FoundStripe
    prominence : (n,)   of its points
    steep : (k,)   kind of its chains
    strength, usual, length_px : float   of the strongest chain: sum and median of its prominence, and its length
    """

    stripe: FoundStripe
    prominence: Float[np.ndarray, " n"]
    steep: Bool[np.ndarray, " k"]
    strength: float
    usual: float
    length_px: float


class _Space:
    """Work space for images of one size: for tiles, candidates and chains, and a map of zeros."""

    def __init__(self, shape: tuple[int, int]) -> None:
        rows, columns = -(-shape[0] // TILE), -(-shape[1] // TILE)
        self.zeros = np.zeros(shape, dtype=np.float32)
        self.height = np.zeros((rows, columns), dtype=np.float32)
        self.order, self.light = (
            np.zeros((3, (rows + 2) * columns + 2), dtype=np.int32),
            np.zeros(rows * columns + 1, dtype=np.uint64),
        )
        self.stands = np.zeros((2, rows * columns), dtype=np.float32)
        self.more_room(max(4096, 2 * sum(shape)))

    def more_room(self, n: int) -> None:
        """Make room for ``n`` candidates of each kind."""
        self.where, self.what = np.zeros((4, n), dtype=np.int32), np.zeros((8, n), dtype=np.float32)
        self.points, self.heights = np.zeros((3, 2 * n), dtype=np.int32), np.zeros((4, 2 * n), dtype=np.float32)
        self.chains, self.parts = np.zeros((2, 3, n), dtype=np.int32)


class _Spaces(threading.local):
    """The work spaces of one thread: those of the sizes that were asked for last."""

    def __init__(self) -> None:
        self.by_shape: dict[tuple[int, int], _Space] = {}

    def of(self, h: int, w: int) -> _Space:
        """That of a size; a full image, its half and its quarter are kept at the same time."""
        space = self.by_shape.get((h, w))
        if space is None:
            if len(self.by_shape) >= _LEVELS:
                del self.by_shape[next(iter(self.by_shape))]
            space = self.by_shape[h, w] = _Space((h, w))
        return space


_spaces = _Spaces()


def find(image: Image, background: Image | None, options: StripeOptions) -> tuple[FoundStripe, Plane]:
    """Find the stripe of a frame.

    Returns
    -------
    stripe : FoundStripe   without points, where there is none
    plane : Plane   in which it is to be measured

    Raises
    ------
    ValueError
        If image and background differ in shape or type.
    """
    if image.ndim == 2 and background is None:
        plane = Plane(image, image)
        floor = options.min_contrast * plane.unit
        return find_chains(image, options.threshold, floor, options.min_length_px, 1.0).stripe, plane
    channels = channels_of(image, background)
    if image.ndim == 2:
        plane = plane_of(channels, 0)
        values = steps_of(plane)
        return find_chains(
            values, options.threshold, options.min_contrast * STEPS, options.min_length_px, 0.0
        ).stripe, plane
    best: Chosen | None = None
    clear, planes = False, planes_of(channels)
    for name in score_names(options.laser_colour):
        if name == "grey" and clear and background is None:
            continue  # see signal.find_stripe
        chosen = find_chains(
            score_image(channels, planes, name),
            options.threshold,
            options.min_contrast * STEPS,
            options.min_length_px,
            0.0,
        )
        if best is None or chosen.strength > best.strength:
            best = chosen
            clear |= chosen.length_px >= 3.0 * options.min_length_px and chosen.usual >= CLEAR * STEPS
    assert best is not None
    found = best.stripe
    k = measuring_channel(channels, options.channel, found.uv, best.prominence, found.chain, best.steep, found.scale_px)
    return replace(found, clear=False), plane_of(channels, k)


def find_chains(
    image: Values, threshold: float, floor: float, min_length_px: float, rounding: float, everywhere: bool = False
) -> Chosen:
    """Find the stripe in an image in which it is bright.

    Parameters
    ----------
    image : (h, w)
    threshold : float   least prominence as a multiple of the prominence of the image's noise
    floor : float   least prominence in grey values
    min_length_px : float   a chain as long is no speck
    rounding : float   step of the grey values; 0 where they are not rounded
    everywhere : bool   search every tile in all three sizes, and not only those where something may be
    """
    chains, chosen, explained, least = _search(image, 1.0, threshold, floor, min_length_px, rounding, everywhere)
    if everywhere or not explained:
        found = _with_smaller_sizes(chains(), image, threshold, floor, min_length_px, everywhere)
        chosen = choose(
            found.line, found.place, found.prominence, found.between, found.spread, found.steep, found.factor, found.parts,
            found.parts.shape[1], min_length_px, least,
        )  # fmt: skip
    uv, prominence, chain, spread, scale, steep, crowded, clear, strength, usual, length = chosen
    return Chosen(FoundStripe(uv, chain, spread, scale, crowded, clear), prominence, steep, strength, usual, length)


def _search(
    image: Values, scale: float, threshold: float, floor: float, min_length_px: float, rounding: float, everywhere: bool
) -> tuple[Callable[[], Chains], tuple[Any, ...], bool, float]:
    """Find the chains of one size of an image, of which a step stands for ``scale`` grey values.

    Returns
    -------
    chains : function   that returns the chains; to be called before another image of this size is searched
    chosen : tuple   the stripe by these alone, see :func:`rotaline.vision.stripe.settle_kernels.choose`
    explained : bool   no smaller size needs to be looked at
    least : float   prominence of a candidate
    """
    h, w = image.shape
    if min(h, w) < _LEAST_SEARCHED:
        image, (h, w) = np.zeros((_LEAST_SEARCHED, _LEAST_SEARCHED), dtype=np.uint8), (_LEAST_SEARCHED,) * 2
    values, space = _readable(image), _spaces.of(h, w)
    for effort in (EVERYWHERE,) if everywhere else (QUICK, CAREFUL):
        n_queue, least_steep, least_flat, by_noise = look(
            values, scale, threshold, floor, rounding, effort, space.order[0], space.stands
        )
        least, smaller = max(least_steep, least_flat), min(least_steep, least_flat)
        if effort == QUICK and n_queue <= _LINES_OF_TILES * sum(space.height.shape):
            n_chains, n_parts, left, chosen = grow(
                values, scale, n_queue, least_steep, least_flat, space.stands, space.height, space.order, space.light,
                space.points, space.heights, space.chains, space.parts, min_length_px,
            )  # fmt: skip
            sure = by_noise < floor or chosen[-2] > _CLEAR * least
            if sure and _explained(values, scale, space, left, smaller):
                return partial(_chains_in, space, n_chains, n_parts), chosen, True, least
        n_tiles = -1
        while n_tiles < 0:
            n_tiles, n_steep, n_flat = candidates(
                values, scale, n_queue, least_steep, least_flat, space.height, space.order, space.light, space.where,
                space.what,
            )  # fmt: skip
            if n_tiles < 0:
                space.more_room(4 * space.where.shape[1])
        n_chains, n_parts, left, chosen = assemble(
            n_tiles, n_steep, n_flat, h, w, space.height, space.order, space.light, space.where, space.what,
            space.points, space.heights, space.chains, space.parts, min_length_px, least,
        )  # fmt: skip
        if by_noise < floor or chosen[-2] > _CLEAR * least:
            break
    explained = _explained(values, scale, space, left, smaller)
    return partial(_chains_in, space, n_chains, n_parts), chosen, explained, least


def _explained(image: Values, scale: float, space: _Space, left: int, least: float) -> bool:
    """Whether no smaller size of an image needs to be looked at because of the tiles in which light is left."""
    if left <= 0 or left > _FEW_LEFT:
        return left == 0
    return not ridges_beside(image, scale, space.order[2, :left], space.light[:left], space.height.shape[1], least)


def _chains_in(space: _Space, n_chains: int, n_parts: int) -> Chains:
    """The chains that were found last in a work space."""
    start, steep, factor = space.chains
    n = start[n_chains]
    return Chains(
        space.points[0, :n],
        space.points[1, :n],
        space.heights[0, :n],
        space.heights[2, :n],
        space.heights[3, :n],
        start[: n_chains + 1],
        steep[:n_chains],
        factor[:n_chains],
        space.parts[:, :n_parts],
    )


def _readable(image: Values) -> Values:
    """The same values, for reading only: so one compiled kernel serves all images of a type."""
    view = np.ascontiguousarray(image).view()
    view.flags.writeable = False
    return view


def _with_smaller_sizes(
    full: Chains, image: Values, threshold: float, floor: float, min_length_px: float, everywhere: bool
) -> Chains:
    """The chains of the full size with those of the half and the quarter size, after all of them have competed."""
    sizes, factors, shape, scale = [full], [full.factor], image.shape, 1.0
    # sums of 16 values of 8 bit fit into 16 bit
    divided_by, step = (1, 0.25) if image.dtype == np.uint8 else (4, 1.0)
    for level in range(1, _LEVELS):
        if min(image.shape) < _LEAST_SIZE:
            break
        smaller = np.empty((image.shape[0] // 2, image.shape[1] // 2), dtype=np.uint16)
        half_size(_readable(image), divided_by, smaller)
        image, scale = smaller, scale * step
        sizes.append(_search(image, scale, threshold, floor, min_length_px, 0.0, everywhere)[0]())
        factors.append(sizes[-1].factor * np.int32(2**level))
    line, place, prominence, between, spread, steep = (
        np.concatenate([getattr(one, name) for one in sizes])
        for name in ("line", "place", "prominence", "between", "spread", "steep")
    )
    lengths = np.concatenate([np.diff(one.start) for one in sizes])
    start = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    factor = np.concatenate(factors)
    parts = np.empty((3, len(line)), dtype=np.int32)
    n_parts = compete(
        line, place, prominence, start, steep, factor, len(factor), *shape, parts, _spaces.of(*shape).zeros, BESIDE
    )
    return Chains(line, place, prominence, between, spread, start, steep, factor, parts[:, :n_parts].copy())
