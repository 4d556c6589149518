"""Time of stripe extraction for frames of 0.3 to 12 megapixels: the same scene, the stripe as many pixels long as the frame is high."""

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.harness import Measurement, Setting, in_rounds
from benchmarks.rendered_frames import rendered_frames
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe

SIZES = ((640, 480), (1280, 960), (2048, 1536), (2880, 2160), (4000, 3000))
BYTES = 60e6
"""Of the frames of one size together: more than the processor's cache."""


def measure(setting: Setting) -> list[Measurement]:
    """One pass over the pixels, and the default method."""
    found = []
    print(f"{'frame':>12}{'MP':>7}{'np.max us':>11}{'extraction us':>15}{'x limit':>9}{'points':>8}")
    for size in SIZES[:3] if setting.quick else SIZES:
        pixels = size[0] * size[1]
        frames = rendered_frames(2 if pixels > 2e6 else 3, size)
        images = [f.image.copy() for f in frames for _ in range(-(-int(BYTES) // (pixels * len(frames))))]
        functions: dict[str, Callable[[int], object]] = {
            "np.max, one pass": partial(_pass, images),
            "extraction": partial(_extract, images),
        }
        seconds = in_rounds(functions, 5 if setting.quick else 15)
        rows = [Measurement("resolution", n, "s/frame", v, pixels, "pixels") for n, v in seconds.items()]
        n_points = np.mean([len(extract_stripe(f.image)) for f in frames])
        limit, own = (1e6 * row.median for row in rows)
        print(f"{size[0]:>7}x{size[1]:<5}{pixels / 1e6:6.2f}{limit:11.0f}{own:15.0f}{own / limit:9.1f}{n_points:8.0f}")
        found += rows
    return found


def _pass(images: list[np.ndarray], i: int) -> None:
    np.max(images[i % len(images)])


def _extract(images: list[np.ndarray], i: int) -> None:
    extract_stripe(images[i % len(images)], None, StripeOptions())
