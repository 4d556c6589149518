"""What GRBL and grblHAL answer to `?`: ``<Jog|MPos:1.000,0.000,0.000|FS:600,0|...>``."""

import re
from dataclasses import dataclass

from rotaline.errors import DeviceStateError

_REPORT = re.compile(r"<(?P<state>[A-Z][a-z]+)(:(?P<detail>\d+))?(?P<fields>(\|[A-Za-z]+:[^|<>]*)*)>")


@dataclass(frozen=True)
class Report:
    """A report: state and its number after the colon, machine position in units, feed in units/min (None: it is not told)."""

    state: str
    detail: int | None
    position: tuple[float, ...]
    feed: float | None

    @property
    def decelerates(self) -> bool:
        """Whether a safety door has been opened, or closed, and the board has not come to rest since."""
        return self.state == "Door" and self.detail in (2, 3)


def parse_report(line: str, device: str) -> Report | None:
    """The report that a line is; None: it is none, or a garbled one.

    Raises
    ------
    DeviceStateError
        If the board is set to tell the work position instead of the machine's.

    Examples
    --------
    >>> parse_report("<Hold:0|MPos:1.500,0.000,-2.000|FS:0,0|Ov:100,100,100>", "GRBL")
    Report(state='Hold', detail=0, position=(1.5, 0.0, -2.0), feed=0.0)
    >>> parse_report("<Idle|MPos:1.5<Idle|MPos:1.500,0.000,-2.000|FS:0,0>", "GRBL")
    """
    found = _REPORT.fullmatch(line)
    if found is None:
        return None
    fields = dict(field.split(":", 1) for field in found["fields"].split("|") if field)
    if "WPos" in fields and "MPos" not in fields:
        raise DeviceStateError(
            f"{device}: its reports carry no machine position (MPos). Send $10=1 (grblHAL: $10=511)."
        )
    try:
        position = tuple(float(number) for number in fields["MPos"].split(","))
        speed = fields.get("FS", fields.get("F"))
        feed = None if speed is None else float(speed.split(",")[0])
    except (KeyError, ValueError):
        return None
    return Report(found["state"], None if found["detail"] is None else int(found["detail"]), position, feed)
