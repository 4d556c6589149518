"""A board with axes and outputs, whatever G-code it speaks; a turntable and a laser may share one."""

from typing import Literal, Protocol, runtime_checkable

from rotaline.errors import DeviceConnectionError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.tables import Positive, Table, key

Dialect = Literal["grbl", "grblhal", "marlin"]


class BoardSettings(Table):
    """The keys that say which board; a turntable and a laser at the same port share it."""

    port: str = key(..., "serial port, as /dev/ttyUSB0, /dev/serial/by-id/... or COM3")
    dialect: Dialect = key(..., "firmware: grbl (1.1), grblhal or marlin")
    baud: int = key(115200, "baud rate, 1/s; without effect on boards with USB of their own")
    answer_s: Positive = key(2.0, "time that the board is given for an answer, s")
    start_s: Positive = key(
        8.0, "time that the board is given to start once its port is open, s: many are reset by that"
    )


@runtime_checkable
class Board(Protocol):
    """A board that is open. Positions in the units of an axis, feeds in units/min.

    ``lost``: why positions cannot be trusted, None: they can. ``n_resets``: how often it was reset since it was opened; a reset
    switches its outputs off. ``can_jog``: :meth:`run` works. ``decimals``: of the positions that it reports.
    """

    device: str
    lost: str | None
    n_resets: int
    can_jog: bool
    decimals: int

    def read(self, axis: str) -> float:
        """Where the axis is now, also while it moves (with ``can_jog``)."""

    def ready(self) -> None:
        """Return if the board stands and would move; else DeviceStateError says why not."""

    def move(self, axis: str, target: float, feed: float, timeout_s: float) -> float:
        """Move, after :meth:`ready`, and return the position that is reported once it stands. After an error nobody has stopped it."""

    def run(self, axis: str, distance: float, feed: float) -> None:
        """Begin to move, after :meth:`ready`; returns when the feed has been reached."""

    def stop(self, timeout_s: float) -> None:
        """Stop; it stands when this returns. ``lost`` says whether the position is still known."""

    def home(self, axis: str, timeout_s: float) -> float:
        """Search the reference; returns the position there. It is known again."""

    def unlock(self) -> None:
        """Leave an alarm where it stands: from now on the positions are those that the board counts."""

    def max_feed(self, axis: str) -> float | None:
        """The greatest feed of an axis; None: the board does not say."""

    def check_laser(self, device: str, full_s: float | None) -> None:
        """DeviceStateError or DeviceLimitError if the outputs are not set for a laser that shines while nothing moves."""

    def switch(self, line: str, off: bool) -> None:
        """Send the line that switches an output; it has been switched when this returns. Off is enforced, if need be by a reset."""

    def close(self) -> None:
        """Let the port go; never raises."""


def open_board(settings: BoardSettings, clock: Clock, connections: Connections) -> Board:
    """The board of a port; the first device that asks opens it. It stands.

    Raises
    ------
    DeviceConnectionError
        If the port cannot be opened, or another device of the rig opened it otherwise.
    DeviceTimeoutError
        If nobody answers there as the dialect says.
    """
    board, made_for = connections.shared(("gcode", settings.port), lambda: _Opened(settings, clock)).pair
    mine = (settings.dialect, settings.baud)
    if mine != (made_for.dialect, made_for.baud):
        raise DeviceConnectionError(
            f"{settings.port}: dialect and baud are {mine[0]}, {mine[1]} for one device and {made_for.dialect}, {made_for.baud} for"
            " another at the same port. State the same for both in rig.toml."
        )
    return board


class _Opened:
    """A board with the settings that it was opened by."""

    def __init__(self, settings: BoardSettings, clock: Clock) -> None:
        from rotaline.hardware.gcode.connection import LinePort
        from rotaline.hardware.gcode.grbl import GrblBoard
        from rotaline.hardware.gcode.marlin import MarlinBoard

        port = LinePort(settings.port, settings.baud, clock)
        try:
            board: Board
            if settings.dialect == "marlin":
                board = MarlinBoard(port, clock, settings.answer_s, settings.start_s)
            else:
                board = GrblBoard(port, clock, settings.answer_s, settings.start_s, settings.dialect)
        except BaseException:
            port.close()
            raise
        self.pair = (board, settings)

    def close(self) -> None:
        self.pair[0].close()
