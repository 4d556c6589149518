"""What all benchmarks share: measured values, rounds, growth with size, the machine, and the file of results."""

import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

SCHEMA = "rotaline benchmarks 2"
PACKAGES = ("rotaline", "numpy", "scipy", "numba", "opencv-python-headless", "open3d-cpu", "zarr", "scikit-image")
ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Measurement:
    """One figure, measured once or several times.

    Attributes
    ----------
    benchmark : which of the suite
    name : what was measured
    unit : of the values; with "s" and its parts, less is faster
    values : of the repeats
    parameter, parameter_name : size of what was worked on (``3200``, ``"frames"``), where there is a series
    """

    benchmark: str
    name: str
    unit: str
    values: tuple[float, ...]
    parameter: float | None = None
    parameter_name: str = ""

    @property
    def median(self) -> float:
        """Of the repeats."""
        return float(np.median(self.values))

    @property
    def spread(self) -> float:
        """1.4826 times the median distance from the median: the standard deviation, were the noise normal."""
        return float(1.4826 * np.median(np.abs(np.array(self.values) - self.median)))


@dataclass(frozen=True)
class Setting:
    """How the suite runs: ``quick`` with small ranges and few repeats; ``folder`` for files; ``frames`` of the user's own, or None."""

    quick: bool
    folder: Path
    frames: Path | None = None

    @property
    def repeats(self) -> int:
        """Of what takes long."""
        return 1 if self.quick else 3


@dataclass(frozen=True)
class Benchmark:
    """A part of the suite: what it is called, what it measures, and the function that does it and prints its table."""

    name: str
    title: str
    run: Callable[[Setting], list[Measurement]]


@dataclass(frozen=True)
class Part:
    """What a run printed of one benchmark, the seconds that it took, and its measurements."""

    name: str
    seconds: float
    table: str
    measurements: tuple[Measurement, ...]


def in_rounds(
    functions: Mapping[str, Callable[[int], object]], rounds: int, budget_s: float = 0.05, most_calls: int = 48
) -> dict[str, tuple[float, ...]]:
    """Seconds of the middle call of each function's turn, round by round: one after the other has its turn, so that a busy moment hits all.

    Parameters
    ----------
    functions : each is called with 0, 1, 2, ... and goes through its frames by that number
    rounds : repeats
    budget_s : a turn lasts about this long, at least one call
    most_calls : of a turn
    """
    calls, seconds = {}, {name: [] for name in functions}
    for name, function in functions.items():
        function(0)  # compiled, loaded
        start = time.perf_counter()
        function(1)
        calls[name] = int(np.clip(budget_s / (time.perf_counter() - start), 1, most_calls))
    at = dict.fromkeys(functions, 0)
    for _ in range(rounds):
        for name, function in functions.items():
            turn = []
            for i in range(at[name], at[name] + calls[name]):
                start = time.perf_counter()
                function(i)
                turn.append(time.perf_counter() - start)
            seconds[name].append(float(np.median(turn)))
            at[name] += calls[name]
    return {name: tuple(values) for name, values in seconds.items()}


def timed(function: Callable[[], object], repeats: int) -> tuple[float, ...]:
    """Seconds of each repeat."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return tuple(seconds)


@dataclass(frozen=True)
class Growth:
    """``value = factor * parameter ** exponent``: least squares on the logarithms of the medians, with the exponent's standard uncertainty."""

    benchmark: str
    name: str
    parameter_name: str
    exponent: float
    u_exponent: float
    factor: float


def growth(series: Sequence[Measurement]) -> Growth:
    """The growth of a series: the same name, other parameters."""
    x = np.log([float(m.parameter or np.nan) for m in series])
    y = np.log([m.median for m in series])
    u = float("nan")
    if len(series) > 2:
        (exponent, constant), covariance = np.polyfit(x, y, 1, cov=True)
        u = float(np.sqrt(covariance[0, 0]))
    else:
        exponent, constant = np.polyfit(x, y, 1)
    first = series[0]
    return Growth(
        first.benchmark, first.name, first.parameter_name, float(exponent), u, float(np.exp(np.float64(constant)))
    )


def growths(measurements: Sequence[Measurement]) -> list[Growth]:
    """Of every series of seconds (in all, or for a frame) or memory with at least three sizes."""
    series: dict[tuple[str, str, str], list[Measurement]] = {}
    for m in measurements:
        if m.parameter is not None and m.unit in ("s", "s/frame", "MB"):
            series.setdefault((m.benchmark, m.name, m.parameter_name), []).append(m)
    return [growth(s) for s in series.values() if len({m.parameter for m in s}) >= 3]


def is_time(unit: str) -> bool:
    """Whether a unit is of time: seconds, or milliseconds, in all or of something."""
    return unit.split("/")[0] in ("s", "ms", "us")


def machine() -> dict[str, str]:
    """Processor, cores, memory, system."""
    processor = platform.processor()
    memory = ""
    cpu_info, memory_info = Path("/proc/cpuinfo"), Path("/proc/meminfo")
    if cpu_info.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpu_info.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    if memory_info.is_file():
        memory = f"{int(memory_info.read_text().split()[1]) / 2**20:.1f} GiB"
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return {
        "processor": processor,
        "cores": str(os.cpu_count()),
        "memory": memory,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "load before": load,
    }


def versions() -> dict[str, str]:
    """Versions of Python and the packages, and the commit where the sources are a checkout; "+" behind it: with changes."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    commit = _git("rev-parse", "--short", "HEAD")
    if commit:
        found["commit"] = commit + ("+" if _git("status", "--porcelain", "--untracked-files=no") else "")
    return found


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def as_lines(facts: Mapping[str, str]) -> str:
    """Facts in one line."""
    return ", ".join(f"{name} {value}" for name, value in facts.items() if value)


def write_results(path: Path, parts: Sequence[Part], quick: bool) -> None:
    """Write all that was measured, with the machine and the versions; the file is there whole or as it was."""
    measurements = [m for part in parts for m in part.measurements]
    document = {
        "schema": SCHEMA,
        "quick": quick,
        "machine": machine(),
        "versions": versions(),
        "parts": [{"name": part.name, "seconds": part.seconds, "table": part.table} for part in parts],
        "measurements": [asdict(m) | {"median": m.median, "spread": m.spread} for m in measurements],
        "growth": [asdict(g) for g in growths(measurements)],
    }
    written = path.with_suffix(".part")
    written.write_text(json.dumps(_without_nan(document), indent=1) + "\n", encoding="utf-8")
    written.replace(path)


def read_results(path: Path) -> tuple[dict[str, Any], list[Part]]:
    """The document and its parts.

    Raises
    ------
    ValueError
        If the file is not a file of results.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: this cannot be read as JSON: {error}") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise ValueError(f"{path}: expected a file that `python -m benchmarks` wrote, with schema {SCHEMA!r}.")
    fields = ("benchmark", "name", "unit", "parameter", "parameter_name")
    rows = [Measurement(**{f: m[f] for f in fields}, values=_values(m["values"])) for m in document["measurements"]]
    return document, [
        Part(p["name"], p["seconds"], p["table"], tuple(m for m in rows if m.benchmark == p["name"]))
        for p in document["parts"]
    ]


def earlier_parts(path: Path, quick: bool) -> list[Part]:
    """The parts that an earlier run of the same sources, in the same sizes, has left in a file; none if there is no file.

    Raises
    ------
    ValueError
        If the file is of other sources, versions or sizes, which cannot stand in one table.
    """
    if not path.is_file():
        return []
    document, parts = read_results(path)
    here = {"quick": quick, **{k: v.rstrip("+") for k, v in versions().items()}}
    there = {"quick": document["quick"], **{k: v.rstrip("+") for k, v in document["versions"].items()}}
    other = [f"{k} {there.get(k)}, now {here.get(k)}" for k in sorted({*here, *there}) if here.get(k) != there.get(k)]
    if other:
        raise ValueError(
            f"{path}: these results are of another run: {'; '.join(other)}. Leave out --resume, or give another --out."
        )
    return parts


def _values(values: Sequence[float | None]) -> tuple[float, ...]:
    return tuple(float("nan") if v is None else float(v) for v in values)


def _without_nan(value: Any) -> Any:
    """JSON knows no NaN: null."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def filled(page: str, tables: dict[str, str]) -> str:
    """The page with the tables in those of its blocks that are marked ```` ```text NAME ````."""
    for name, table in tables.items():
        block = re.compile(rf"^(```text {re.escape(name)}\n).*?^```$", re.MULTILINE | re.DOTALL)
        page = block.sub(lambda found, table=table: f"{found[1]}{table}\n```", page)
    return page
