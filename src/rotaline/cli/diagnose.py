"""The command that says whether a calibration is good, which step spoils it, and what to do."""

from typing import TYPE_CHECKING, Annotated

import typer

from rotaline.cli.base import (
    INCOMPLETE,
    NOT_POSSIBLE,
    OK,
    Force,
    Json,
    Method,
    OptionsFile,
    Out,
    Quiet,
    Setting,
    Verbose,
    app,
)
from rotaline.cli.options_help import StageCommand

if TYPE_CHECKING:
    from rotaline.pipeline.run import Run

EXIT_CODES = {"pass": OK, "doubtful": INCOMPLETE, "fail": NOT_POSSIBLE, "none": NOT_POSSIBLE}


@app.command("diagnose", cls=StageCommand)
def diagnose_command(
    folder: Annotated[
        str, typer.Argument(metavar="DIR", help="A session, or the results of `rotaline run` or `rotaline calibrate`.")
    ],
    out: Out = None,
    options: OptionsFile = None,
    option: Setting = None,
    method: Method = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Is the calibration good? Pass, doubtful or fail for each step, what spoils it, and what to do, most useful first.

    A session is calibrated for it (stages that did not change are taken from its results); of a folder of results the stored verdict
    is shown. Exit code 0: pass, 1: doubtful, 3: fail.
    """
    from rotaline.cli.commands import open_run, print_json
    from rotaline.cli.console import show_verdict
    from rotaline.io.verdict_file import verdict_document
    from rotaline.pipeline.diagnose import diagnose

    def start() -> "Run":
        return open_run(folder, out, options, option, method, force, quiet or as_json, verbose)

    verdict = diagnose(folder, start)
    if as_json:
        print_json(verdict_document(verdict))
    else:
        show_verdict(verdict)
    raise typer.Exit(EXIT_CODES[verdict.level])
