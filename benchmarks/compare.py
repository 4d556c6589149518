"""What became slower from one run of the benchmarks to another, by more than the noise: ``python -m benchmarks.compare OLD.json NEW.json``.

A time counts as slower if the ratio of the medians, new over old, is above ``1 + max(0.05, 2 sqrt(a^2 + b^2))``, where a and b are the relative
spreads of the repeats (1.4826 times the median absolute deviation over the median). Single values cannot show their noise: for them, and
where fewer than three repeats were made, 25 % are taken as the spread. The exit code is 0 whatever was found, and 2 if a file cannot be read.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import Measurement, as_lines, is_time, read_results

LEAST = 0.05
SPREADS = 2.0
UNKNOWN_SPREAD = 0.25
FEWEST = 3


@dataclass(frozen=True)
class Change:
    """One time in both runs: ``ratio`` new over old, and the ratio beyond 1 that the noise explains."""

    name: str
    old: float
    new: float
    unit: str
    ratio: float
    noise: float

    @property
    def verdict(self) -> str:
        """``slower``, ``faster`` or ``same``."""
        if self.ratio > 1.0 + self.noise:
            return "slower"
        return "faster" if self.ratio < 1.0 / (1.0 + self.noise) else "same"


def compare(old: Sequence[Measurement], new: Sequence[Measurement]) -> list[Change]:
    """The times that both have, slowest against before first."""
    before = {_key(m): m for m in old}
    changes = []
    for m in new:
        a = before.get(_key(m))
        if a is None or not is_time(m.unit) or not (a.median > 0 and m.median > 0):
            continue
        noise = max(LEAST, SPREADS * float(np.hypot(_relative_spread(a), _relative_spread(m))))
        changes.append(Change(_label(m), a.median, m.median, m.unit, m.median / a.median, noise))
    return sorted(changes, key=lambda c: -c.ratio)


def _key(m: Measurement) -> tuple[str, str, str, float | None]:
    return m.benchmark, m.name, m.unit, m.parameter


def _label(m: Measurement) -> str:
    size = "" if m.parameter is None else f", {m.parameter:g} {m.parameter_name}"
    return f"{m.benchmark}: {m.name}{size}"


def _relative_spread(m: Measurement) -> float:
    return m.spread / m.median if len(m.values) >= FEWEST else UNKNOWN_SPREAD


def main(arguments: Sequence[str]) -> int:
    """Print what became slower, and what became faster."""
    if len(arguments) != 2:
        print("Two files are needed: python -m benchmarks.compare OLD.json NEW.json", file=sys.stderr)
        return 2
    try:
        (first, old), (second, new) = (read_results(Path(a)) for a in arguments)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    for what in ("machine", "versions"):
        facts = {k: v for k, v in first[what].items() if k != "load before"}
        others = {k: v for k, v in second[what].items() if k != "load before"}
        if facts != others:
            print(f"Another {what}:\n  {as_lines(facts)}\n  {as_lines(others)}")
    changes = compare(*([m for part in parts for m in part.measurements] for parts in (old, new)))
    for verdict in ("slower", "faster"):
        found = [c for c in changes if c.verdict == verdict]
        print(f"{len(found)} of {len(changes)} times became {verdict} by more than the noise" + (":" if found else "."))
        for c in found:
            noise = f"noise {100 * c.noise:.0f} %"
            print(f"  {c.name:60} {c.old:10.4g} -> {c.new:10.4g} {c.unit:10} x {c.ratio:.2f} ({noise})")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
