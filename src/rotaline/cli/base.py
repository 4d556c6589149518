"""The application that the commands register with, its exit codes, and the options that several commands share."""

from pathlib import Path
from typing import Annotated, Literal

import typer

OK, INCOMPLETE, BAD_INPUT, NOT_POSSIBLE, NOT_WRITTEN, NO_DEVICE, INTERRUPTED = 0, 1, 2, 3, 4, 5, 130

EXIT_CODES = """\b
Exit codes:
  0    everything asked for was done
  1    a part could not be done (a feature not found, a frame missing); the rest was written
  2    wrong use or bad input: session, options, calibration file, rig
  3    the data do not allow the calibration; the message says what to add
  4    results cannot be written: no space, no permission
  5    a device is not there, or does not do what it should; frames that were taken are kept
  130  interrupted; the same command goes on where it stopped
"""

app = typer.Typer(
    name="rotaline",
    help="Measure parts with a camera, a laser line and a turntable.\n\n"
    "A session is a folder of images with a session.toml. Start with `rotaline check SESSION`, then `rotaline run SESSION`. "
    "Without a rig, try `rotaline demo`.\n\n" + EXIT_CODES,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Session = Annotated[
    str,
    typer.Argument(
        metavar="SESSION",
        help="Folder with session.toml and folders of images, a packed session, or the address of one (s3://bucket/session, ...).",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out", help="Where results go; default: <session>-results beside the session, here for one at an address."
    ),
]
OptionsFile = Annotated[
    Path | None, typer.Option("--options", help="TOML file with options of the stages; `rotaline options` prints one.")
]
Setting = Annotated[
    list[str] | None,
    typer.Option(
        "--option", metavar="STAGE.NAME=VALUE", help="One option, for example stripe.method=steger; repeatable."
    ),
]
Method = Annotated[
    Literal["joint", "article"] | None,
    typer.Option(
        "--method",
        help="How to calibrate: joint (default), one estimate from all observations; article, one refinement after the other, with "
        "the options of the article as defaults.",
        show_default=False,
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Do every stage again, also those that did not change.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output, for programs.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings, errors and the result only.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Show the log as well.")]
CalibrationOption = Annotated[
    Path | None,
    typer.Option("--calibration", help="Use this calibration.json instead of calibrating from the session."),
]
