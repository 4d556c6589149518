"""From an image to the centre points of the laser stripe."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rotaline.vision.images import Image
from rotaline.vision.stripe.centres import Centres, weighted_centroid
from rotaline.vision.stripe.curve import local_lines, resample_polyline
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.profiles import sample_profiles
from rotaline.vision.stripe.ridges import Ridge, find_ridges
from rotaline.vision.stripe.signal import StripeSignal, stripe_signal

Method = Literal["gray-gravity", "improved-gray-gravity", "steger", "profile-fit"]
Channel = Literal["auto", "red", "green", "blue", "grey"]


@dataclass(frozen=True)
class StripeOptions:
    """How the stripe is found and measured."""

    method: Method = field(default="improved-gray-gravity", metadata={"help": "how the centre is found in a profile"})
    channel: Channel = field(
        default="auto", metadata={"help": "channel of a colour image; auto takes the one that shows the stripe best"}
    )
    threshold: float = field(
        default=6.0, metadata={"help": "least height of the stripe, as a multiple of the image's noise"}
    )
    min_contrast: float = field(
        default=2.0, metadata={"help": "least height of the stripe, grey values of an 8 bit image"}
    )
    min_length_px: float = field(default=10.0, metadata={"help": "shorter pieces of stripe are dropped, px"})


def extract_stripe(
    image: Image, background: Image | None = None, options: StripeOptions = StripeOptions()
) -> StripePoints:
    """Centre points of the laser stripe, about one a pixel of its length.

    Parameters
    ----------
    image : (h, w) or (h, w, 3)   uint8 or uint16
    background : same shape and type, or None   the same view with the laser off
    options : StripeOptions

    Returns
    -------
    StripePoints
        Empty if the image shows no stripe.

    Raises
    ------
    ValueError
        If the two images differ in shape or type.
    """
    signal = stripe_signal(image, background, options.channel, options.threshold, options.min_contrast)
    ridges = find_ridges(signal.score, options.threshold, options.min_contrast * signal.unit, options.min_length_px)
    pieces = [_trace(signal, ridge) for ridge in ridges]
    pieces = [piece for piece in pieces if len(piece) >= options.min_length_px]
    return _join(pieces, signal)


def _trace(signal: StripeSignal, ridge: Ridge) -> StripePoints:
    """Refine the centres of one ridge."""
    uv = ridge.uv
    if len(uv) < 4:
        return _empty()
    smooth, _ = local_lines(uv, 3)
    uv = resample_polyline(smooth, 1.0)
    if len(uv) < 4:
        return _empty()
    width = np.full(len(uv), 1.5 * ridge.scale_px)
    centres: Centres | None = None
    normal = np.zeros_like(uv)
    for last in (False, False, True):
        smooth, tangent = local_lines(uv, 6)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        profiles = sample_profiles(signal.value, signal.clipped, smooth, normal, 4.0 * width + 3.0)
        centres = weighted_centroid(profiles, width)
        moved = np.abs(centres.shift_px) <= 2.0 * width + 1.0
        good = moved & (centres.height > 0) & np.isfinite(centres.u_px)
        if good.sum() < 4:
            return _empty()
        uv = (smooth + normal * centres.shift_px[:, None])[good]
        if not last:
            smooth_again, _ = local_lines(uv, 3)
            wide = float(np.median(centres.width_px[good]))
            uv = resample_polyline(smooth_again, 1.0)
            if len(uv) < 4:
                return _empty()
            width = np.full(len(uv), min(max(wide, 0.7), 3.0 * ridge.scale_px))
    assert centres is not None
    noise = float(np.nanmedian(centres.noise[good])) if np.isfinite(centres.noise[good]).any() else signal.noise
    u = centres.u_px[good] * max(noise, 0.3 * signal.unit)
    n = int(good.sum())
    return StripePoints(
        uv=uv,
        normal=normal[good],
        width_px=centres.width_px[good],
        intensity=centres.height[good],
        u_normal_px=u,
        saturated=centres.saturated[good],
        segment=np.zeros(n, dtype=np.int64),
    )


def _join(pieces: list[StripePoints], signal: StripeSignal) -> StripePoints:
    """Number the pieces and put them in one value."""
    if not pieces:
        return _empty()
    segment = np.concatenate([np.full(len(piece), k, dtype=np.int64) for k, piece in enumerate(pieces)])
    return StripePoints(
        np.concatenate([piece.uv for piece in pieces]),
        np.concatenate([piece.normal for piece in pieces]),
        np.concatenate([piece.width_px for piece in pieces]),
        np.concatenate([piece.intensity for piece in pieces]),
        np.concatenate([piece.u_normal_px for piece in pieces]),
        np.concatenate([piece.saturated for piece in pieces]),
        segment,
    )


def _empty() -> StripePoints:
    """No points."""
    none = np.zeros(0)
    return StripePoints(
        np.zeros((0, 2)), np.zeros((0, 2)), none, none, none, np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
    )
