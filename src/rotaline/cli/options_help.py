"""The command that prints all options of all stages."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from rotaline.cli.base import Method, app


class StageCommand(TyperCommand):
    """A command whose help ends with every option of every stage."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the options of the stages; they are read only when the help is asked for."""
        from rotaline.pipeline.options import option_entries

        with formatter.section("Options of the stages"):
            formatter.write_text(
                "Given with --option STAGE.NAME=VALUE, or in a TOML file with --options FILE; `rotaline options` prints that file."
            )
            formatter.write_paragraph()
            formatter.write_dl(
                [(f"{e.stage}.{e.name}", f"{e.help} ({e.kind}; default: {e.default})") for e in option_entries()],
                col_max=34,
            )


@app.command("options")
def print_options(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="Write to this file instead of printing.")
    ] = None,
    method: Method = None,
) -> None:
    """Every option of every stage with its default and meaning, as the TOML file that --options reads."""
    from rotaline.io.files import whole_file
    from rotaline.pipeline.options import options_toml

    text = options_toml(method)
    if file is None:
        typer.echo(text, nl=False)
        return
    with whole_file(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
    typer.echo(str(file))
