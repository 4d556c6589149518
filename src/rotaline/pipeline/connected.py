"""Which devices are connected: the drivers are asked side by side, and none keeps the others waiting for long."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

from rotaline.errors import RotalineError
from rotaline.hardware.drivers import DRIVERS, KINDS, FoundDevice, Kind, find_devices

LIMIT_S = 8.0


@dataclass(frozen=True)
class Looked:
    """What a driver sees; ``problem``: why it cannot look."""

    kind: Kind
    driver: str
    found: tuple[FoundDevice, ...] = ()
    problem: str = ""


def all_drivers() -> tuple[tuple[Kind, str], ...]:
    """Kind and name of each driver that looks for devices: a person and a recorded session are not looked for."""
    return tuple((kind, name) for kind in KINDS for name in DRIVERS[kind] if name not in ("manual", "replay"))


def look(drivers: Sequence[tuple[Kind, str]], limit_s: float = LIMIT_S) -> tuple[Looked, ...]:
    """Ask drivers what is connected; answers come in the order of ``drivers``.

    Parameters
    ----------
    drivers : kind and name of each
    limit_s : one that has not answered by then is left behind; it has not been ended, since a vendor's library cannot be
    """
    answers: dict[tuple[Kind, str], Looked] = {}
    threads = {key: threading.Thread(target=_ask, args=(key, answers), daemon=True) for key in drivers}
    for thread in threads.values():
        thread.start()
    end_s = time.monotonic() + limit_s
    for key, thread in threads.items():
        thread.join(max(end_s - time.monotonic(), 0.0))
        if thread.is_alive():
            answers.setdefault(key, Looked(*key, problem=f"{key[1]}: no answer within {limit_s:g} s."))
    return tuple(answers[key] for key in drivers)


def _ask(key: tuple[Kind, str], answers: dict[tuple[Kind, str], Looked]) -> None:
    try:
        answers[key] = Looked(*key, found=find_devices(*key))
    except RotalineError as error:
        answers[key] = Looked(*key, problem=str(error))
    except Exception as error:  # a driver that fails to look does not keep the others from being shown
        answers[key] = Looked(*key, problem=f"{key[1]}: it could not look ({type(error).__name__}: {error}).")
