"""Exposures that the program finds itself: what is measured is bright, and not saturated."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rotaline.errors import DetectionError
from rotaline.hardware.camera import CameraFrame
from rotaline.vision.images import Image, to_grey
from rotaline.vision.stripe.extract import extract_stripe

STRIPE_LEVEL = 0.75
"""Share of full scale in the stripe's core, 95 of 100 points at most: speckle and gloss go beyond."""
WHITE_LEVEL = 0.8
_SATURATED_SHARE = 0.03
_STEP = 6.0
"""The largest factor from one trial to the next."""
_NEAR = 0.08
_TRIALS = 12

TakeAt = Callable[[float], CameraFrame]
"""A frame at an exposure, us; the camera rounds it."""


@dataclass(frozen=True)
class FoundExposure:
    """An exposure, us; ``level``: what is bright, as a share of full scale; ``saturated``: share of it that is at full scale."""

    exposure_us: float
    level: float
    saturated: float
    note: str = ""


@dataclass(frozen=True)
class _Brightness:
    level: float
    saturated: float


def _of_stripe(image: Image) -> _Brightness | None:
    """How bright the core of the stripe is; None: there is no stripe."""
    points = extract_stripe(image)
    if len(points.uv) < 0.05 * min(image.shape[:2]):
        return None
    grey = image if image.ndim == 2 else image.max(axis=2)
    full = float(np.iinfo(image.dtype).max)
    u, v = np.clip(np.rint(points.uv).astype(int), 1, np.array(grey.shape[::-1]) - 2).T
    core = np.max([grey[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=0) / full
    return _Brightness(float(np.quantile(core, 0.95)), float(np.mean(core >= 0.995)))


def _of_scene(image: Image) -> _Brightness:
    """How bright the brightest hundredth of a lit scene is."""
    grey = to_grey(image)
    full = float(np.iinfo(image.dtype).max)
    return _Brightness(float(np.quantile(grey[::2, ::2], 0.99)) / full, float(np.mean(grey >= 0.995 * full)))


def expose_stripe(take_at: TakeAt, start_us: float, limits_us: tuple[float, float]) -> FoundExposure:
    """The exposure at which the core of the stripe is bright and not saturated.

    Raises
    ------
    DetectionError
        If no stripe shows at any exposure.
    """

    def measured(exposure_us: float) -> _Brightness | None:
        return _of_stripe(take_at(exposure_us).image)

    found = _search(measured, start_us, limits_us, STRIPE_LEVEL)
    if found is None:
        raise DetectionError(
            f"No laser stripe was found at exposures from {limits_us[0]:.0f} to {limits_us[1]:.0f} us. Is the laser on and its line in "
            "view? Look at a frame with `rotaline rig check`, or state exposure_on_us in the plan."
        )
    return found


def expose_scene(take_at: TakeAt, start_us: float, limits_us: tuple[float, float]) -> FoundExposure:
    """The exposure at which white is bright and not saturated."""
    found = _search(lambda e: _of_scene(take_at(e).image), start_us, limits_us, WHITE_LEVEL)
    assert found is not None
    return found


def better_exposure(image: Image, exposure_us: float, limits_us: tuple[float, float]) -> float:
    """The exposure for the next frame of a scene, us, from how bright this one is: one step of the search, for previews."""
    return float(np.clip(exposure_us * _factor(_of_scene(image), WHITE_LEVEL), *limits_us))


def _factor(seen: _Brightness, wanted: float) -> float:
    return 0.5 if seen.saturated > _SATURATED_SHARE else wanted / max(seen.level, wanted / _STEP)


def _search(
    measured: Callable[[float], _Brightness | None], start_us: float, limits_us: tuple[float, float], wanted: float
) -> FoundExposure | None:
    low, high = limits_us
    exposure = float(np.clip(start_us, low, high))
    best, tried = None, []
    for _ in range(_TRIALS):
        tried.append(exposure)
        seen = measured(exposure)
        if seen is not None:
            best = _found(exposure, seen, limits_us, wanted)
            factor = _factor(seen, wanted)
            if abs(factor - 1.0) <= _NEAR:
                break
            following = float(np.clip(exposure * factor, low, high))
        elif best is not None:
            break
        else:  # too dark: longer; or, where that has been tried, washed out: shorter
            following = min(_STEP * max(tried), high) if max(tried) < high else max(min(tried) / _STEP, low)
        if following in tried:
            break
        exposure = following
    return best


def _found(exposure: float, seen: _Brightness, limits_us: tuple[float, float], wanted: float) -> FoundExposure:
    note = ""
    if exposure >= 0.999 * limits_us[1] and seen.level < 0.5 * wanted:
        note = (
            f"it stays dark ({100 * seen.level:.0f} % of full scale) at the longest exposure: open the lens or add gain"
        )
    if exposure <= 1.001 * limits_us[0] and seen.saturated > _SATURATED_SHARE:
        note = (
            f"it is saturated ({100 * seen.saturated:.0f} %) at the shortest exposure: close the lens or dim the laser"
        )
    return FoundExposure(exposure, seen.level, seen.saturated, note)
