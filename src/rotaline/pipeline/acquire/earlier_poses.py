"""The poses that an earlier start of an acquisition has taken, read from the frames in the session folder."""

import csv
from pathlib import Path

from rotaline.io.plan_file import session_toml
from rotaline.io.plan_tables import PlanCapture, PlanTables
from rotaline.io.session_access import FRAMES_FILE
from rotaline.io.session_file import SESSION_FILE, parse_session_file
from rotaline.pipeline.acquire.sighting import View, look, stripe_on, view_of
from rotaline.vision.images import read_image
from rotaline.vision.targets.model import Target


def target_of(plan: PlanTables, capture: PlanCapture) -> Target:
    """The target that a capture is of."""
    content, _ = parse_session_file(session_toml(plan, [capture]).encode(), SESSION_FILE)
    assert content is not None
    return content.targets[capture.target or ""]  # type: ignore[return-value]


def earlier_views(session: Path, capture: PlanCapture, target: Target) -> tuple[View, ...]:
    """The poses of a capture that an earlier start has taken: from the frames in the session folder, in their order."""
    folder = session / capture.folder
    if not (folder / FRAMES_FILE).exists():
        return ()
    with (folder / FRAMES_FILE).open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    views = []
    for row in rows:
        if row["laser"] != "off" or not (folder / row["image"]).exists():
            continue
        off = read_image(folder / row["image"])
        detection = look(off, target).detection
        view = None if detection is None else view_of(detection)
        if detection is None or view is None:
            continue
        lit = next((r for r in rows if r["pose"] == row["pose"] and r["laser"] == "on"), None)
        if capture.role == "laser-plane" and lit is not None and (folder / lit["image"]).exists():
            view = view.with_stripe(stripe_on(detection, read_image(folder / lit["image"]), off))
        views.append(view)
    return tuple(views)
