"""The command that does the article's experiments with a rendered rig."""

from pathlib import Path
from typing import Annotated

import typer

from rotaline.cli.base import INCOMPLETE, Json, Quiet, app


@app.command()
def reproduce(
    out: Annotated[Path, typer.Option("--out", help="Where sessions, stages and the report go.")] = Path(
        "rotaline-reproduction"
    ),
    quick: Annotated[
        bool, typer.Option("--quick", help="Smaller images and fewer frames: a few minutes instead of half an hour.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of poses, mounts and noise.")] = 1,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """The article's experiments with a rendered rig: its tables and figures beside ours, and what limits the method.

    Sessions and stages that are done are kept: the same command goes on where it stopped.
    """
    from rotaline.cli.commands import open_log, print_json
    from rotaline.cli.console import ConsoleObserver
    from rotaline.cli.reproduction_tables import show_reproduction
    from rotaline.io.files import make_folder, write_json
    from rotaline.io.report.reproduction import reproduction_document
    from rotaline.io.report.reproduction_page import write_reproduction
    from rotaline.pipeline.reproduce.run import reproduce as run_reproduction

    make_folder(out)
    open_log(out)
    result = run_reproduction(out, ConsoleObserver(0 if quiet else 1), quick=quick, seed=seed)
    document = reproduction_document(result)
    write_json(out / "reproduction.json", document)
    write_reproduction(result, out / "reproduction.html")
    if as_json:
        print_json(document)
    else:
        show_reproduction(result)
        typer.echo(f"Figures: {out / 'reproduction.json'}")
        typer.echo(f"Report:  {out / 'reproduction.html'}")
    if result.info.warnings:
        raise typer.Exit(INCOMPLETE)
