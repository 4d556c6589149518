"""What a person who holds a target is told: what is wrong with this pose, what the poses so far lack, when the next one is taken.

For the camera, poses have to fill the image and to be tilted to all sides; for the laser plane, the stripe has to run over the target
at distances that differ (two poses at one distance count as one), and to reach all heights of the image. What is asked for next depends on
the poses taken so far alone, so it does not change while somebody follows it.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from rotaline.hardware.camera import CameraFrame
from rotaline.hardware.rig import OpenRig
from rotaline.pipeline.acquire.sighting import (
    DARK,
    EDGES,
    SATURATED,
    Attitude,
    Edge,
    Sighting,
    View,
    attitude_of,
    crosses,
    focal_px,
    look,
    motion_px,
    stripe_on,
    view_of,
)
from rotaline.pipeline.acquire.taking import take_surely
from rotaline.vision.targets.detect import TargetOptions
from rotaline.vision.targets.model import Target

CELLS = (16, 12)
"""Columns and rows of the map of the image."""

LEAST_TILT_DEG, WANTED_TILT_DEG, MOST_TILT_DEG = 15.0, 25.0, 50.0
REST_S, REST_PX = 1.0, 0.4
"""At rest: points move by less than this from preview to preview, and in all, for so long."""
LONG_REST_S = 4.0
"""Who holds a pose for so long wants it to be taken, though it brings nothing that lacks."""

_ZONE_SHARE = 0.5
_NEW_CELLS = 0.03
_SAME_DISTANCE = 0.02
_DISTANCE_RANGE = 1.1

Level = Literal["bad", "move", "hold", "take"]
Zone = tuple[int, int]


@dataclass(frozen=True)
class Goal:
    """What the next pose should bring; ``zone``: column and row, 0 to 2, of the ninth of the picture that lacks most."""

    zone: Zone | None = None
    edge: Edge | None = None
    distance: str = ""

    @property
    def text(self) -> str:
        """In words."""
        parts = []
        if self.zone is not None:
            parts.append(f"{zone_name(self.zone)} of the picture")
        if self.edge is not None:
            parts.append(f"{self.edge} edge {WANTED_TILT_DEG:.0f} deg towards the camera")
        if self.distance:
            parts.append(self.distance)
        return ", ".join(parts) or "a pose that differs from the others"


@dataclass(frozen=True)
class Advice:
    """What to do now. ``level``: bad: no use as it is; move: good, but adds nothing; hold: it is wanted; take: it is at rest as well."""

    level: Level
    text: str


@dataclass(frozen=True, eq=False)
class Rest:
    """For how long a target has been where it is: the first sighting there, the last one, and how far it moved before that, px."""

    first: Sighting
    last: Sighting
    moved_px: float = 0.0

    @property
    def seconds(self) -> float:
        """By the clock of the camera."""
        return self.last.time_s - self.first.time_s

    @property
    def enough(self) -> bool:
        """It is at rest."""
        return self.last.detection is not None and self.seconds >= REST_S


def followed(rest: Rest | None, now: Sighting) -> Rest:
    """The rest after one more preview."""
    if rest is None:
        return Rest(now, now)
    moved = motion_px(rest.last, now)
    if moved > REST_PX or motion_px(rest.first, now) > REST_PX:
        return Rest(now, now, moved)
    return Rest(rest.first, now, moved)


@dataclass(frozen=True, eq=False)
class Guide:
    """The poses of a capture so far, and what they lack.

    Attributes
    ----------
    role : "camera" or "laser-plane"
    image_size : width, height, px
    n_poses : how many there shall be
    views : those that were taken
    """

    role: str
    image_size: tuple[int, int]
    n_poses: int
    views: tuple[View, ...] = ()

    def with_view(self, view: View) -> "Guide":
        """With one more pose."""
        return replace(self, views=(*self.views, view))

    @cached_property
    def focal_px(self) -> float:
        """As far as the poses tell."""
        return focal_px(self.views, self.image_size)

    @cached_property
    def attitudes(self) -> tuple[Attitude, ...]:
        """How the target was held in each pose."""
        return tuple(attitude_of(view, self.focal_px, self.image_size) for view in self.views)

    def attitude(self, view: View) -> Attitude:
        """How the target is held in another one."""
        focal = self.focal_px if len(self.views) >= 3 else focal_px((*self.views, view), self.image_size)
        return attitude_of(view, focal, self.image_size)

    @cached_property
    def covered(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells of the image in which something was measured: points of the target; for the laser plane, of the stripe on it."""
        covered = np.zeros(CELLS[::-1], dtype=bool)
        for view in self.views:
            covered |= self.cells(view)
        return covered

    def cells(self, view: View) -> Bool[np.ndarray, "rows columns"]:
        """The cells that one pose covers."""
        uv = view.uv if self.role == "camera" or view.stripe_uv is None else view.stripe_uv
        return _cells(uv, self.image_size)

    @property
    def share_covered(self) -> float:
        """Of the image."""
        return float(self.covered.mean())

    @property
    def tilts(self) -> dict[Edge, int]:
        """How many poses have which edge nearest to the camera, tilted by enough."""
        tilted = [a.nearest for a in self.attitudes if a.tilt_deg >= LEAST_TILT_DEG]
        return {edge: tilted.count(edge) for edge in EDGES}

    @property
    def tilts_wanted(self) -> int:
        """To each side."""
        return max(1, self.n_poses // 10)

    @cached_property
    def goal(self) -> Goal:
        """What the next pose should bring."""
        if self.role == "camera":
            return self._goal_of_camera()
        return self._goal_of_laser()

    @property
    def lacks(self) -> tuple[str, ...]:
        """What the poses so far lack, in words."""
        lacking = []
        if self.role == "camera":
            if zones := self._empty_zones():
                lacking.append("points in the " + ", ".join(zone_name(z) for z in zones))
            few = [e for e in EDGES if self.tilts[e] < self.tilts_wanted]
            if few:
                lacking.append(f"tilts with the {', '.join(few)} edge towards the camera")
        elif len(self.views) >= 2 and self._distance_range() < _DISTANCE_RANGE:
            lacking.append("poses clearly nearer and farther")
        return tuple(lacking)

    def like(self, view: View) -> int | None:
        """The number, from 1 on, of a pose that is much the same; None: there is none."""
        attitude = self.attitude(view)
        others = enumerate(zip(self.views, self.attitudes, strict=True), 1)
        return next((number for number, other in others if self._alike(view, attitude, *other)), None)

    def fills(self, view: View) -> bool:
        """Whether a pose brings some of what lacks; any does where nothing lacks."""
        if self.role != "camera" or not self.lacks:
            return True
        if float((self.cells(view) & ~self.covered).mean()) >= _NEW_CELLS:
            return True
        attitude = self.attitude(view)
        tilted = LEAST_TILT_DEG <= attitude.tilt_deg <= MOST_TILT_DEG
        return tilted and self.tilts[attitude.nearest] < self.tilts_wanted

    def advise(self, seen: Sighting, rest: Rest | None = None, stripe_misses: bool = False) -> Advice:
        """What to do now.

        Parameters
        ----------
        seen : this preview
        rest : how long the target has been there
        stripe_misses : the laser was on for a moment, and its stripe did not run over the target
        """
        wrong = self.wrong(seen, rest)
        if wrong:
            return Advice("bad", wrong)
        assert seen.detection is not None
        view = view_of(seen.detection)
        if view is None:
            return Advice("bad", "Its points lie on one line: turn it towards the camera.")
        if stripe_misses:
            return Advice(
                "bad",
                "The stripe does not run over it: move it into the light of the laser.",
            )
        still = rest is not None and rest.enough
        like = self.like(view)
        if like is not None:
            return Advice("move", f"Sharp and well lit, but like pose {like}: move it on.")
        long_still = rest is not None and rest.seconds >= LONG_REST_S
        if not self.fills(view) and not long_still:
            text = f"Good, but not what lacks. Held still for {LONG_REST_S:.0f} s, it is taken all the same."
            return Advice("move", text)
        return Advice("take", "It is taken.") if still else Advice("hold", "Good: hold it still, or set it down.")

    def wrong(self, seen: Sighting, rest: Rest | None = None) -> str:
        """Why this frame would be of no use, and what to do; nothing where it would be."""
        light = seen.light
        if seen.detection is None:
            if light.white < DARK:
                return f"Dark: {100 * light.white:.0f} % of full scale where it is brightest. Light the target better."
            if light.saturated > 0.2:
                return f"Too bright: {100 * light.saturated:.0f} % of the picture is at full scale. Take light away."
            return _short(seen.missing)
        if light.saturated > SATURATED:
            return f"Too bright: {100 * light.saturated:.0f} % of its white is at full scale. Light it less, avoid reflections."
        if light.white < DARK:
            return f"Dark: its white is at {100 * light.white:.0f} % of full scale. Light it better."
        blur = seen.blur
        if blur is None or blur.sharp:
            return ""
        what = f"Blurred by {blur.most_px:.1f} px (good to {blur.limit_px:.1f} px)."
        if blur.of_motion or (rest is not None and blur.limit_px < rest.moved_px < math.inf):
            return f"{what} It moves: hold it still, or set it down."
        return f"{what} Out of focus: hold it {self._towards_focus(seen)}."

    def _goal_of_camera(self) -> Goal:
        zones = self._empty_zones()
        counts = self.tilts
        fewest = min(EDGES, key=lambda e: counts[e])
        edge = fewest if counts[fewest] < self.tilts_wanted else None
        zone = min(zones, key=self._zone_order) if zones else None
        if zone is None and edge is None and len(self.views) >= 4 and self._distance_range() < _DISTANCE_RANGE:
            return Goal(distance="clearly nearer to the camera or farther away than the others, while it is sharp")
        return Goal(zone, edge) if self.views else Goal((1, 1), edge)

    def _goal_of_laser(self) -> Goal:
        n = len(self.views)
        if n < 3:
            where = (
                "about where parts will stand",
                "as near to the camera as parts will be",
                "as far away as parts will be",
            )
            return Goal(distance=f"in the light of the laser, {where[n]}")
        distances = sorted(a.distance_mm for a in self.attitudes)
        if distances[-1] / distances[0] < _DISTANCE_RANGE:
            return Goal(distance="in the light of the laser, clearly nearer to the camera or farther away than so far")
        last = self.attitudes[-1].distance_mm
        wanted = _middle_of_widest_gap(distances)
        share = 100 * (wanted / last - 1)
        words = f"about {abs(share):.0f} % {'farther away' if share > 0 else 'nearer to the camera'} than the last one"
        rows = self.covered.reshape(3, CELLS[1] // 3, -1).any(axis=(1, 2))
        zone = None
        if not rows.all():
            zone = (1, int(np.argmin(rows)))
        return Goal(zone, None, f"in the light of the laser, {words}")

    def _empty_zones(self) -> list[Zone]:
        shares = self._zone_shares()
        return [(c, r) for r in range(3) for c in range(3) if shares[r, c] < _ZONE_SHARE]

    def _zone_shares(self) -> Float[np.ndarray, "3 3"]:
        height, width = CELLS[1] // 3, CELLS[0] / 3
        edges = [round(i * width) for i in range(4)]
        rows = self.covered.reshape(3, height, -1).mean(axis=1)
        return np.stack([rows[:, a:b].mean(axis=1) for a, b in itertools.pairwise(edges)], axis=1)

    def _zone_order(self, zone: Zone) -> tuple[float, bool]:
        """The emptiest first; of equals, the corners."""
        c, r = zone
        return float(self._zone_shares()[r, c]), 1 in zone

    def _distance_range(self) -> float:
        distances = [a.distance_mm for a in self.attitudes if a.distance_mm > 0]
        return max(distances) / min(distances) if distances else 1.0

    def _alike(self, view: View, attitude: Attitude, other: View, its: Attitude) -> bool:
        turned = math.degrees(math.acos(np.clip(attitude.normal_camera @ its.normal_camera, -1.0, 1.0)))
        farther = (
            abs(math.log(attitude.distance_mm / its.distance_mm)) if attitude.distance_mm * its.distance_mm > 0 else 0.0
        )
        if turned > 8.0 or farther > (0.05 if self.role == "camera" else _SAME_DISTANCE):
            return False
        if self.role == "camera":
            return float(np.linalg.norm(view.centre_uv - other.centre_uv)) < 0.05 * self.image_size[0]
        return True

    def _towards_focus(self, seen: Sighting) -> str:
        view = None if seen.detection is None else view_of(seen.detection)
        if view is not None and len(self.views) >= 2:
            usual, here = float(np.median([a.distance_mm for a in self.attitudes])), self.attitude(view).distance_mm
            if abs(here / usual - 1) > 0.05:
                return "farther away" if here < usual else "nearer to the camera"
        return "nearer or farther"


def judged(seen: Sighting) -> str | None:
    """Why a frame that was taken of a pose is refused: the target is not found, or it moved; None: it is kept."""
    if seen.detection is None:
        return f"the target is not found in the frame. {_short(seen.missing)}"
    if seen.blur is not None and seen.blur.of_motion:
        return (
            f"the frame is blurred by motion ({seen.blur.most_px:.1f} px along, {seen.blur.least_px:.1f} px across). Hold the target still, or "
            "set it down."
        )
    return None


def moved_meanwhile(before: Sighting, after: Sighting) -> str | None:
    """Why the frames between two sightings are refused: the target is not where it was; None: it is."""
    if after.detection is None:
        return f"the target was not found any more after its frames had been taken. {_short(after.missing)}"
    moved = motion_px(before, after)
    if moved <= REST_PX:
        return None
    return (
        f"the target moved by {moved:.1f} px between the laser-off frame and the end of the laser-on frame; up to {REST_PX:g} px are good. Prop it up, "
        "and wait for the bell."
    )


def zone_name(zone: Zone) -> str:
    """A ninth of the picture, in words."""
    column, row = ("left", "middle", "right")[zone[0]], ("upper", "middle", "lower")[zone[1]]
    if row == "middle":
        return "middle" if column == "middle" else f"{column} middle"
    return f"{row} {column}"


def lit_preview(rig: OpenRig) -> Callable[[], CameraFrame] | None:
    """A frame of now with the laser on for as long as it takes, at the camera's present settings; None: there is no laser."""
    laser = rig.laser
    if laser is None:
        return None

    def take() -> CameraFrame:
        laser.on()
        try:
            return take_surely(rig.camera, lambda _: None)
        finally:
            laser.off()

    return take


def stripe_seen(seen: Sighting, off: CameraFrame, lit: CameraFrame) -> tuple[bool, Float[np.ndarray, "m 2"]]:
    """Whether the stripe runs over the target, and its points on it, px."""
    assert seen.detection is not None
    on = stripe_on(seen.detection, lit.image, off.image)
    return crosses(on, seen.detection), on


def full_look(frame: CameraFrame, target: Target) -> Sighting:
    """What a frame that was taken shows; as carefully as it will be looked at later."""
    return look(frame.image, target, frame.time_s, TargetOptions())


def _cells(uv: Float[np.ndarray, "n 2"], image_size: tuple[int, int]) -> Bool[np.ndarray, "rows columns"]:
    columns, rows = CELLS
    c, r = np.floor((uv + 0.5) / image_size * CELLS).astype(int).T
    cells = np.zeros((rows, columns), dtype=bool)
    inside = (c >= 0) & (c < columns) & (r >= 0) & (r < rows)
    cells[r[inside], c[inside]] = True
    return cells


def _middle_of_widest_gap(distances: Sequence[float]) -> float:
    logs = np.log(distances)
    i = int(np.argmax(np.diff(logs)))
    return float(np.exp((logs[i] + logs[i + 1]) / 2))


def _short(text: str) -> str:
    """What a detector says, without what the other lines of the screen say."""
    found, colon, _ = text.partition(": correct ")
    return f"{found}: show all of it." if colon else text.split(" Is it ")[0]
