"""All benchmarks, or some: ``python -m benchmarks --help``."""

import argparse
import sys
import tempfile
import time
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

from benchmarks.harness import Measurement, Setting, as_lines, filled, growths, machine, versions, write_results
from benchmarks.plots import draw
from benchmarks.suite import SUITE


def main() -> int:
    """Run, print, write ``benchmarks.json`` and the plots."""
    names = [b.name for b in SUITE]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Measure speed and accuracy; nothing is asserted."
    )
    parser.add_argument("--quick", action="store_true", help="small sizes and few repeats: minutes instead of an hour")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, default=names, help=", ".join(names))
    parser.add_argument(
        "--frames", type=Path, metavar="DIR", help="frames of your own rig for the comparison per frame"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("benchmark-results"), metavar="DIR", help="for the JSON file and the plots"
    )
    parser.add_argument(
        "--docs", type=Path, metavar="DIR", help="also put tables and plots into benchmarks.md and pictures/ there"
    )
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    facts = f"{as_lines(machine())}\n{as_lines(versions())}"
    print(facts)
    found: list[Measurement] = []
    tables = {"machine": facts}
    with tempfile.TemporaryDirectory(prefix="rotaline-benchmarks-") as folder:
        setting = Setting(arguments.quick, Path(folder), arguments.frames)
        for benchmark in SUITE:
            if benchmark.name not in arguments.only:
                continue
            print(f"\n== {benchmark.name}: {benchmark.title}", flush=True)
            start = time.perf_counter()
            with redirect_stdout(_Kept()) as kept:
                here = benchmark.run(setting)
                for g in growths(here):
                    u = f" +- {g.u_exponent:.2f}" if g.u_exponent == g.u_exponent else ""
                    print(f"{g.name}: grows with the power {g.exponent:.2f}{u} of the number of {g.parameter_name}")
            tables[benchmark.name] = kept.getvalue().rstrip()
            print(f"({time.perf_counter() - start:.0f} s)", flush=True)
            found += here
            # after each: an interruption loses no more than one
            write_results(arguments.out / "benchmarks.json", found, arguments.quick)
    drawn = draw(found, arguments.out)
    if arguments.docs:
        page = arguments.docs / "benchmarks.md"
        page.write_text(filled(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
        draw(found, arguments.docs / "pictures")
    print(f"\n{arguments.out / 'benchmarks.json'}, {', '.join(str(path) for path in drawn)}")
    return 0


class _Kept(StringIO):
    """Shows what is printed, and keeps it."""

    def write(self, text: str) -> int:
        sys.__stdout__.write(text)  # type: ignore[union-attr]
        sys.__stdout__.flush()  # type: ignore[union-attr]
        return super().write(text)


if __name__ == "__main__":
    sys.exit(main())
