"""Every method of the stripe stage on synthetic stripes with known centres, beside the Cramér-Rao bound."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe

METHODS: dict[str, StripeOptions] = {
    "gray-gravity": StripeOptions(method="gray-gravity"),
    "steger": StripeOptions(method="steger"),
    "profile-fit": StripeOptions(method="profile-fit"),
    "improved-gray-gravity": StripeOptions(method="improved-gray-gravity"),
    "improved-gray-gravity, average 5 px": StripeOptions(method="improved-gray-gravity", average_px=5),
}
"""Name in the table and options; the last is the default method averaged along the stripe, as Steger's is."""

_MARGIN_PX = 8.0


@dataclass(frozen=True)
class StripeVerificationRow:
    """One method on one case, over several images.

    Attributes
    ----------
    case, method : str
    n_points : int   centres found in all images, apart from those near the image's border
    found_fraction : float   length of stripe with a centre within 1 px along it, over all length
    rms_px, bias_px : float   of the signed distance from the true centre along the true normal
    largest_px : float   largest absolute distance
    stated_over_scatter : float   stated uncertainty (rms) over the scatter about the bias
    bound_px : float   Cramér-Rao bound of one centre from a pixel row's worth of stripe, noise alone; NaN where
        clipping, speckle or an edge under the stripe puts the case outside the bound's model
    """

    case: str
    method: str
    n_points: int
    found_fraction: float
    rms_px: float
    bias_px: float
    largest_px: float
    stated_over_scatter: float
    bound_px: float


def stripe_cases() -> dict[str, StripeScene]:
    """The cases of the table, by name; where nothing else is said: angle 20 deg, sigma 2 px, peak 200, noise 2."""
    base = StripeScene(angle_deg=20.0)
    cases = {f"angle {a:g} deg": replace(base, angle_deg=a) for a in (0.0, 10.0, 22.5, 30.0, 45.0, 60.0, 75.0, 90.0)}
    cases |= {f"sigma {s:g} px": replace(base, sigma_px=s) for s in (1.0, 1.5, 2.0, 3.0, 4.0)}
    cases |= {f"peak {p:g}": replace(base, peak=p) for p in (40.0, 80.0, 120.0, 220.0)}
    cases |= {f"clipped core, peak {p:g}": replace(base, peak=p) for p in (300.0, 500.0, 1000.0)}
    cases |= {f"step 6 px, {a:g} deg": replace(base, curve="step", angle_deg=a) for a in (0.0, 20.0, 45.0)}
    cases |= {f"curve 100 px, {a:g} deg": replace(base, curve="arc", angle_deg=a) for a in (0.0, 45.0)}
    cases |= {
        f"one-sided 36 from {e:+g} px": replace(base, one_sided=36.0, edge_px=e) for e in (-4.0, -2.0, 0.0, 2.0, 4.0)
    }
    cases |= {f"speckle 0.1, sigma {s:g} px": replace(base, speckle_contrast=0.1, sigma_px=s) for s in (1.0, 2.0)}
    cases |= {
        f"sigma {s:g} px, {a:g} deg": replace(base, sigma_px=s, angle_deg=a) for s in (0.6, 0.8) for a in (2.0, 20.0)
    }
    return cases


def centre_bound_px(scene: StripeScene) -> float:
    """Cramér-Rao bound of the centre from one pixel of stripe length, px.

    For a Gaussian of height A and standard deviation s in white noise n (rounding included), with height, width and
    background level free (they do not interfere): ``u = n / A * sqrt(2 s / sqrt(pi))``. The pixels' own width adds 1/12 to
    the variance of the profile and lowers its height.
    """
    if scene.speckle_contrast or scene.one_sided or scene.background + scene.peak > scene.ceiling:
        return float("nan")
    wide = np.sqrt(scene.sigma_px**2 + 1.0 / 12.0)
    height = scene.peak * scene.sigma_px / wide
    step = 1.0 if scene.bits == 8 else 1.0 / 257.0
    noise = np.sqrt(scene.noise**2 + step**2 / 12.0)
    return float(noise / height * np.sqrt(2.0 * wide / np.sqrt(np.pi)))


def verify_stripe(
    n_images: int = 8,
    methods: Sequence[str] | None = None,
    cases: Sequence[str] | None = None,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[StripeVerificationRow]:
    """Run methods over cases.

    Parameters
    ----------
    n_images : images a case; each has its own noise and its own place of the stripe between the pixels
    methods, cases : names to run; all of :data:`METHODS` and :func:`stripe_cases` if None
    seed : of the noise
    progress : called with the number of finished cases and of all

    Returns
    -------
    list of StripeVerificationRow   case by case; a method that finds nothing has NaN figures
    """
    scenes = {name: scene for name, scene in stripe_cases().items() if cases is None or name in cases}
    wanted = {name: options for name, options in METHODS.items() if methods is None or name in methods}
    rows = []
    for number, (case, scene) in enumerate(scenes.items()):
        rng = np.random.default_rng([seed, number])
        shifted = [replace(scene, offset_px=float(rng.uniform(-1.5, 1.5))) for _ in range(n_images)]
        images = [render_stripe(one, rng) for one in shifted]
        for method, options in wanted.items():
            errors, stated, found = [], [], []
            for one, image in zip(shifted, images, strict=True):
                points = extract_stripe(image, None, options)
                inner = ((points.uv >= _MARGIN_PX) & (points.uv <= np.array(one.image_size) - 1.0 - _MARGIN_PX)).all(
                    axis=1
                )
                errors.append(one.error(points.uv[inner]))
                stated.append(points.u_normal_px[inner])
                found.append(_found_fraction(one, points.uv[inner]))
            rows.append(
                _row(case, method, np.concatenate(errors), np.concatenate(stated), found, centre_bound_px(scene))
            )
        if progress is not None:
            progress(number + 1, len(scenes))
    return rows


def _row(
    case: str, method: str, error_px: np.ndarray, stated_px: np.ndarray, found: list[float], bound_px: float
) -> StripeVerificationRow:
    """Figures of one method on one case."""
    if len(error_px) < 2:
        nan = float("nan")
        return StripeVerificationRow(case, method, len(error_px), 0.0, nan, nan, nan, nan, bound_px)
    return StripeVerificationRow(
        case=case,
        method=method,
        n_points=len(error_px),
        found_fraction=float(np.mean(found)),
        rms_px=float(np.sqrt(np.mean(error_px**2))),
        bias_px=float(np.mean(error_px)),
        largest_px=float(np.max(np.abs(error_px))),
        stated_over_scatter=float(np.sqrt(np.mean(stated_px**2)) / np.std(error_px)),
        bound_px=bound_px,
    )


def _found_fraction(scene: StripeScene, uv: np.ndarray) -> float:
    """Part of the true curve, away from the border, that has a found centre within 1 px."""
    truth = scene.curve_points(0.5)
    top = np.array(scene.image_size) - 1.0 - _MARGIN_PX
    truth = truth[((truth >= _MARGIN_PX) & (truth <= top)).all(axis=1)]
    if len(uv) == 0:
        return 0.0
    distance = np.hypot(truth[:, None, 0] - uv[None, :, 0], truth[:, None, 1] - uv[None, :, 1]).min(axis=1)
    return float(np.mean(distance <= 1.0))
