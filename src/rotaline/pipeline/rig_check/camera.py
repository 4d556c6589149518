"""What a camera shows: size, time, noise, grey values, focus, and whether a stream is whole."""

from dataclasses import replace

import numpy as np

from rotaline.errors import LostFrameError
from rotaline.hardware.camera import CameraFrame
from rotaline.io.rig_check_file import Level
from rotaline.pipeline.acquire.exposure import expose_scene
from rotaline.pipeline.rig_check.bench import LONGEST_US, Bench
from rotaline.vision.images import to_grey
from rotaline.vision.sharpness import edge_blur_px

_SERIES = 5
_SLOW_S = 0.5
_NOISY = 0.03
"""Of full scale."""
_UNSTEADY = 0.01
_SATURATED = 0.01
_TOO_BRIGHT = 0.95
_TOO_SHARP_PX, _SOFT_PX, _BLURRED_PX = 0.25, 1.5, 3.0
_LATE = 0.05
"""Of the change of brightness, that the first frame after a change of exposure still lacks."""
_STREAM_FRAMES = 12
_PATIENCE_S = 5.0


def check_camera(bench: Bench) -> None:
    """Take frames of the scene with the laser off; afterwards the exposure suits it.

    Raises
    ------
    DeviceError
        If the camera does not work.
    """
    camera, clock = bench.rig.camera, bench.rig.clock
    info = camera.info
    first = bench.take()
    height, width = first.image.shape[:2]
    colour = "colour" if info.colour else "grey"
    bench.line(
        "camera", "frame", "ok", f"{width} x {height} px, {info.bit_depth} bit, {colour}",
        width_px=width, height_px=height, bit_depth=info.bit_depth,
    )  # fmt: skip
    _exposure(bench, first)
    frames, took = [], []
    for _ in range(_SERIES):
        asked_s = clock.now_s()
        frames.append(bench.take())
        took.append(clock.now_s() - asked_s)
    exposure_s = camera.settings.exposure_us * 1e-6
    began = [f.time_s - exposure_s / 2 for f in frames]
    bench.pictures["off"] = frames[-1].image
    _time(bench, float(np.median(took)), exposure_s, began)
    _noise(bench, frames)
    _grey_values(bench, frames[-1])
    _focus(bench, frames[-1])
    _change(bench, frames)


def _exposure(bench: Bench, first: CameraFrame) -> None:
    """Find the exposure that suits the scene, and keep it."""
    camera = bench.rig.camera
    low, high = camera.info.exposure_limits_us

    def take_at(exposure_us: float) -> CameraFrame:
        camera.configure(replace(camera.settings, exposure_us=exposure_us))
        return bench.take()

    found = expose_scene(take_at, first.settings.exposure_us, (low, min(high, LONGEST_US)))
    bench.exposure_us = camera.configure(replace(camera.settings, exposure_us=found.exposure_us)).exposure_us
    bench.recommended["exposure_off_us"] = round(found.exposure_us, 1)
    note = (
        found.note
        or "no exposure makes the bright parts less bright than that: see whether the exposure is obeyed, below"
    )
    bench.line(
        "camera", "exposure", "doubtful" if found.note or found.level > _TOO_BRIGHT else "ok",
        f"{found.exposure_us * 1e-3:.3g} ms suit the scene without laser; its bright parts are then at {100 * found.level:.0f} % of full scale",
        f"{note[:1].upper()}{note[1:]}.", exposure_us=found.exposure_us, level=found.level,
    )  # fmt: skip


def _time(bench: Bench, took_s: float, exposure_s: float, began_s: list[float]) -> None:
    more_s = took_s - exposure_s
    level: Level = "ok" if more_s <= _SLOW_S else "doubtful"
    bench.line(
        "camera", "time", level, f"a frame takes {took_s * 1e3:.1f} ms: {exposure_s * 1e3:.1f} ms of exposure and {more_s * 1e3:.1f} ms more",
        "Choose a faster port or format, or a smaller region; every frame of a scan waits for it.", frame_s=took_s, overhead_s=more_s,
        between_frames_s=float(np.median(np.diff(began_s))),
    )  # fmt: skip


def _noise(bench: Bench, frames: list[CameraFrame]) -> None:
    """Noise from the difference of two frames, and the light's steadiness from the mean of all."""
    images = [f.image.astype(np.float32) for f in frames]
    full = float(np.iinfo(frames[0].image.dtype).max)
    difference = images[-1] - images[-2]
    bench.noise = float(np.std(difference)) / np.sqrt(2.0)
    share = bench.noise / full
    text = f"{100 * share:.2f} % of full scale ({bench.noise:.2f} grey values) from frame to frame"
    if not difference.any():
        bench.line(
            "camera", "noise", "fails", "two frames are the same, pixel for pixel",
            "The camera hands out an old frame, or smooths it: switch its noise reduction off; with an emulator this is so.", noise=0.0,
        )  # fmt: skip
    else:
        level: Level = "ok" if share <= _NOISY else "doubtful"
        bench.line(
            "camera", "noise", level, text, "Less gain and more light; open the lens.", noise=bench.noise, share=share
        )
    means = np.array([float(image.mean()) for image in images])
    spread = float(np.std(means) / max(means.mean(), 1e-9))
    level = "ok" if spread <= _UNSTEADY else "doubtful"
    bench.line(
        "camera", "steadiness", level, f"brightness changes by {100 * spread:.2f} % (standard deviation of {len(frames)} frames)",
        "Switch automatic exposure and gain off. Lamps flicker: exposures of whole multiples of 10 ms (mains of 50 Hz) or 8.33 ms (60 Hz).",
        spread=spread,
    )  # fmt: skip


def _grey_values(bench: Bench, frame: CameraFrame) -> None:
    grey = to_grey(frame.image) / float(np.iinfo(frame.image.dtype).max)
    dark, bright = (float(q) for q in np.quantile(grey, [0.001, 0.99]))
    saturated = float(np.mean(grey >= 0.995))
    level: Level = "ok" if saturated <= _SATURATED else "doubtful"
    bench.line(
        "camera", "grey values", level,
        f"dark {100 * dark:.1f} %, bright {100 * bright:.0f} % of full scale, {100 * saturated:.2f} % of the pixels saturated",
        "Remove reflections of lamps, or light the scene from the side.", dark=dark, bright=bright, saturated=saturated,
    )  # fmt: skip


def _focus(bench: Bench, frame: CameraFrame) -> None:
    blur = edge_blur_px(frame.image, bench.noise)
    bench.pictures["blur_px"] = blur
    seen = blur[np.isfinite(blur)]
    if len(seen) < 3:
        bench.line(
            "camera", "focus", "doubtful", "there are too few edges in view to tell", "Place a target plate on the table, in good light."
        )  # fmt: skip
        return
    sharp, soft = (float(q) for q in np.quantile(seen, [0.2, 0.9]))
    level: Level = "ok" if sharp <= _SOFT_PX else "doubtful" if sharp <= _BLURRED_PX else "fails"
    mend = "Focus at the rotation axis, close the aperture by a stop or two, clean the lens; then fix the focus."
    if sharp < _TOO_SHARP_PX:
        level, mend = "doubtful", "No lens is so sharp: switch the camera's sharpening off; it moves edges."
    bench.line(
        "camera", "focus", level,
        f"edges are blurred by {sharp:.2f} px (standard deviation) where it is sharp, {soft:.2f} px where it is not, in {len(seen)} places",
        mend, blur_px=sharp, blur_worst_px=soft,
    )  # fmt: skip


def _change(bench: Bench, before: list[CameraFrame]) -> None:
    """Half the exposure: whether the very first frame has it, and is half as bright above the dark."""
    camera = bench.rig.camera
    exposure_us = camera.settings.exposure_us
    if exposure_us / 2 < camera.info.exposure_limits_us[0]:
        return
    made = camera.configure(replace(camera.settings, exposure_us=exposure_us / 2))
    halved = [_bright(bench.take()) for _ in range(3)]
    camera.configure(replace(camera.settings, exposure_us=exposure_us))
    back = _bright(bench.take())
    whole, half = float(np.median([_bright(f) for f in before])), halved[-1]
    drop = whole - half
    if drop <= 0.1 * whole:
        bench.line(
            "camera",
            "change of exposure",
            "fails",
            f"from {exposure_us * 1e-3:.3g} to {made.exposure_us * 1e-3:.3g} ms the picture stays as bright as it was",
            "Switch automatic exposure off, in the camera or with its maker's program.",
        )
        return
    late = max((halved[0] - half) / drop, (whole - back) / drop)
    bench.line(
        "camera",
        "change of exposure",
        "ok" if late <= _LATE else "fails",
        f"from {exposure_us * 1e-3:.3g} to {made.exposure_us * 1e-3:.3g} ms and back: the first frame after the change has "
        f"{100 * (1 - max(late, 0.0)):.0f} % of it",
        "Frames come with the exposure from before: let more frames pass (settle_frames, latency_s of a webcam), or take another format.",
        late=late,
    )


def _bright(frame: CameraFrame) -> float:
    """Mean brightness."""
    return float(frame.image.mean())


def check_stream(bench: Bench) -> None:
    """Let the camera stream for some frames: their period, and whether one is missing.

    Raises
    ------
    DeviceError
        If it does not stream.
    """
    camera = bench.rig.camera
    frames: list[CameraFrame] = []
    damaged = 0
    camera.start()
    try:
        while len(frames) + damaged < _STREAM_FRAMES:
            try:
                frames.append(camera.next_frame(camera.settings.exposure_us * 1e-6 + _PATIENCE_S))
            except LostFrameError:
                damaged += 1
    finally:
        camera.stop()
    if len(frames) < 2:
        bench.line(
            "camera",
            "stream",
            "fails",
            f"{damaged} of {_STREAM_FRAMES} frames were lost",
            "See the cable and the port.",
        )
        return
    numbers = [f.number for f in frames]
    missing = numbers[-1] - numbers[0] + 1 - len(frames)
    period_s = (frames[-1].time_s - frames[0].time_s) / (numbers[-1] - numbers[0])
    bench.line(
        "camera", "stream", "doubtful" if missing else "ok",
        f"a frame each {period_s * 1e3:.1f} ms; {missing} of {len(frames) + missing} missing; time stamps are known to {frames[-1].u_time_s * 1e3:.2g} ms",
        "Lost frames are taken again, which costs time: see the cable, the port, the network card (jumbo frames), or lower the frame rate.",
        period_s=period_s, missing=missing, u_time_s=frames[-1].u_time_s,
    )  # fmt: skip


def check_lost(bench: Bench) -> None:
    """Whether single frames were lost in all the other checks."""
    if bench.lost:
        bench.line(
            "camera", "lost frames", "doubtful",
            f"{len(bench.lost)} of {bench.n_frames + len(bench.lost)} frames were lost or late, and taken again: {bench.lost[0]}",
            "See the cable, the port and its speed; for GigE the network card (jumbo frames, receive buffers).",
            lost=len(bench.lost), frames=bench.n_frames,
        )  # fmt: skip
    else:
        bench.line("camera", "lost frames", "ok", f"none of {bench.n_frames}", lost=0, frames=bench.n_frames)
