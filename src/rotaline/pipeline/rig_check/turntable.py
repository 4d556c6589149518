"""A small move and back: whether what stands on the table moves, how well it returns, and how long until it stands.

The displacement of points of the scene by the move itself, ``d_k``, is the scale: of a later frame with displacements ``e_k`` from the scene at
rest, the table is off by the share ``sum(d_k . e_k) / sum(d_k . d_k)`` of the move. So neither calibration nor target is needed, only
something with a pattern on the table.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.errors import DeviceLimitError
from rotaline.hardware.camera import Image
from rotaline.hardware.turntable import Turntable
from rotaline.io.rig_check_file import Level
from rotaline.pipeline.rig_check.bench import Bench
from rotaline.vision.motion import follow, points_to_follow

MOVE_DEG = 1.0
N_RETURNS = 6
_N_OTHER_SIDE = 3
_MOVE_S, _HOME_S = 60.0, 300.0
_LEAST_POINTS = 10
_MOVES_PX = 0.3
_STANDS_PX = 0.05
"""Movements below are none."""
_WATCH_S = 3.0
_AT_REST_S, _AT_REST_FRAMES = 0.3, 6
_FIRST_FRAMES, _APART_S = 4, 0.03
"""So many frames follow one another as fast as they can; further ones are so far apart."""
_LONG_SETTLING_S = 1.0
_TURN_DEG_S, _TURN_S, _REPORTS = 5.0, 1.0, 10
_SPEED_OFF = 0.02


@dataclass(frozen=True, eq=False)
class Scene:
    """What is followed.

    Attributes
    ----------
    image : at rest, before the move
    uv : (n, 2)   places in it of points that turn with the table, px
    moved : (n, 2)   how far the move took them, px
    """

    image: Image
    uv: Float[np.ndarray, "n 2"]
    moved: Float[np.ndarray, "n 2"]

    @property
    def scale_px(self) -> float:
        """Root mean square of the displacements of the whole move, px."""
        return float(np.sqrt(np.mean(np.sum(self.moved**2, axis=1))))

    def share(self, image: Image) -> float:
        """How far the scene is on its way, as a share of the move; NaN: most of the points are lost."""
        return _share(follow(self.image, image, self.uv), self.moved)[0]

    def u_share(self, image: Image) -> float:
        """Standard uncertainty of :meth:`share`, from the scatter of the points."""
        return _share(follow(self.image, image, self.uv), self.moved)[1]


def _share(moved: Float[np.ndarray, "n 2"], whole: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    seen = _seen(moved)
    if seen.sum() < 0.5 * len(whole):
        return math.nan, math.nan
    each = np.sum(moved[seen] * whole[seen], axis=1) / np.sum(whole[seen] ** 2, axis=1)
    sound = np.abs(each - np.median(each)) <= 4.0 * (1.4826 * np.median(np.abs(each - np.median(each))) + 1e-6)
    d, e = whole[seen][sound], moved[seen][sound]
    share = float(np.sum(d * e) / np.sum(d * d))
    return share, float(np.sqrt(np.sum((e - share * d) ** 2) / (2 * len(d) - 1) / np.sum(d * d)))


def _seen(moved: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    return np.isfinite(moved).all(axis=1)


def check_turntable(bench: Bench) -> None:
    """Home, a small move and back several times, and how long each takes.

    Raises
    ------
    DeviceError
        If the table or the camera raise one; the caller stops the table.
    """
    table, clock = bench.rig.turntable, bench.rig.clock
    assert table is not None
    asked_s = clock.now_s()
    table.home(_HOME_S)
    kind = "found its reference" if table.info.has_reference else "calls its present place 0: it has no reference"
    bench.line("turntable", "home", "ok", f"{kind}, in {clock.now_s() - asked_s:.1f} s", home_s=clock.now_s() - asked_s)
    start_deg, step_deg, below = _room(table)
    _move(bench, start_deg)
    before = _at_rest(bench)
    asked_s = clock.now_s()
    there_deg = table.move_to(start_deg + step_deg, _MOVE_S)
    took_s = clock.now_s() - asked_s
    _angle(bench, table, start_deg + step_deg, there_deg, took_s)
    series = _watched(bench)
    scene = _scene(before, series[-1][1])
    if scene is None:
        bench.line(
            "turntable", "movement", "fails", f"nothing in the picture moves, though the table reports {there_deg:g} deg",
            "Place a target plate, or something with a pattern, on the table and in the light. If it stands there: see the coupling, the axis and "
            "the steps a degree in rig.toml.",
        )  # fmt: skip
        return
    bench.line(
        "turntable", "movement", "ok", f"{len(scene.uv)} points move by {scene.scale_px:.2f} px (root mean square) for {step_deg:g} deg",
        px=scene.scale_px, deg=step_deg, points=len(scene.uv),
    )  # fmt: skip
    settle_s = _settling(bench, scene, series)
    _returns(bench, table, scene, (start_deg, step_deg, below), settle_s)


def _room(table: Turntable) -> tuple[float, float, bool]:
    """Where the move begins, how far it goes, deg, and whether there is room to come from below as well.

    Raises
    ------
    DeviceLimitError
        If the limits leave no room for a move.
    """
    info = table.info
    step = max(MOVE_DEG, math.ceil(MOVE_DEG / info.resolution_deg - 1e-6) * info.resolution_deg)
    here, limits = (
        table.angle_deg() + step,
        info.limits_deg,
    )  # the first place is one that it has moved to, as are all others
    if limits is None:
        return here, step, True
    low, high = limits
    if high - low < step:
        raise DeviceLimitError(
            f"{info.device}: its limits, {low:g} to {high:g} deg, leave no room for a move of {step:g} deg. See limits_deg in rig.toml."
        )
    start = min(max(here, low), high - step)
    if high - low >= 2 * step:
        start = max(start, low + step)
    return start, step, start - low >= step


def _move(bench: Bench, angle_deg: float) -> float:
    table = bench.rig.turntable
    assert table is not None
    return table.move_to(angle_deg, _MOVE_S)


def _angle(bench: Bench, table: Turntable, asked_deg: float, there_deg: float, took_s: float) -> None:
    off = there_deg - asked_deg
    allowed = 0.5 * table.info.resolution_deg + 4 * table.info.u_angle_deg + 1e-9
    level: Level = "ok" if abs(off) <= allowed else "doubtful"
    bench.line(
        "turntable", "angle", level,
        f"asked for {asked_deg:g} deg it reports {there_deg:.6g} deg, after {took_s:.2f} s (resolution {table.info.resolution_deg:.3g} deg)",
        "See units or steps a degree, and resolution_deg, in rig.toml.", off_deg=off, move_s=took_s,
    )  # fmt: skip


def _watched(bench: Bench) -> list[tuple[float, Image]]:
    """Frames from now on, with the time of each exposure's beginning after now, s, until the scene seems to stand."""
    clock = bench.rig.clock
    done_s = clock.now_s()
    series: list[tuple[float, Image]] = []
    points: Float[np.ndarray, "n 2"] | None = None
    still = 0
    since_s = 0.0
    while True:
        if len(series) >= _FIRST_FRAMES:
            clock.wait(series[-1][0] + _APART_S - (clock.now_s() - done_s))
        frame = bench.take()
        began_s = frame.time_s - frame.settings.exposure_us * 0.5e-6 - done_s
        if series:
            points = points_to_follow(series[0][1]) if points is None else points
            step = follow(series[-1][1], frame.image, points)
            seen = _seen(step)
            moving = bool(seen.any()) and float(np.linalg.norm(np.median(np.abs(step[seen]), axis=0))) > 3 * _STANDS_PX
            if moving:
                still = 0
            else:
                since_s = began_s if still == 0 else since_s
                still += 1
        series.append((began_s, frame.image))
        at_rest = still >= _AT_REST_FRAMES and began_s - since_s >= _AT_REST_S
        if at_rest or (began_s > _WATCH_S and len(series) >= 2 * _AT_REST_FRAMES):
            return series


def _at_rest(bench: Bench) -> Image:
    return _watched(bench)[-1][1]


def _scene(before: Image, after: Image) -> Scene | None:
    """The points that the move has moved; None: there are too few."""
    uv = points_to_follow(before)
    moved = follow(before, after, uv)
    turns = _seen(moved) & (np.linalg.norm(np.nan_to_num(moved), axis=1) > _MOVES_PX)
    if turns.sum() < _LEAST_POINTS:
        return None
    # single points that went elsewhere than their neighbours are mistaken
    kept = turns & _like_neighbours(uv, moved, turns)
    if kept.sum() < _LEAST_POINTS:
        return None
    return Scene(before, uv[kept], moved[kept])


def _like_neighbours(
    uv: Float[np.ndarray, "n 2"], moved: Float[np.ndarray, "n 2"], among: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether each point moves as the nearest others of ``among`` do, to a quarter of the movement."""
    good = np.zeros(len(uv), dtype=bool)
    places, ways = uv[among], moved[among]
    for i in np.flatnonzero(among):
        near = np.argsort(np.linalg.norm(places - uv[i], axis=1))[1:8]
        usual = np.median(ways[near], axis=0)
        good[i] = bool(np.linalg.norm(moved[i] - usual) <= 0.25 * np.linalg.norm(usual) + _MOVES_PX)
    return good


def _settling(bench: Bench, scene: Scene, series: list[tuple[float, Image]]) -> float:
    """How long after a move the scene still moves, s."""
    times = np.array([t for t, _ in series])
    shares = np.array([scene.share(image) for _, image in series])
    last = shares[-_AT_REST_FRAMES:]
    noise_px = np.nan_to_num(scene.u_share(series[-1][1])) * scene.scale_px
    away_px = (shares - np.nanmean(last)) * scene.scale_px
    period_s = float(np.median(np.diff(times)))
    allowed_px = max(_STANDS_PX, 4.0 * float(noise_px))
    moving = ~(np.abs(away_px) <= allowed_px)
    bench.pictures["settling"] = np.column_stack([times, away_px])
    if moving[-_AT_REST_FRAMES:].any():
        bench.line(
            "turntable", "settling", "fails", f"the scene still moves {times[-1]:.1f} s after a move (by {np.nanmax(np.abs(away_px)):.2f} px)",
            "Fasten what stands on the table, table and camera; move more slowly (acceleration).", px=float(np.nanmax(np.abs(away_px))),
        )  # fmt: skip
        return _WATCH_S
    first = int(np.flatnonzero(moving)[-1]) + 1 if moving.any() else 0
    settled_s = float(times[first]) if first else 0.0
    bench.pictures["settled_s"] = settled_s
    settle_s = math.ceil((settled_s + period_s) / 0.05 - 1e-9) * 0.05 if first else 0.0
    bench.recommended["settle_s"] = round(settle_s, 2)
    level: Level = "ok" if settled_s <= _LONG_SETTLING_S else "doubtful"
    found = (
        f"the scene stands {settled_s:.2f} s after a move" if first else "the first frame after a move stands already"
    )
    bench.line(
        "turntable", "settling", level, f"{found} (within {allowed_px:.2f} px; a frame each {period_s:.3f} s): settle_s = {settle_s:.2f} in the plan",
        "Move more slowly (acceleration), fasten table and camera; every frame of a scan waits for it.", settled_s=settled_s, settle_s=settle_s,
    )  # fmt: skip
    return settle_s


def _returns(bench: Bench, table: Turntable, scene: Scene, way: tuple[float, float, bool], settle_s: float) -> None:
    """Move away and back several times: the scatter of the returns, and the play between both senses."""
    start, step, below = way
    clock = bench.rig.clock

    def back(from_deg: float) -> float:
        _move(bench, from_deg)
        asked_s = clock.now_s()
        _move(bench, start)
        took.append(clock.now_s() - asked_s)
        clock.wait(settle_s)
        return scene.share(bench.take().image)

    took: list[float] = []
    above = np.array([back(start + step) for _ in range(N_RETURNS)])
    clear = above[np.isfinite(above)]
    rest = np.array([scene.share(bench.take().image) for _ in range(4)])
    noise = float(np.std(rest[np.isfinite(rest)], ddof=1)) if np.isfinite(rest).sum() > 1 else 0.0
    if len(clear) < 3:
        bench.line(
            "turntable", "return", "fails", "what stood on the table is not there any more after moves back",
            "Fasten what stands on the table; see that the table does not lose steps.",
        )  # fmt: skip
        return
    spread = float(np.std(clear, ddof=1))
    u_relative = 1.0 / math.sqrt(2.0 * (len(clear) - 1))
    # what the picture's own noise adds is not the table's
    own = math.sqrt(max(spread**2 - noise**2, 0.0))
    u_own = spread * u_relative
    spread_deg, u_deg, noise_deg = own * step, u_own * step, noise * step
    bench.pictures["returns_px"] = (clear - clear.mean()) * scene.scale_px
    stated = table.info.u_angle_deg
    level: Level = "ok" if spread_deg - 2 * u_deg <= stated else "doubtful"
    bench.line(
        "turntable", "return", level,
        f"it returns within {own * scene.scale_px:.3f} +- {u_own * scene.scale_px:.3f} px, that is {spread_deg:.4f} +- {u_deg:.4f} deg (standard deviation of "
        f"{len(clear)} returns, +- standard uncertainty; the picture tells {noise_deg:.4f} deg); rig.toml states {stated:.3g} deg",
        f"State u_angle_deg = {max(spread_deg, stated):.2g} or more in rig.toml, or see play, belt and screws.",
        px=own * scene.scale_px, u_px=u_own * scene.scale_px, deg=spread_deg, u_deg=u_deg, noise_deg=noise_deg, n=len(clear),
    )  # fmt: skip
    if len(took):
        bench.line(
            "turntable", "small moves", "ok", f"{step:g} deg take {float(np.median(took)):.2f} s", move_s=float(np.median(took))
        )  # fmt: skip
    if below:
        _play(bench, clear, np.array([back(start - step) for _ in range(_N_OTHER_SIDE)]), step, stated)
    else:
        bench.leave_out("Play of the table is not measured: its limits leave no room to come from the other side.")


def _play(
    bench: Bench, above: Float[np.ndarray, " n"], other: Float[np.ndarray, " m"], step_deg: float, stated_deg: float
) -> None:
    """The difference between both sides that the table can come from."""
    other = other[np.isfinite(other)]
    if len(other) < 2:
        return
    spread = math.hypot(float(np.std(above, ddof=1)), float(np.std(other, ddof=1)))
    play_deg = float(np.mean(above) - np.mean(other)) * step_deg
    u_deg = spread * math.sqrt(1 / len(above) + 1 / len(other)) * step_deg
    level: Level = "ok" if abs(play_deg) <= max(3 * u_deg, 2 * stated_deg) else "doubtful"
    bench.line(
        "turntable", "play", level,
        f"from above and from below it stops {play_deg:+.4f} +- {u_deg:.4f} deg apart",
        "Come to every angle from the same side, as a scan of rising angles does; take up the play.", deg=play_deg, u_deg=u_deg,
    )  # fmt: skip


def check_turning(bench: Bench) -> None:
    """Turn continuously for a moment: the speed, how evenly, and whether it stands afterwards.

    Raises
    ------
    DeviceError
        If the table raises one.
    """
    table, clock = bench.rig.turntable, bench.rig.clock
    assert table is not None
    info = table.info
    speed = min(_TURN_DEG_S, 0.5 * (info.max_speed_deg_s or _TURN_DEG_S))
    here = table.angle_deg()
    room = 3.0 * speed * _TURN_S
    if info.limits_deg is not None and here + room > info.limits_deg[1]:
        speed = -speed
        if here - room < info.limits_deg[0]:
            bench.leave_out("Continuous turning is not tried: the limits leave no room.")
            return
    reports: list[tuple[float, float]] = []
    table.turn(speed)
    try:
        for _ in range(_REPORTS):
            clock.wait(_TURN_S / _REPORTS)
            asked_s = clock.now_s()
            angle = table.angle_deg()
            reports.append(((asked_s + clock.now_s()) / 2, angle))
    finally:
        asked_s = clock.now_s()
        table.stop(_MOVE_S)
        stop_s = clock.now_s() - asked_s
    stood = (table.angle_deg(), table.angle_deg())
    t, a = np.array(reports).T
    rate, offset = np.polyfit(t - t[0], a, 1)
    uneven = float(np.std(a - (rate * (t - t[0]) + offset)))
    off = rate / speed - 1.0
    turns = abs(off) < 0.5
    level: Level = "fails" if not turns else "ok" if abs(off) <= _SPEED_OFF and stood[0] == stood[1] else "doubtful"
    bench.line(
        "turntable", "turning", level,
        f"asked for {speed:g} deg/s it turns at {rate:.3f} deg/s, evenly to {uneven:.4f} deg; it stands {stop_s:.2f} s after the command",
        "For scans, step and shoot; or see the speed's unit and the acceleration in rig.toml and in the controller.",
        speed_deg_s=float(rate), uneven_deg=uneven, stop_s=stop_s,
    )  # fmt: skip
    table.move_to(here, _MOVE_S)
