"""The commands that check the methods against known truth: verify-axis, verify-stripe, verify-uncertainty, verify-methods."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rotaline.cli.base import INCOMPLETE, Json, app

if TYPE_CHECKING:
    from rotaline.pipeline.realisations import WorkPlan


@app.command("verify-axis")
def verify_axis_command(
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the picture of the convergence curves.")] = None,
    as_json: Json = False,
) -> None:
    """The simulation of section 5.4 of the article: table 1, mean distance before and after optimisation of the axis."""
    from rotaline.cli.commands import print_json
    from rotaline.cli.tables import show_axis_verification
    from rotaline.io.files import make_folder
    from rotaline.pipeline.verify_axis import verify_axis, write_convergence_picture

    verification = verify_axis()
    picture = None
    if out is not None:
        make_folder(out)
        picture = out / "verify-axis.png"
        write_convergence_picture(verification, picture)
    if as_json:
        print_json([{**vars(case)} for case in verification.cases])
    else:
        show_axis_verification(verification)
        typer.echo(f"Picture: {picture}" if picture else "With --out DIR: a picture of the convergence curves.")


@app.command("verify-stripe")
def verify_stripe_command(as_json: Json = False) -> None:
    """RMS and bias of each stripe method on synthetic stripes of known truth, beside the Cramer-Rao bound."""
    import dataclasses

    from rotaline.cli.commands import print_json
    from rotaline.cli.console import ConsoleObserver
    from rotaline.cli.tables import show_stripe_verification
    from rotaline.pipeline.verify_stripe import stripe_cases, verify_stripe

    observer = ConsoleObserver(0 if as_json else 1)
    with observer.work("cases", len(stripe_cases())) as count:
        rows = verify_stripe(progress=lambda done, total: count())
    if as_json:
        print_json([dataclasses.asdict(row) for row in rows])
    else:
        show_stripe_verification(rows)


Realisations = Annotated[int, typer.Option("--realisations", min=2, help="Realisations of the noise, of each kind.")]
Jobs = Annotated[int, typer.Option("--jobs", min=1, help="Processes that work side by side.")]
KeptIn = Annotated[
    Path | None,
    typer.Option("--out", help="Folder in which finished realisations are kept: the same command goes on there."),
]


@app.command("verify-uncertainty")
def verify_uncertainty_command(
    realisations: Realisations = 200, jobs: Jobs = 2, out: KeptIn = None, as_json: Json = False
) -> None:
    """Whether the stated uncertainties hold: coverage on sessions of known truth, and spread beside the Cramer-Rao bound.

    Twenty sessions of the preset article, each with its own table, plates and poses, are observed without images, calibrated jointly and
    measured, again and again with new noise. Then one ideal session, with Gaussian noise and with outliers.
    """
    import dataclasses

    from rotaline.cli.commands import print_json
    from rotaline.cli.tables import show_efficiency, show_uncertainty
    from rotaline.pipeline.verify_efficiency import verify_efficiency
    from rotaline.pipeline.verify_uncertainty import verify_uncertainty

    plan = _work_plan(jobs, out, as_json)
    coverage = verify_uncertainty(realisations, plan)
    efficiency = verify_efficiency(realisations, plan)
    if as_json:
        print_json({"coverage": dataclasses.asdict(coverage), "efficiency": dataclasses.asdict(efficiency)})
    else:
        show_uncertainty(coverage)
        show_efficiency(efficiency)
    if coverage.failures or efficiency.failures:
        raise typer.Exit(INCOMPLETE)


@app.command("verify-methods")
def verify_methods_command(
    sessions: Annotated[int, typer.Option("--sessions", min=1, help="Sessions to draw and observe.")] = 20,
    rendered: Annotated[
        list[Path] | None,
        typer.Option(
            "--rendered",
            metavar="DIR",
            help="A session that `rotaline simulate` rendered, its truth beside it, instead of drawn ones; repeatable, needs --out.",
        ),
    ] = None,
    jobs: Jobs = 2,
    out: KeptIn = None,
    as_json: Json = False,
) -> None:
    """The article's method against the joint estimate on the same sessions, whose table has realistic errors."""
    import dataclasses

    from rotaline.cli.commands import print_json
    from rotaline.cli.tables import show_methods
    from rotaline.pipeline.verify_methods import verify_methods

    result = verify_methods(sessions, tuple(rendered or ()), _work_plan(jobs, out, as_json))
    if as_json:
        print_json(dataclasses.asdict(result))
    else:
        show_methods(result)
    if result.failures:
        raise typer.Exit(INCOMPLETE)


def _work_plan(jobs: int, out: Path | None, as_json: bool) -> "WorkPlan":
    """How the work is done; a folder that cannot be written is found out at once."""
    from rotaline.cli.console import ConsoleObserver
    from rotaline.pipeline.realisations import WorkPlan
    from rotaline.pipeline.store import check_writable

    if out is not None:
        check_writable(out)
    return WorkPlan(jobs, out, ConsoleObserver(0 if as_json else 1))
