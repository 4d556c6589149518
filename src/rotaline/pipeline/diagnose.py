"""Is a calibration good? The verdict on a session, or the one that stands in a folder of results."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from rotaline.calibration.verdict.model import STEPS, Finding, StepVerdict, Verdict
from rotaline.errors import SessionError
from rotaline.io.session import Problem, inspect_session
from rotaline.io.session_access import is_session
from rotaline.io.session_file import SESSION_FILE
from rotaline.io.verdict_file import VERDICT_FILE, read_verdict
from rotaline.pipeline.run import Run

UNREADABLE_SESSION = "session cannot be read"
MOST_SHOWN = 5


def diagnose(folder: str | os.PathLike[str], start: Callable[[], Run]) -> Verdict:
    """The verdict on a session, which is calibrated for it, or the stored one of a folder of results.

    Parameters
    ----------
    folder : a session or results of ``rotaline run``, ``calibrate`` or ``diagnose``
    start : makes the run over the session

    Raises
    ------
    SessionError
        If the folder is neither a session nor holds a verdict.
    """
    if not is_session(folder):
        return _stored(Path(folder))
    session, problems = inspect_session(folder)
    if session is None:
        return unreadable_session([p for p in problems if p.fatal])
    run = start()
    run.calibrate()
    assert run.verdict is not None
    return run.verdict


def unreadable_session(problems: Sequence[Problem]) -> Verdict:
    """The verdict on a session in which something must be mended before anything can be calibrated."""
    n = len(problems)
    text = f"The session cannot be calibrated: {n} {'thing' if n == 1 else 'things'} must be mended first."
    found = " ".join(str(p) for p in problems[:MOST_SHOWN]) + (f" And {n - MOST_SHOWN} more." if n > MOST_SHOWN else "")
    steps = (
        StepVerdict("session", "fail", "The session cannot be read as it is."),
        *(StepVerdict(step, "none", "Not looked at.") for step in STEPS if step != "session"),
    )
    action = "Mend the session and start again; `rotaline check` lists all that is wrong without calibrating."
    finding = Finding(UNREADABLE_SESSION, "session", "fail", found, action, float("nan"))
    return Verdict("fail", text, steps, (finding,), float("nan"), float("nan"))


def _stored(folder: Path) -> Verdict:
    if not folder.is_dir():
        found = "this is a file" if folder.exists() else "there is no such folder"
        raise SessionError(
            f"{folder}: {found}. Expected a session (a folder with {SESSION_FILE}) or the results of `rotaline run`."
        )
    if (folder / VERDICT_FILE).is_file():
        return read_verdict(folder / VERDICT_FILE)
    if (folder / "calibration.json").is_file():
        raise SessionError(
            f"{folder}: there is no {VERDICT_FILE} here: these results were made with a calibration from elsewhere, or by an older "
            "version of this program. Diagnose the session itself: rotaline diagnose SESSION."
        )
    raise SessionError(
        f"{folder}: expected a session (a folder with {SESSION_FILE}) or the results of `rotaline run` (a folder with {VERDICT_FILE}); "
        "it is neither."
    )
