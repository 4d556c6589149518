"""All benchmarks, or some: ``python -m benchmarks --help``."""

import argparse
import sys
import tempfile
import time
import traceback
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

from benchmarks.harness import (
    Benchmark,
    Part,
    Setting,
    as_lines,
    earlier_parts,
    filled,
    growths,
    machine,
    versions,
    write_results,
)
from benchmarks.plots import draw
from benchmarks.suite import SUITE

RESULTS = "benchmarks.json"


def main() -> int:
    """Run, print, write ``benchmarks.json`` and the plots; 1 if a part failed."""
    arguments = _arguments()
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = arguments.out / RESULTS
    try:
        kept = earlier_parts(results, arguments.quick) if arguments.resume else []
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    facts = f"{as_lines(machine())}\n{as_lines(versions())}"
    print(facts)
    parts, failed = {part.name: part for part in kept}, []
    wanted = arguments.only or [b.name for b in SUITE if b.name not in parts]
    with tempfile.TemporaryDirectory(prefix="rotaline-benchmarks-") as folder:
        setting = Setting(arguments.quick, Path(folder), arguments.frames)
        for benchmark in (b for b in SUITE if b.name in wanted):
            try:
                parts[benchmark.name] = _run(benchmark, setting)
            except Exception:
                traceback.print_exc()
                failed.append(benchmark.name)
                continue
            # after each: an interruption loses no more than one
            done = [parts[b.name] for b in SUITE if b.name in parts]
            write_results(results, done, arguments.quick)
            if arguments.docs:
                _fill(arguments.docs / "benchmarks.md", done, facts)
    found = [m for part in parts.values() for m in part.measurements]
    drawn = draw(found, arguments.out)
    if arguments.docs:
        draw(found, arguments.docs / "pictures")
    print(f"\n{results}, {', '.join(str(path) for path in drawn)}")
    if failed:
        print(f"failed: {', '.join(failed)}. Run the same command with --resume to try these again.", file=sys.stderr)
    return 1 if failed else 0


def _arguments() -> argparse.Namespace:
    names = [b.name for b in SUITE]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Measure speed and accuracy; nothing is asserted."
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="small sizes and few repeats: a few minutes instead of twenty",
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, help=", ".join(names))
    parser.add_argument(
        "--resume", action="store_true", help="keep what is in --out; run what is missing there, or what --only names"
    )
    parser.add_argument(
        "--frames", type=Path, metavar="DIR", help="frames of your own rig for the comparison per frame"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("benchmark-results"), metavar="DIR", help="for the JSON file and the plots"
    )
    parser.add_argument(
        "--docs", type=Path, metavar="DIR", help="also put tables and plots into benchmarks.md and pictures/ there"
    )
    return parser.parse_args()


def _run(benchmark: Benchmark, setting: Setting) -> Part:
    """Measure, and print the table and the powers of its growth."""
    print(f"\n== {benchmark.name}: {benchmark.title}", flush=True)
    start = time.perf_counter()
    with redirect_stdout(_Kept()) as kept:
        found = benchmark.run(setting)
        for g in growths(found):
            u = f" +- {g.u_exponent:.2f}" if g.u_exponent == g.u_exponent else ""
            print(f"{g.name}: grows with the power {g.exponent:.2f}{u} of the number of {g.parameter_name}")
    seconds = time.perf_counter() - start
    print(f"({seconds:.0f} s)", flush=True)
    return Part(benchmark.name, seconds, kept.getvalue().rstrip(), tuple(found))


def _fill(page: Path, parts: list[Part], facts: str) -> None:
    """Put the tables into the page."""
    took = ", ".join(f"{part.name} {part.seconds:.0f}" for part in parts)
    tables = {part.name: part.table for part in parts} | {"machine": f"{facts}\nseconds that each part took: {took}"}
    page.write_text(filled(page.read_text(encoding="utf-8"), tables), encoding="utf-8")


class _Kept(StringIO):
    """Shows what is printed, and keeps it."""

    def write(self, text: str) -> int:
        sys.__stdout__.write(text)  # type: ignore[union-attr]
        sys.__stdout__.flush()  # type: ignore[union-attr]
        return super().write(text)


if __name__ == "__main__":
    sys.exit(main())
