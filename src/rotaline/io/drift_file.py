"""``drift.json``: how the stripe moved between the reference frames of an acquisition, capture by capture.

Shifts are along the normal of the stripe, against the first reference frame of the capture, in px of the image and, with a calibration, in mm
at the part: by so much a measured point moves. Uncertainties are standard ones (k = 1). Numbers that are not known are null.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rotaline.io.files import write_json
from rotaline.vision.stripe.shift import StripeShift

DRIFT_FILE = "drift.json"
FORMAT = "rotaline drift"
VERSION = 1


@dataclass(frozen=True)
class ReferenceShift:
    """A reference frame against the first one of its capture; ``reason`` says why it was not compared (empty if it was).

    ``minutes`` have passed since the first one; NaN where the session does not say when frames were taken.
    """

    name: str
    minutes: float
    shift: StripeShift
    reason: str = ""


@dataclass(frozen=True)
class CaptureDrift:
    """The drift of a capture.

    Attributes
    ----------
    folder : of the capture
    frames : in the order in which they were taken; the first that shows the stripe is what the others are compared with
    mm_per_px : how far a point on the part moves for a shift of one px (median over the stripe); NaN without a calibration
    limit_mm : standard uncertainty of a point of the stripe that all points share, from the calibration; that of its noise where the
        calibration states none; NaN without a calibration
    limit_px : standard uncertainty of the centre of the stripe at a point (median)
    warnings : what is to be told
    """

    folder: str
    frames: tuple[ReferenceShift, ...]
    mm_per_px: float
    limit_mm: float
    limit_px: float
    warnings: tuple[str, ...] = ()

    @property
    def compared(self) -> tuple[ReferenceShift, ...]:
        """The frames that could be compared, the first one among them."""
        return tuple(f for f in self.frames if not f.reason)

    @property
    def largest(self) -> ReferenceShift | None:
        """The frame with the largest shift; None where nothing could be compared."""
        return max(self.compared[1:], key=lambda f: abs(f.shift.shift_px), default=None)


def write_drift(path: Path, drifts: Sequence[CaptureDrift]) -> None:
    """Write ``drift.json``.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    captures = [_capture(drift) for drift in drifts]
    write_json(path, {"format": FORMAT, "version": VERSION, "captures": captures})


def _capture(drift: CaptureDrift) -> dict[str, Any]:
    return {
        "capture": drift.folder,
        "mm_per_px": drift.mm_per_px,
        "limit_mm": drift.limit_mm,
        "limit_px": drift.limit_px,
        "warnings": list(drift.warnings),
        "frames": [_frame(frame, drift.mm_per_px) for frame in drift.frames],
    }


def _frame(frame: ReferenceShift, mm_per_px: float) -> dict[str, Any]:
    s = frame.shift
    return {
        "name": frame.name,
        "minutes": frame.minutes,
        "shift_px": s.shift_px,
        "u_shift_px": s.u_px,
        "shift_mm": s.shift_px * mm_per_px,
        "u_shift_mm": s.u_px * mm_per_px,
        "n_points": s.n_points,
        "brightness_change": s.brightness - 1.0,
        "u_brightness_change": s.u_brightness,
        "width_change": s.width - 1.0,
        "reason": frame.reason,
    }
