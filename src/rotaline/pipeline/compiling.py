"""Compiling the kernels of stripe extraction in processes side by side, before the first frame needs them.

numba compiles one function at a time in a process. What finds stripes, what measures clear ones and what measures others share little, so that
processes, which work on made-up images and leave the machine code on disk, take half the time. What they did not meet is compiled when it is needed.
"""

import gc
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np
from jaxtyping import Float

from rotaline.geometry.compiled import machine_code_stored
from rotaline.pipeline.observer import LOG
from rotaline.vision.images import Image
from rotaline.vision.stripe.channels import channels_of, plane_of
from rotaline.vision.stripe.extract import StripeOptions, measure_stripe
from rotaline.vision.stripe.find import find
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.plane import Plane

_SIZE, _LENGTH, _GAP = 160, 120, 120  # px of an image, and of the stripe in it, and where that is interrupted
_THIN_PX, _WIDE_PX = 1.2, 5.0
_CASES = ((_THIN_PX, 0.6, 1.0, True), (_THIN_PX, 1.1, 1.0, False), (_WIDE_PX, 0.6, 4.0, False))
"""Width and height of stripes, size of the image in which they are found, and whether they are clear."""
TASKS = ("find", "measure clear", "measure others")


def kernels_missing() -> bool:
    """Whether nothing was compiled yet for this version of the program."""
    return not machine_code_stored("find_kernels")


def compile_if_missing(
    note: Callable[[str], None], image: Image, has_background: bool = False, options: StripeOptions | None = None
) -> None:
    """Compile what images of this kind need, if nothing was compiled yet; an interrupt ends it.

    Parameters
    ----------
    note : is told, if it is done
    image : a frame, of which only type and channels count
    has_background : there are images with the laser off
    options : None for the defaults
    """
    if not kernels_missing():
        return
    note("compiling for this processor first: half a minute or more, this one time")
    options = options or StripeOptions()
    kind = (image.dtype.name, str(image.ndim), str(int(has_background)), options.method, options.laser_colour)
    with ExitStack() as open_processes:
        processes = [
            open_processes.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", __name__, task, *kind],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
            for task in TASKS
        ]
        for process in processes:
            open_processes.callback(process.kill)
        for process in processes:
            _, errors = process.communicate()
            if process.returncode:
                LOG.warning("compiling ahead failed, so that it takes longer: %s", errors.strip()[-1000:])


def exercise(task: str, dtype: str, ndim: int, has_background: bool, options: StripeOptions) -> int:
    """Find stripes in made-up images, or measure stripes that are known to be there, clear ones or others; returns how many points there were."""
    line = np.arange(_SIZE // 2 - _LENGTH // 2, _SIZE // 2 + _LENGTH // 2, dtype=float)
    uv, chain = np.stack([_place(line), line], axis=1), np.zeros(len(line), dtype=np.int64)
    background = _sample(dtype, ndim, _WIDE_PX, 0.0) if has_background else None
    n = 0
    for width_px, height, scale_px, clear in _CASES:
        image = _sample(dtype, ndim, width_px, height)
        if task == "find":
            n += len(find(image, background, options)[0].uv)
        if task != ("measure clear" if clear else "measure others"):
            continue
        plain = ndim == 2 and background is None
        plane = Plane(image, image) if plain else plane_of(channels_of(image, background), 0)
        spread_px2 = np.full(len(line), width_px**2 + scale_px**2)
        found = FoundStripe(uv, chain, spread_px2, np.array([scale_px]), False, clear)
        n += len(measure_stripe(found, plane, options).uv)
    return n


def _sample(dtype: str, ndim: int, width_px: float, height: float) -> Image:
    """An image of a stripe that is not quite upright, with a short piece at its end; with a height above 1 the sensor is saturated."""
    v, u = np.mgrid[:_SIZE, :_SIZE].astype(float)
    light = np.exp(-0.5 * ((u - _place(v)) / width_px) ** 2)
    light *= (np.abs(v - _SIZE / 2) < _LENGTH / 2) & (np.abs(v - _GAP) > 3)
    noise = np.random.default_rng(0).normal(0.04, 0.004, light.shape)
    top = float(np.iinfo(dtype).max)
    image = np.clip(top * (height * light + noise), 0.0, top).astype(dtype)
    return image if ndim == 2 else np.repeat(image[:, :, None], 3, axis=2)


def _place(v: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Columns of the middle of the stripe in these rows."""
    return _SIZE / 2 + 0.2 * (v - _SIZE / 2)


if __name__ == "__main__":
    gc.disable()  # faster, and short
    _task, _dtype, _ndim, _has_background, _method, _colour = sys.argv[1:]
    exercise(
        _task,
        _dtype,
        int(_ndim),
        _has_background == "1",
        StripeOptions(method=_method, laser_colour=_colour),  # type: ignore[arg-type]
    )
