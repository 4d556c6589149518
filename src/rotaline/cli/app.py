"""The command ``rotaline``.

Exit codes: 0 everything asked for was done; 1 a part of it could not be done, the rest was written; 2 wrong use or bad input
(session, options, calibration file, rig); 3 the data do not allow the calibration; 4 results cannot be written; 5 a device does not do what it should; 130 interrupted.
"""

import logging
import os
import sys
from pathlib import Path

import typer

from rotaline.cli import acquire, commands, compare, devices, diagnose, options_help, pack, reproduce, simulate, verify  # noqa: F401  (the commands register themselves)
from rotaline.cli.base import BAD_INPUT, INCOMPLETE, INTERRUPTED, NO_DEVICE, NOT_POSSIBLE, NOT_WRITTEN, OK, app
from rotaline.errors import (
    CalibrationError,
    DetectionError,
    DeviceError,
    GeometryError,
    MeasurementError,
    OutputError,
    RigError,
    RotalineError,
    SessionError,
)

# Frames are worked on side by side; threads inside one small matrix product only get in each other's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code, never a stack trace for what a user can mend."""
    logging.getLogger("rotaline").addHandler(logging.NullHandler())
    try:
        code = app(args=argv, standalone_mode=False)
        if code == INTERRUPTED:  # typer turns KeyboardInterrupt into this
            raise KeyboardInterrupt
        return code if isinstance(code, int) else OK
    except (typer.Exit, SystemExit) as done:
        code = getattr(done, "exit_code", getattr(done, "code", 0))
        return int(code or 0)
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted. What was finished is kept; start the same command again to go on.", INTERRUPTED)
    except OutputError as error:
        return _fail(str(error), NOT_WRITTEN)
    except (SessionError, RigError) as error:
        return _fail(str(error), BAD_INPUT)
    except (CalibrationError, DetectionError, GeometryError, MeasurementError) as error:
        return _fail(str(error), NOT_POSSIBLE)
    except DeviceError as error:
        return _fail(str(error), NO_DEVICE)
    except RotalineError as error:
        return _fail(str(error), INCOMPLETE)
    except OSError as error:
        from rotaline.io.files import output_error

        return _fail(str(output_error(Path(str(error.filename or "results")), error)), NOT_WRITTEN)
    except Exception as error:
        if type(error).__module__.startswith(("click", "typer")):
            message = getattr(error, "format_message", lambda: str(error))()
            if type(error).__name__ == "NoArgsIsHelpError":  # the message is the help
                print(message, file=sys.stderr)
                return BAD_INPUT
            return _fail(
                f"{message.rstrip('.')}{'' if message.endswith('?') else '.'} See `rotaline --help`.", BAD_INPUT
            )
        logging.getLogger("rotaline").exception("unexpected error")
        return _fail(
            f"unexpected error ({type(error).__name__}: {error}). This is a defect of the program: please report it "
            "with the results folder's log.txt.",
            INCOMPLETE,
        )
    finally:
        _close_log()


def _fail(message: str, code: int) -> int:
    lines = message.splitlines() or [""]
    print("\n".join(["rotaline: " + lines[0], *("          " + line for line in lines[1:])]), file=sys.stderr)
    logging.getLogger("rotaline").error("%s", message)
    return code


def _close_log() -> None:
    log = logging.getLogger("rotaline")
    for handler in list(log.handlers):
        log.removeHandler(handler)
        handler.close()


def entry() -> None:
    """The console script."""
    raise SystemExit(main())
