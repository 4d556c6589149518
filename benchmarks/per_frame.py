"""Time and error of stripe extraction for a frame, as multiples of reading the frame once.

The methods take turns on the same frames, which do not fit into the processor's cache together: every method gets each frame from memory.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.harness import Measurement, Setting, in_rounds
from benchmarks.rendered_frames import RenderedFrame, judge, rendered_frames
from benchmarks.stripe_methods import others
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.plain.extract import extract_stripe_plain

N_FRAMES = 48
"""59 MB of 1280 x 960 pixels."""
MOST_READ = 96
"""Files of a folder that are looked at."""
LIMIT = "np.max, one pass"
METHODS = {
    "gray-gravity": StripeOptions(method="gray-gravity"),
    "improved-gray-gravity": StripeOptions(),
    "improved-gray-gravity, average 5 px": StripeOptions(average_px=5),
    "steger": StripeOptions(method="steger"),
    "profile-fit": StripeOptions(method="profile-fit"),
}
"""Steger's method averages along the stripe; to compare, so does one line of the default."""


def ways() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """From an image to points, by name in the table; the last are this project's."""

    def own(extract: Callable[..., StripePoints], options: StripeOptions) -> Callable[[np.ndarray], np.ndarray]:
        return lambda image: extract(image, None, options).uv

    plain = {
        f"plain {name}": own(extract_stripe_plain, options)
        for name, options in METHODS.items()
        if not options.average_px
    }
    return others() | plain | {name: own(extract_stripe, options) for name, options in METHODS.items()}


def measure(setting: Setting) -> list[Measurement]:
    """Rendered frames, then the user's own, if there are any."""
    sets = {"rendered": _filled(rendered_frames(6 if setting.quick else N_FRAMES))}
    if setting.frames is not None:
        sets["given"] = _filled(_read(setting.frames))
    found = []
    for name, frames in sets.items():
        found += _measure(name, frames, setting.quick)
    return found


def _measure(title: str, frames: list[RenderedFrame], quick: bool) -> list[Measurement]:
    images = [frame.image for frame in frames]
    n = len(images)
    functions = {LIMIT: lambda i: np.max(images[i % n])}
    for name, way in ways().items():
        functions[name] = lambda i, way=way: way(images[i % n])  # type: ignore[misc]
    seconds = in_rounds(functions, 5 if quick else 25)
    judged = {name: judge(way, frames[: 6 if quick else n]) for name, way in ways().items()}

    height, width = images[0].shape
    print(f"{title}: {n} frames of {width} x {height}, grey, 8 bit")
    print(
        f"{'method':38}{'us a frame':>12}{'spread':>8}{'x limit':>9}{'rms px':>9}{'points':>8}{'found':>7}{'strays':>8}"
    )
    result = []
    for name, values in seconds.items():
        ratios = tuple(float(a / b) for a, b in zip(values, seconds[LIMIT], strict=True))
        here = [
            Measurement("per-frame", f"{title}: {name}", "s/frame", values),
            Measurement("per-frame", f"{title}: {name}, over the limit", "1", ratios),
        ]
        line = f"{name:38}{1e6 * here[0].median:12.0f}{1e6 * here[0].spread:8.0f}{here[1].median:9.1f}"
        if name in judged:
            rms, points, found, strays = judged[name]
            here += [
                Measurement("per-frame", f"{title}: {name}, rms error", "px", (rms,)),
                Measurement("per-frame", f"{title}: {name}, points a frame", "points", (points,)),
            ]
            line += f"{rms:9.4f}{points:8.0f}{found:7.3f}{strays:8.4f}" if np.isfinite(rms) else f"{'':9}{points:8.0f}"
        print(line)
        result += here
    return result


def _filled(frames: list[RenderedFrame]) -> list[RenderedFrame]:
    """At least so many frames in memory, each with its own copy of the image."""
    times = -(-N_FRAMES // len(frames))
    return [RenderedFrame(frame.image.copy(), frame.uv, frame.normal) for _ in range(times) for frame in frames]


def _read(folder: Path) -> list[RenderedFrame]:
    """The images of a folder, grey, 8 bit, those of the size of the first."""
    none = np.empty((0, 2))
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.iterdir())[:MOST_READ]]
    read = [image for image in images if image is not None]
    if not read:
        raise SystemExit(
            f"{folder}: there are no images here. Expected frames with the laser on, as PNG, JPEG, BMP or TIFF."
        )
    return [RenderedFrame(image, none, none) for image in read if image.shape == read[0].shape]
