"""Arguments of the command line that are more than a word: sizes and regions."""

from rotaline.errors import SessionError
from rotaline.metrology.model import Region


def lengths(option: str, settings: list[str] | None) -> dict[str, float]:
    """``["diameter=38.004"]`` to ``{"diameter": 38.004}``.

    Raises
    ------
    SessionError
        If a text is not ``quantity=mm``.
    """
    result = {}
    for text in settings or []:
        name, equals, value = text.partition("=")
        try:
            result[name.strip()] = float(value)
        except ValueError as error:
            raise SessionError(f"{option} {text}: expected quantity=mm, for example diameter=38.004.") from error
        if not equals or not name.strip():
            raise SessionError(f"{option} {text}: expected quantity=mm, for example diameter=38.004.")
    return result


def region_of(settings: list[str] | None) -> Region | None:
    """``["z=1:20"]`` to a region; None if nothing is given.

    Raises
    ------
    SessionError
        If a text is not ``axis=from:to``.
    """
    limits: dict[str, tuple[float, float]] = {}
    for text in settings or []:
        name, _, span = text.partition("=")
        first, _, last = span.partition(":")
        try:
            low, high = float(first), float(last)
        except ValueError as error:
            raise SessionError(
                f"--region {text}: expected x, y, z or radius=FROM:TO in mm, for example z=1:20."
            ) from error
        if name.strip() not in ("x", "y", "z", "radius") or not low < high:
            raise SessionError(f"--region {text}: expected x, y, z or radius=FROM:TO in mm with FROM < TO.")
        limits[name.strip()] = (low, high)
    return Region(**limits) if limits else None
