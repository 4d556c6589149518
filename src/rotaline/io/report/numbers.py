"""How numbers are written in the report: fixed decimals, a true minus sign, an en dash where there is no number."""

import math

MISSING = "–"
_MINUS = "\N{MINUS SIGN}"
_THIN = "\N{NARROW NO-BREAK SPACE}"


def fixed(value: float | None, decimals: int, signed: bool = False) -> str:
    """A number with fixed decimals; ``–`` for None, NaN and infinity.

    Examples
    --------
    >>> fixed(1.23456, 2), fixed(float("nan"), 2), fixed(0.5, 1, signed=True)
    ('1.23', '–', '+0.5')
    """
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{abs(value):.{decimals}f}"
    if float(text) == 0.0:
        return text
    return (_MINUS if value < 0 else "+" if signed else "") + text


def mm(value: float | None, signed: bool = False) -> str:
    """A length in mm to 0.1 um: ``28.4750``."""
    return fixed(value, 4, signed)


def um(value_mm: float | None, signed: bool = False) -> str:
    """A length given in mm, in um: 0.0123 -> ``12.3``; one more decimal below 1 um."""
    if value_mm is None or not math.isfinite(value_mm):
        return MISSING
    return fixed(value_mm * 1e3, 2 if abs(value_mm) < 0.9995e-3 else 1, signed)


def percent(fraction: float | None, decimals: int = 1, signed: bool = False) -> str:
    """A fraction in per cent, without the sign: 0.0832 -> ``8.3``."""
    return fixed(None if fraction is None else fraction * 100.0, decimals, signed)


def significant(value: float | None, digits: int = 3) -> str:
    """A number to a few significant digits, with a power of ten only where it is very small or very large."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -5 <= exponent <= 6:
        return fixed(value, max(0, digits - 1 - exponent))
    mantissa, power = f"{abs(value):.{digits - 1}e}".split("e")
    sign = _MINUS if value < 0 else ""
    return f"{sign}{mantissa}e{_MINUS if int(power) < 0 else ''}{abs(int(power))}"


def parameter(value: float | None, u: float | None) -> str:
    """A parameter to the second digit of its standard uncertainty.

    Examples
    --------
    >>> parameter(1234.56789, 0.0123), parameter(-0.1234567, 0.00089)
    ('1234.568', '−0.12346')
    """
    if u is None or not math.isfinite(u) or u <= 0.0:
        return significant(value, 6)
    return fixed(value, min(10, max(0, 1 - math.floor(math.log10(u)))))


def count(value: int) -> str:
    """A whole number in groups of three: ``1 234 567``."""
    return f"{value:,}".replace(",", _THIN)


def seconds(value: float | None) -> str:
    """A time: ``0.42 s``, ``12.3 s``, ``3 min 05 s``."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value < 60.0:
        return f"{fixed(value, 2 if value < 9.995 else 1)} s"
    return f"{round(value) // 60} min {round(value) % 60:02d} s"


def plural(n: int, noun: str, plural_noun: str = "") -> str:
    """``1 view``, ``12 views``."""
    return f"{count(n)} {noun if n == 1 else plural_noun or noun + 's'}"
