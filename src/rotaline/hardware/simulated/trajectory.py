"""How a turntable gets from one angle to another: pieces of constant acceleration.

Within a piece that begins at the time ``t0``: ``angle = angle0 + speed0 (t - t0) + acceleration / 2 (t - t0)^2``.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Piece:
    """A stretch of constant acceleration; times in s, angles in deg.

    ``stop`` numbers the places where the table has come to rest; None: it turns.
    """

    start_s: float
    angle_deg: float
    speed_deg_s: float = 0.0
    acceleration_deg_s2: float = 0.0
    stop: int | None = None

    def angle_at(self, time_s: float) -> float:
        """The angle at a moment of this piece, deg."""
        if self.stop is not None:
            return self.angle_deg
        t = time_s - self.start_s
        return self.angle_deg + self.speed_deg_s * t + self.acceleration_deg_s2 / 2 * t * t

    def speed_at(self, time_s: float) -> float:
        """The speed at a moment of this piece, deg/s."""
        return self.speed_deg_s + self.acceleration_deg_s2 * (time_s - self.start_s)


def change_of_speed(
    start_s: float, angle_deg: float, speed_deg_s: float, new_speed_deg_s: float, acceleration_deg_s2: float
) -> tuple[Piece, Piece]:
    """From one speed to another, and on with it."""
    change = new_speed_deg_s - speed_deg_s
    duration_s = abs(change) / acceleration_deg_s2
    first = Piece(start_s, angle_deg, speed_deg_s, math.copysign(acceleration_deg_s2, change))
    end_s = start_s + duration_s
    return first, Piece(end_s, angle_deg + (speed_deg_s + new_speed_deg_s) / 2 * duration_s, new_speed_deg_s)


def braking(start_s: float, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> tuple[Piece, float]:
    """From a speed to rest: the piece, and how long it takes, s."""
    duration_s = abs(speed_deg_s) / acceleration_deg_s2
    return Piece(start_s, angle_deg, speed_deg_s, -math.copysign(acceleration_deg_s2, speed_deg_s)), duration_s


def move(
    start_s: float, angle_deg: float, to_deg: float, speed_deg_s: float, acceleration_deg_s2: float
) -> tuple[tuple[Piece, ...], float]:
    """From rest to rest: as fast as speed and acceleration allow.

    Returns
    -------
    pieces : without the rest at the end
    duration_s : of all of them
    """
    way, sense = abs(to_deg - angle_deg), math.copysign(1.0, to_deg - angle_deg)
    if way == 0.0:
        return (), 0.0
    fastest = min(speed_deg_s, math.sqrt(way * acceleration_deg_s2))
    ramp_s = fastest / acceleration_deg_s2
    even_s = max(way / fastest - ramp_s, 0.0)
    ramp_deg = sense * fastest * ramp_s / 2
    pieces = (
        Piece(start_s, angle_deg, 0.0, sense * acceleration_deg_s2),
        Piece(start_s + ramp_s, angle_deg + ramp_deg, sense * fastest),
        Piece(start_s + ramp_s + even_s, to_deg - ramp_deg, sense * fastest, -sense * acceleration_deg_s2),
    )
    return pieces, 2 * ramp_s + even_s
