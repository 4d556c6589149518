"""One grey image in which to look for the stripe, and one in which to measure it, from a grey or colour frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from rotaline.vision.images import Image

_CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True, eq=False)
class StripeSignal:
    """What the later steps work on.

    Attributes
    ----------
    score : (h, w)   the stripe is bright here and little else is; for finding
    value : (h, w)   grey values in which the centre is measured
    clipped : (h, w)   pixels of ``value`` at the top of the range
    unit : float   one grey value of an 8 bit image (1 or 257)
    channel : str   channel that was taken
    """

    score: Float32[np.ndarray, "h w"]
    value: Float32[np.ndarray, "h w"]
    clipped: Bool[np.ndarray, "h w"] | None
    unit: float
    channel: str


def stripe_signal(image: Image, background: Image | None, channel: str) -> StripeSignal:
    """Choose the channel and subtract the background."""
    if background is not None and (background.shape != image.shape or background.dtype != image.dtype):
        raise ValueError(
            f"the background is {background.shape} {background.dtype}, the image {image.shape} {image.dtype}; "
            "both must come from the same camera settings"
        )
    top = np.iinfo(image.dtype).max
    unit = float(top) / 255.0
    limit = top - round(2 * unit) if top == 255 else int(0.98 * top)
    if image.ndim == 2:
        clipped = image >= limit
        value = image.astype(np.float32)
        if background is not None:
            value -= background
        return StripeSignal(value, value, clipped if clipped.any() else None, unit, "grey")
    planes = image.astype(np.float32)
    if background is not None:
        planes -= background
    if channel in _CHANNELS:
        k = _CHANNELS.index(channel)
        value = np.ascontiguousarray(planes[:, :, k])
        clipped = image[:, :, k] >= limit
    elif channel == "grey":
        value = planes.mean(axis=2)
        clipped = np.asarray((image >= limit).any(axis=2))
    else:
        value = np.ascontiguousarray(planes[:, :, 0])
        clipped = image[:, :, 0] >= limit
    score = value
    if channel == "auto":
        score = planes[:, :, 0] - 0.5 * (planes[:, :, 1] + planes[:, :, 2])
    return StripeSignal(score, value, clipped if clipped.any() else None, unit, channel)
