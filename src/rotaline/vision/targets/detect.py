"""Finding a calibration target in an image."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float32

from rotaline.errors import DetectionError
from rotaline.vision.images import Image, to_grey
from rotaline.vision.targets.charuco import detect_charuco
from rotaline.vision.targets.checkerboard import detect_checkerboard
from rotaline.vision.targets.dots import detect_dots
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target, TargetDetection


@dataclass(frozen=True)
class TargetOptions:
    """Options of target detection."""

    channel: Literal["auto", "grey", "red", "green", "blue", "darkest"] = field(
        default="auto",
        metadata={
            "help": "channel of a colour image: auto takes grey and, if points are missing, the darkest channel (blind to a laser)"
        },
    )
    coarse_size_px: int = field(
        default=1280, metadata={"help": "longer side of the reduced image in which targets are looked for first, px"}
    )
    min_side_px: int = field(default=32, metadata={"help": "smallest side of an image that is looked at, px"})


def detect_target(image: Image, target: Target, options: TargetOptions | None = None) -> TargetDetection:
    """Find a checkerboard, dot plate or ChArUco board and measure its points.

    The order of the points is right-handed and row by row; what symmetry leaves open is settled by convention
    (:func:`rotaline.vision.targets.ordering.canonical`). Points that are covered, glared over or crossed by a stripe are left
    out where they do not fit the others.

    Parameters
    ----------
    image : (h, w) or (h, w, 3)   uint8 or uint16
    target : Target
    options : TargetOptions or None   None: the defaults

    Returns
    -------
    TargetDetection

    Raises
    ------
    DetectionError
        If the target is not found. The message says what was nearly found (a board of another size, other markers), or
        what is wrong with the image (too small, dark, overexposed).
    """
    options = options or TargetOptions()
    if options.channel == "auto" and image.ndim == 3:
        try:
            grey = detect_target(image, target, replace(options, channel="grey"))
        except DetectionError as error:
            try:
                return detect_target(image, target, replace(options, channel="darkest"))
            except DetectionError:
                raise error from None
        if len(grey.point_ids) == len(target.points_board()) or isinstance(target, CharucoBoard):
            return grey
        try:
            darkest = detect_target(image, target, replace(options, channel="darkest"))
        except DetectionError:
            return grey
        return darkest if len(darkest.point_ids) > len(grey.point_ids) and darkest.u_px < 1.5 * grey.u_px else grey
    grey_image = _levelled(_channel(image, options.channel), options.min_side_px)
    match target:
        case Checkerboard():
            return detect_checkerboard(grey_image, target, options.coarse_size_px)
        case DotGrid():
            return detect_dots(grey_image, target, options.coarse_size_px)
        case CharucoBoard():
            return detect_charuco(grey_image, target, options.coarse_size_px)


def _channel(image: Image, channel: str) -> np.ndarray:
    if image.ndim == 2:
        return image
    if channel == "darkest":
        return image.min(axis=2)
    if channel in ("red", "green", "blue"):
        return image[:, :, ("red", "green", "blue").index(channel)]
    return to_grey(image)


def _levelled(grey: np.ndarray, min_side_px: int) -> Float32[np.ndarray, "h w"]:
    """Grey values stretched to 0 ... 255.

    Raises
    ------
    DetectionError
        If the image is too small or has no contrast.
    """
    height, width = grey.shape
    if min(height, width) < min_side_px:
        raise DetectionError(
            f"The image is {width} x {height} pixels; a target needs at least {min_side_px} each way. Is it the right file?"
        )
    full = float(np.iinfo(grey.dtype).max)
    low, high = (float(x) for x in np.percentile(grey[::3, ::3], (0.1, 99.9)))
    if high - low < 0.012 * full:
        if high < 0.1 * full:
            raise DetectionError(
                f"The image is dark all over (grey values {low:.0f} to {high:.0f} of {full:.0f}): light the target or expose longer."
            )
        if low > 0.9 * full:
            raise DetectionError(
                f"The image is white all over (grey values {low:.0f} to {high:.0f} of {full:.0f}): expose shorter."
            )
        raise DetectionError(f"The image has no contrast (grey values {low:.0f} to {high:.0f} of {full:.0f}).")
    return (grey.astype(np.float32) - np.float32(low)) * np.float32(255.0 / (high - low))
