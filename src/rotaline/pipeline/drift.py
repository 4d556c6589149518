"""The stage ``drift``: whether the rig stood still while it was recorded, by the reference frames of an acquisition.

A reference frame shows the same part at the same angle as the first one of its capture. Where its stripe lies elsewhere, camera, laser or table
have moved, mostly because they were still getting warm.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotaline.calibration.model import SystemCalibration
from rotaline.io.drift_file import DRIFT_FILE, CaptureDrift, ReferenceShift, write_drift
from rotaline.io.session import Capture, Frame, Session
from rotaline.pipeline.frames import CaptureStripes, join_stripes
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.ranges import RangeTask, backgrounds_of, process_range, program, spans
from rotaline.pipeline.store import StageStore, key_of, sources_key
from rotaline.scanning.triangulation import scan_points
from rotaline.vision.stripe.extract import StripeOptions
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.shift import StripeShift, stripe_shift

_CERTAIN = 3.0
"""A shift of so many standard uncertainties is one."""
_SEEN = 0.5
"""So much of the stripe has to be there again."""
_NOT_COMPARED = StripeShift(math.nan, math.nan, math.nan, 0, 0.0, math.nan, math.nan, math.nan)


def find_drift(
    session: Session, system: SystemCalibration | None, options: StripeOptions, store: StageStore, observer: Observer
) -> tuple[CaptureDrift, ...]:
    """The drift of each capture that has reference frames.

    Parameters
    ----------
    session : Session
    system : with which shifts become mm at the part; None: there is none
    options, store, observer : how stripes are found, where they are kept, who hears of it

    Raises
    ------
    SessionError
        If an image cannot be read.
    """
    captures = {c.folder: c for c in session.captures}
    by_folder: dict[str, list[Frame]] = {}
    for frame in session.references:
        by_folder.setdefault(frame.pose or "", []).append(frame)
    return tuple(
        _capture_drift(folder, captures.get(folder), frames, system, options, store, observer)
        for folder, frames in by_folder.items()
    )


def keep_drift(folder: Path, drifts: Sequence[CaptureDrift]) -> None:
    """Write ``drift.json`` into the results; one of an earlier run must not stay where there is none."""
    path = folder / DRIFT_FILE
    if drifts:
        write_drift(path, drifts)
    else:
        path.unlink(missing_ok=True)


def _capture_drift(
    folder: str,
    capture: Capture | None,
    frames: Sequence[Frame],
    system: SystemCalibration | None,
    options: StripeOptions,
    store: StageStore,
    observer: Observer,
) -> CaptureDrift:
    lit = tuple(f for f in frames if f.laser_on)
    if not lit:  # a target that turns: its frames show no stripe
        shifts = tuple(ReferenceShift(f.name, math.nan, _NOT_COMPARED, "laser off") for f in frames)
        return CaptureDrift(folder, shifts, math.nan, math.nan, math.nan)
    off = capture.off_frames if capture is not None else ()
    listed = [(f.name, f.angle_rad) for f in lit]
    key = key_of(sources_key(f.source for f in (*off, *lit)), listed, options)
    found: CaptureStripes = store.get(
        f"drift-{folder}", f"Drift in {folder}", key, lambda: _stripes(folder, off, lit, options, store)
    )
    stripes = dict(zip(found.frame_names, found.stripes(), strict=True))
    first = next((f for f in lit if len(stripes[f.name])), None)
    if first is None:
        text = (
            f"{folder}: no stripe in any of its {len(frames)} reference frames: whether the rig drifted is not known."
        )
        shifts = tuple(ReferenceShift(f.name, math.nan, _NOT_COMPARED, "no stripe") for f in frames)
        return CaptureDrift(folder, shifts, math.nan, math.nan, math.nan, (text,))
    shifts = tuple(_shift(f, first, stripes) for f in frames)
    drift = CaptureDrift(folder, shifts, *_scale(stripes[first.name], first, system))
    return replace(drift, warnings=_warnings(drift))


def _stripes(
    folder: str, off: Sequence[Frame], lit: Sequence[Frame], options: StripeOptions, store: StageStore
) -> CaptureStripes:
    """The stripes of the reference frames, found as those of the capture are."""
    backgrounds = backgrounds_of((*off, *lit))
    tasks = (
        RangeTask(f"reference frames of {folder}", a, tuple(lit[a:b]), backgrounds[a:b], options, None, None, program())
        for a, b in spans(len(lit))
    )
    return join_stripes([result.stripes for result in store.workers.run(process_range, tasks)])


def _shift(frame: Frame, first: Frame, stripes: dict[str, StripePoints]) -> ReferenceShift:
    known = frame.time_s is not None and first.time_s is not None
    minutes = (frame.time_s - first.time_s) / 60.0 if known else math.nan  # type: ignore[operator]
    if not frame.laser_on:
        return ReferenceShift(frame.name, minutes, _NOT_COMPARED, "laser off")
    if not len(stripes[frame.name]):
        return ReferenceShift(frame.name, minutes, _NOT_COMPARED, "no stripe")
    shift = stripe_shift(stripes[first.name], stripes[frame.name])
    if not math.isfinite(shift.shift_px) or shift.share < _SEEN:
        return ReferenceShift(frame.name, minutes, _NOT_COMPARED, f"only {100 * shift.share:.0f} % of the stripe")
    return ReferenceShift(frame.name, minutes, shift)


def _scale(stripe: StripePoints, frame: Frame, system: SystemCalibration | None) -> tuple[float, float, float]:
    """How far points move for a px, mm; and the uncertainties that a drift is judged by, mm and px."""
    limit_px = float(np.nanmedian(stripe.u_normal_px))
    if system is None:
        return math.nan, math.nan, limit_px
    angle = np.array([frame.angle_rad or 0.0])
    one_px = replace(stripe, u_normal_px=np.ones(len(stripe)))
    mm_per_px = _median(scan_points([one_px], angle, system).u_mm)
    cloud = scan_points([stripe], angle, system)
    common = _median(cloud.u_calibration_mm)
    return mm_per_px, common if math.isfinite(common) else _median(cloud.u_mm), limit_px


def _median(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else math.nan


def _warnings(drift: CaptureDrift) -> tuple[str, ...]:
    """What is to be told of a drift that matters: it is certain, and larger than what points are uncertain by anyway."""
    texts = []
    lost = [f for f in drift.frames if f.reason and f.reason != "laser off"]
    if lost:
        texts.append(
            f"{drift.folder}: {len(lost)} of {len(drift.frames)} reference frames cannot be compared with the first one, e.g. "
            f"{lost[0].name}: {lost[0].reason}. Did the part move, or something stand before it?"
        )
    largest = drift.largest
    if largest is None:
        return tuple(texts)
    shift, u = abs(largest.shift.shift_px), largest.shift.u_px
    in_mm = math.isfinite(drift.mm_per_px) and math.isfinite(drift.limit_mm)
    limit_px = drift.limit_mm / drift.mm_per_px if in_mm else drift.limit_px
    if shift <= max(limit_px, _CERTAIN * u):
        return tuple(texts)
    size = f"{shift:.3f} px"
    against = f"a point of the stripe is uncertain by {limit_px:.3f} px"
    if in_mm:
        size += f", {1e3 * shift * drift.mm_per_px:.1f} um at the part (u = {1e3 * u * drift.mm_per_px:.1f} um)"
        against = f"points are uncertain by {1e3 * drift.limit_mm:.1f} um"
    when = f" within {abs(largest.minutes):.0f} min" if math.isfinite(largest.minutes) else ""
    texts.append(
        f"{drift.folder}: the stripe has moved by {size}{when}, up to {largest.name}; {against}. The rig was still getting warm, or "
        "something moved. Let camera, laser and table warm up longer (warm_up_s in the plan), take reference frames more often "
        "(reference_every) to see when they stand still, and take this capture again; if it moved at once, tighten what holds camera, laser and part."
    )
    return tuple(texts)
