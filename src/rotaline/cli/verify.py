"""The commands that check the methods against known truth: verify-axis, verify-stripe."""

from pathlib import Path
from typing import Annotated

import typer

from rotaline.cli.base import Json, app


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
