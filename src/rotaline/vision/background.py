"""Whether a laser-off frame shows the same scene in the same light as a laser-on frame."""

import cv2
import numpy as np
from jaxtyping import Shaped

from rotaline.vision.images import Image, to_grey

_SMALL = (160, 120)


def shows_same_scene(image: Image, background: Shaped[np.ndarray, "..."]) -> bool:
    """True if the laser-off frame can serve as background: away from the stripe both have the same brightness.

    Many rigs switch the room light together with the laser, or change the exposure; subtracting such a frame would
    destroy the stripe.
    """
    if image.shape != background.shape or image.dtype != background.dtype:
        return False
    a, b = (cv2.resize(to_grey(i), _SMALL, interpolation=cv2.INTER_AREA).astype(float) for i in (image, background))
    difference = np.abs(a - b)
    away = difference <= np.quantile(difference, 0.95)
    level = float(np.mean(np.maximum(a, b)[away]))
    return float(np.mean(difference[away])) < 0.1 * level + 1.0
