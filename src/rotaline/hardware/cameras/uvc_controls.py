"""What OpenCV does not tell about a webcam: the limits of its controls, and which webcams there are (both from Linux)."""

import os
import struct
import sys
from dataclasses import dataclass
from pathlib import Path

EXPOSURE = 0x009A0902
"""V4L2_CID_EXPOSURE_ABSOLUTE, in 100 us."""
GAIN = 0x00980913
"""V4L2_CID_GAIN."""

_QUERYCTRL = "=II32siiiiIII"
_VIDIOC_QUERYCTRL = 3 << 30 | struct.calcsize(_QUERYCTRL) << 16 | ord("V") << 8 | 36
_DISABLED = 0x0001


@dataclass(frozen=True)
class Range:
    """Least, most and step of a control, in its own unit."""

    least: int
    most: int
    step: int


def control_range(path: str, control: int) -> Range | None:
    """The limits of a control of a V4L2 device; None: it has not this control, or cannot be asked."""
    if not sys.platform.startswith("linux"):
        return None
    import fcntl

    question = bytearray(struct.pack(_QUERYCTRL, control, 0, b"", 0, 0, 0, 0, 0, 0, 0))
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        fcntl.ioctl(device, _VIDIOC_QUERYCTRL, question)
    except OSError:
        return None
    finally:
        os.close(device)
    return parsed_range(bytes(question))


def parsed_range(answer: bytes) -> Range | None:
    """The limits in a ``struct v4l2_queryctrl``; None: the control is disabled."""
    _, _, _, least, most, step, _, flags, _, _ = struct.unpack(_QUERYCTRL, answer)
    if flags & _DISABLED or most <= least:
        return None
    return Range(least, most, max(step, 1))


def webcams(system: Path = Path("/sys/class/video4linux"), devices: Path = Path("/dev")) -> list[tuple[str, str]]:
    """Name and path of each webcam; the path stays the same when it is plugged in again, if Linux has such a one."""
    lasting = {link.resolve(): str(link) for link in sorted((devices / "v4l" / "by-id").glob("*"))}
    found = []
    for entry in sorted(system.glob("video*"), key=lambda entry: (len(entry.name), entry.name)):
        if _text(entry / "index") not in ("", "0"):
            continue  # a further node of the same webcam, without images
        path = devices / entry.name
        found.append((_text(entry / "name") or entry.name, lasting.get(path.resolve(), str(path))))
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
