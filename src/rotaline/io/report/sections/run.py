"""How the results came about: times and options of the stages, versions."""

from rotaline.io.report import numbers
from rotaline.io.report.contents import RunInfo
from rotaline.io.report.page import Block, Column, Row, Section, Table
from rotaline.io.report.warnings import stage_title


def section(run: RunInfo) -> Section:
    """Times, options, versions."""
    total = sum(run.stage_seconds.values())
    blocks: list[Block] = []
    if run.stage_seconds:
        blocks.append(
            Table(
                "Time of each stage.",
                (Column("Stage", numeric=False), Column("Time"), Column("Share", "%")),
                (
                    *(
                        Row((stage_title(name), numbers.seconds(s), numbers.percent(s / total if total else None, 0)))
                        for name, s in run.stage_seconds.items()
                    ),
                    Row(("Sum", numbers.seconds(total), ""), "total"),
                ),
                "Stages that were taken from an earlier run took no time here.",
                stacks=2 if len(run.stage_seconds) > 12 else 1,
            )
        )
    if run.options:
        blocks.append(
            Table(
                "Options of the stages.",
                (Column("Option", numeric=False), Column("Value", numeric=False)),
                tuple(Row((name, value)) for name, value in run.options.items()),
                stacks=2 if len(run.options) > 12 else 1,
            )
        )
    blocks.append(
        Table(
            "Software and machine.",
            (Column("What", numeric=False), Column("Version", numeric=False)),
            (*(Row((name, version)) for name, version in run.versions.items()), Row(("machine", run.machine))),
        )
    )
    return Section("run", "Options, times and versions", "Run", blocks=tuple(blocks))
