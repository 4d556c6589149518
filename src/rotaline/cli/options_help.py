"""The command that prints all options of all stages."""

from pathlib import Path
from typing import Annotated

import typer

from rotaline.cli.app import app

OPTIONS_HINT = (
    "Options of the stages (targets, camera, stripe, laser_plane, cross_ratio, axis, artifact, scan, measure, surface) are given "
    "with --option STAGE.NAME=VALUE or in a TOML file with --options FILE. `rotaline options` lists all of them with their "
    "defaults and meaning, in the form of that file."
)


@app.command("options")
def print_options(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="Write to this file instead of printing.")
    ] = None,
) -> None:
    """Every option of every stage with its default and meaning, as the TOML file that --options reads."""
    from rotaline.io.files import whole_file
    from rotaline.pipeline.options import options_toml

    text = options_toml()
    if file is None:
        typer.echo(text, nl=False)
        return
    with whole_file(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
    typer.echo(str(file))
