"""Camera frames with what was found in them, for any stage."""

from rotaline.io.report.contents import FrameOverlay, ReportContents
from rotaline.io.report.figures import frames
from rotaline.io.report.page import Gallery, Picture, picture


def overlay_blocks(contents: ReportContents, stage: str, capture: str = "") -> tuple[Gallery, ...]:
    """The overlays of a stage (and of one capture) side by side; nothing if there are none."""
    chosen = [
        o
        for o in contents.overlays
        if o.stage == stage and (not capture or o.name == capture or o.name.startswith(f"{capture}/"))
    ]
    return (Gallery(tuple(overlay_picture(o) for o in chosen)),) if chosen else ()


def overlay_picture(frame: FrameOverlay) -> Picture:
    """A frame with what was found in it; a dark one is brightened, and its caption says so."""
    caption = frame.caption if frame.caption.startswith(frame.name) else f"{frame.name}: {frame.caption}"
    if frames.brightened(frame.image)[1]:
        caption += " (picture brightened)"
    return picture(lambda: frames.overlay(frame), caption, "third", "jpeg")
