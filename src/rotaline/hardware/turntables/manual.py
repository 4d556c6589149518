"""An indexing table that a person turns: the program asks, and believes what the person reads off the scale."""

import math
from typing import Annotated, Literal

from pydantic import Strict, model_validator

from rotaline.errors import DeviceLimitError, DeviceStateError
from rotaline.hardware.by_hand import Ask, answer_of, person_of
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.turntable import TurntableInfo
from rotaline.tables import NotNegative, Number, Positive, Table, key


class Settings(Table):
    """``[turntable]`` of rig.toml."""

    driver: Literal["manual"] = key(..., "manual")
    name: str = key("indexing table", "how messages call it")
    resolution_deg: Positive = key(
        ..., "smallest angle that can be read off the scale, or the step of the index pins, deg"
    )
    u_angle_deg: NotNegative = key(..., "standard uncertainty of an angle that is set and read, deg")
    limits_deg: Annotated[tuple[Number, Number], Strict(False)] | None = key(
        None, "least and greatest angle, deg; left out: it turns without end"
    )
    settle_s: NotNegative = key(1.0, "wait after the person has let go, s")

    @model_validator(mode="after")
    def _fits(self) -> "Settings":
        if self.limits_deg is not None and not self.limits_deg[0] < self.limits_deg[1]:
            raise ValueError(f"limits_deg are {list(self.limits_deg)}; the first has to be the smaller one")
        return self


class ManualTurntable:
    """See :class:`~rotaline.hardware.turntable.Turntable`. A person has no time-out: calls wait for the answer."""

    def __init__(self, settings: Settings, ask: Ask, clock: Clock) -> None:
        """Its angle is not known until it has been asked for."""
        self._settings = settings
        self._ask = ask
        self._clock = clock
        self._angle: float | None = None
        self._asked_for: float | None = None
        self._closed = False
        self._info = TurntableInfo(
            device=settings.name,
            limits_deg=settings.limits_deg,
            resolution_deg=settings.resolution_deg,
            u_angle_deg=settings.u_angle_deg,
            has_reference=True,  # the mark 0 of its scale
            continuous=False,
        )

    @property
    def info(self) -> TurntableInfo:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        return self._info

    def home(self, timeout_s: float) -> None:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        self._check_open()
        self._angle = None
        self._question(f"{self._settings.name}: turn it to its mark 0, then press Enter:")
        self._angle = self._asked_for = 0.0
        self._clock.wait(self._settings.settle_s)

    def move_to(self, angle_deg: float, timeout_s: float) -> float:
        """See :class:`~rotaline.hardware.turntable.Turntable`; the angle is the one that was typed, or, after a bare Enter, the one asked for.

        A typed angle that is farther from the one asked for than the resolution is believed only when it is typed twice. Nobody is asked for the
        angle at which it stands already: the one that was typed, or the one that was asked for before and reached as well as can be read.
        """
        self._check_open()
        if not self._within(angle_deg):
            least, most = self._settings.limits_deg or (-math.inf, math.inf)
            raise DeviceLimitError(
                f"{self._info.device}: {angle_deg:g} deg is outside of its limits, {least:g} to {most:g} deg; nobody was asked to turn it."
                " Choose an angle within, or correct limits_deg in rig.toml."
            )
        if self._angle is not None and self._stands_at(angle_deg, self._angle):
            return self._angle
        self._angle = None  # while it is being turned, and if the person breaks off
        self._angle, self._asked_for = self._asked(angle_deg), angle_deg
        self._clock.wait(self._settings.settle_s)
        return self._angle

    def angle_deg(self) -> float:
        """See :class:`~rotaline.hardware.turntable.Turntable`.

        Raises
        ------
        DeviceStateError
            If nobody has said yet where it stands.
        """
        self._check_open()
        if self._angle is None:
            raise DeviceStateError(
                f"{self._info.device}: where it stands is not known. Home it, or turn it to an angle."
            )
        return self._angle

    def turn(self, speed_deg_s: float) -> None:
        """It cannot."""
        self._check_open()
        raise DeviceStateError(f"{self._info.device}: a person cannot turn it evenly. Step and shoot instead.")

    def stop(self, timeout_s: float) -> None:
        """It stands whenever a call has returned."""
        self._check_open()

    def close(self) -> None:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        self._closed = True

    def _asked(self, angle_deg: float) -> float:
        question = f"{self._settings.name}: turn it to {angle_deg:.3f} deg, then press Enter, or type the angle that you read, deg:"
        doubtful: float | None = None
        while True:
            answer = self._question(question).strip().replace(",", ".")
            if not answer:
                return angle_deg
            try:
                read = float(answer)
            except ValueError:
                read = math.nan
            if not self._within(read):
                question = f"'{answer}' is no angle that it can have. Type the angle that you read, deg, or press Enter for {angle_deg:.3f}:"
            elif abs(read - angle_deg) <= self._settings.resolution_deg or read == doubtful:
                return read
            else:
                doubtful = read
                question = f"{read:g} deg is {read - angle_deg:+g} deg off. Type it again if that is so, or turn it to {angle_deg:.3f} deg and press Enter:"

    def _stands_at(self, wanted_deg: float, angle_deg: float) -> bool:
        reached = wanted_deg == self._asked_for and abs(angle_deg - wanted_deg) <= self._settings.resolution_deg
        return reached or wanted_deg == angle_deg

    def _within(self, angle_deg: float) -> bool:
        least, most = self._settings.limits_deg or (-math.inf, math.inf)
        return math.isfinite(angle_deg) and least <= angle_deg <= most

    def _question(self, text: str) -> str:
        return answer_of(self._ask, self._info.device, text, "Work in a terminal.")

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceStateError(f"{self._info.device}: it has been closed. Open it again.")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> ManualTurntable:
    """The table; see :mod:`rotaline.hardware.drivers`. ``prompt`` of the connections asks the person: question in, answer out.

    Raises
    ------
    DeviceStateError
        If there is no terminal.
    """
    return ManualTurntable(settings, person_of(settings.name, "turn it", connections), clock)


def find() -> tuple[FoundDevice, ...]:
    """Nothing: whether there is a person with a table cannot be seen."""
    return ()
