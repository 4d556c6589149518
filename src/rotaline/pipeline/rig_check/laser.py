"""The laser on against off: whether its stripe appears, how it is, whether it ends, and when."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rotaline.errors import DetectionError
from rotaline.hardware.camera import CameraFrame, Image
from rotaline.hardware.laser import Laser
from rotaline.io.rig_check_file import Level
from rotaline.pipeline.acquire.exposure import expose_stripe
from rotaline.pipeline.compiling import compile_if_missing
from rotaline.pipeline.rig_check.bench import LONGEST_US, Bench
from rotaline.vision.images import to_grey
from rotaline.vision.stripe.extract import StripePoints, extract_stripe

SAFETY = (
    "The laser goes on now. Nobody looks into its beam or into a reflection of it, also not through a lens; shiny things are out of "
    "its way. Ctrl-C switches it off."
)

_THIN_PX, _WIDE_PX = 0.6, 6.0
"""Standard deviation of a stripe's profile."""
_SHORT = 0.15
"""Of the image's shorter side."""
_FULL, _DARK = 0.9, 0.1
"""Share of the stripe's brightness from which on it counts as lit, up to which as dark."""
_SERIES, _LONGEST_SERIES = 3, 15
_NOTHING = 1e-4
"""Share of the picture that noise may change."""


def check_laser(bench: Bench) -> None:
    """Switch the laser on and off, and see what changes; it is off afterwards.

    Raises
    ------
    DeviceError
        If laser or camera raise one; the caller switches the laser off.
    """
    laser, camera = bench.rig.laser, bench.rig.camera
    assert laser is not None
    before = bench.take()
    compile_if_missing(bench.heard, before.image)  # not while the laser is on
    bench.heard(SAFETY)
    laser.on()
    for _ in range(_LONGEST_SERIES):  # the light may be late
        lit = bench.take()
        if _changed(bench, before, lit) >= _NOTHING:
            break
    else:
        laser.off()
        _nothing_changes(bench, before)
        return
    low, high = camera.info.exposure_limits_us

    def take_at(exposure_us: float) -> CameraFrame:
        camera.configure(replace(camera.settings, exposure_us=exposure_us))
        return bench.take()

    try:
        found = expose_stripe(take_at, camera.settings.exposure_us, (low, min(high, LONGEST_US)))
    except DetectionError:
        laser.off()
        _no_stripe(bench, before, lit)
        return
    camera.configure(replace(camera.settings, exposure_us=found.exposure_us))
    on = bench.take()
    bench.recommended["exposure_on_us"] = round(found.exposure_us, 1)
    bench.pictures["on"] = on.image
    stripe = extract_stripe(on.image)
    bench.pictures["stripe_uv"] = stripe.uv
    full = float(np.iinfo(on.image.dtype).max)
    bench.line(
        "laser", "exposure", "doubtful" if found.note else "ok",
        f"{found.exposure_us * 1e-3:.3g} ms suit the stripe; its core is then at {100 * found.level:.0f} % of full scale, "
        f"{100 * found.saturated:.1f} % of it saturated",
        f"{found.note[:1].upper()}{found.note[1:]}.", exposure_us=found.exposure_us, level=found.level, saturated=found.saturated,
    )  # fmt: skip
    _stripe(bench, on.image, stripe)
    _switching(bench, laser, stripe, on.image, full)


def _changed(bench: Bench, before: CameraFrame, lit: CameraFrame) -> float:
    """Share of the picture that the laser changes."""
    change = np.abs(lit.image.astype(np.float32) - before.image.astype(np.float32))
    return float(np.mean(change > 12 * max(bench.noise, 0.5)))


def _nothing_changes(bench: Bench, before: CameraFrame) -> None:
    """Frames with the laser on and off are the same: it shines never, or always."""
    if len(extract_stripe(before.image)) < _SHORT * min(before.image.shape[:2]):
        bench.line(
            "laser",
            "stripe",
            "fails",
            "no stripe: frames with the laser on and off are the same",
            "See that the laser has power, that its line is in the picture, and that rig.toml names the right output.",
        )
    else:
        bench.pictures["on"] = before.image
        bench.line(
            "laser",
            "ends",
            "fails",
            "frames with the laser on and off are the same, and there is a line in both",
            "Take care: if it is the laser's, it shines all the time. Pull its plug; then see its wiring, and which output rig.toml names.",
        )


def _no_stripe(bench: Bench, before: CameraFrame, lit: CameraFrame) -> None:
    share = _changed(bench, before, lit)
    bench.line(
        "laser",
        "stripe",
        "fails",
        f"{100 * share:.2f} % of the picture changes with the laser, but no stripe is found in it",
        "Put a pale, matt thing into the line; darken the room; focus the laser's line.",
        changed=share,
    )


def _stripe(bench: Bench, image: Image, stripe: StripePoints) -> None:
    n, short = len(stripe), min(image.shape[:2])
    width = float(np.median(stripe.width_px))
    (u0, v0), (u1, v1) = stripe.uv.min(axis=0), stripe.uv.max(axis=0)
    level: Level = "ok"
    mend = []
    if n < _SHORT * short:
        level = "doubtful"
        mend.append("Only a little of the line is seen: put a pale, matt thing into it, or aim camera and laser anew.")
    if width < _THIN_PX:
        level = "doubtful"
        mend.append("The line is thinner than the pixels can sample: turn the laser's focus a little.")
    if width > _WIDE_PX:
        level = "doubtful"
        mend.append("The line is wide: focus the laser at the rotation axis.")
    bench.line(
        "laser", "stripe", level,
        f"{n} px of it, u {u0:.0f} to {u1:.0f}, v {v0:.0f} to {v1:.0f} px; {width:.2f} px wide (standard deviation of its profile; "
        f"{2.355 * width:.1f} px at half height); centres known to {float(np.median(stripe.u_normal_px)):.3f} px",
        " ".join(mend), points=n, width_px=width, u_from_px=float(u0), u_to_px=float(u1), v_from_px=float(v0), v_to_px=float(v1),
        u_centre_px=float(np.median(stripe.u_normal_px)),
    )  # fmt: skip


def _switching(bench: Bench, laser: Laser, stripe: StripePoints, on: Image, full: float) -> None:
    """Frames right after off, and right after on."""
    lit = height_of(on, stripe)
    off_s, off_frames = _after(bench, laser.off, lambda h: h <= _DARK * lit, stripe)
    rest = height_of(off_frames[-1].image, stripe)
    left = rest / lit
    if left > _DARK:
        still = left > 0.5
        bench.line(
            "laser", "ends", "fails" if still else "doubtful",
            f"{100 * left:.0f} % of the stripe is still there after it was switched off",
            "Take care: it shines. Pull its plug; then see its wiring, and which output rig.toml names."
            if still
            else "See whether it glows on, or whether something else draws a line there.",
            left=left,
        )  # fmt: skip
        return
    bench.line("laser", "ends", "ok", f"{100 * left:.1f} % of the stripe is left once it is off", left=left)
    on_s, on_frames = _after(bench, laser.on, lambda h: h >= _FULL * lit, stripe)
    again = height_of(on_frames[-1].image, stripe) / lit
    laser.off()
    if again < _FULL:
        bench.line(
            "laser", "comes back", "doubtful", f"switched on again, it reaches {100 * again:.0f} % of its brightness",
            "It needs time to warm up, or its supply is weak.", share=again,
        )  # fmt: skip
    period_s = _period_s(on_frames)
    for name, delay_s in (("switching on", on_s), ("switching off", off_s)):
        if math.isinf(delay_s):
            continue  # said above
        said = f"driver waits {laser.info.switching_s * 1e3:.3g} ms"
        if delay_s <= 0.0:
            bench.line("laser", name, "ok", f"the first frame shows it whole ({said})", delay_s=0.0)
            continue
        bench.recommended["switching_s"] = round(
            max(bench.recommended.get("switching_s", 0.0), laser.info.switching_s + 1.2 * delay_s + period_s), 3
        )
        bench.line(
            "laser", name, "fails", f"only {delay_s * 1e3:.0f} ms after the command is a frame whole, known to {period_s * 1e3:.0f} ms ({said})",
            f"Set its switching time in rig.toml to {bench.recommended['switching_s']:.3g} s.", delay_s=delay_s,
        )  # fmt: skip


def _after(
    bench: Bench, switch: Callable[[], None], done: Callable[[float], bool], stripe: StripePoints
) -> tuple[float, list[CameraFrame]]:
    """Frames from a switching on, until some in a row are as they should be.

    Returns
    -------
    delay_s : from the end of the command until the first exposure that is as it should be began; 0: the very first one
    frames : all of them
    """
    switch()
    done_s = bench.rig.clock.now_s()
    frames: list[CameraFrame] = []
    good: list[bool] = []
    while len(frames) < _LONGEST_SERIES and not (len(good) >= _SERIES and all(good[-_SERIES:])):
        frames.append(bench.take())
        good.append(done(height_of(frames[-1].image, stripe)))
    if not good[-1]:
        return math.inf, frames
    first = len(good) - good[::-1].index(False) if False in good else 0
    if first == 0:
        return 0.0, frames
    began = frames[first].time_s - frames[first].settings.exposure_us * 0.5e-6
    return max(began - done_s, 0.0), frames


def _period_s(frames: list[CameraFrame]) -> float:
    return float(np.median(np.diff([f.time_s for f in frames])))


def height_of(image: Image, stripe: StripePoints) -> float:
    """How much brighter than its sides an image is along a stripe, in grey values (median)."""
    grey = to_grey(image).astype(np.float32)
    side = 4.0 * np.maximum(stripe.width_px, 1.0)[:, None] * stripe.normal
    core = _sampled(grey, stripe.uv)
    sides = (_sampled(grey, stripe.uv + side) + _sampled(grey, stripe.uv - side)) / 2
    return float(np.median(core - sides))


def _sampled(grey: Float[np.ndarray, "h w"], uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Mean of 3 x 3 pixels around each place."""
    height, width = grey.shape
    u = np.clip(np.rint(uv[:, 0]).astype(int), 1, width - 2)
    v = np.clip(np.rint(uv[:, 1]).astype(int), 1, height - 2)
    return np.mean([grey[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=0)
