"""A small rendered session, calibrated once; copies of it for each test; and the command line as a function.

Stages whose inputs did not change are taken from the results that are copied along, so that a test pays only for what it breaks.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from rotaline.cli.app import main
from rotaline.io.report.page import Picture
from rotaline.io.report.sections import artifact, axis, camera, joint, laser_plane, overlays, parts, session
from rotaline.simulation.rig import build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan


@dataclass(frozen=True)
class Outcome:
    """What a command left: exit code and texts; line breaks of the terminal are blanks."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Workplace:
    """A session that may be broken, and the results of its calibration before it was."""

    session: Path
    results: Path

    def edit(self, file: str, old: str, new: str) -> None:
        """Replace a text, which must be there, in a file of the session."""
        path = self.session / file
        text = path.read_text()
        assert old in text, f"'{old}' is not in {path}"
        path.write_text(text.replace(old, new))


def _state(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def call(capsys):
    """Run a command in this process; whatever happens, the session stays as it is and no stack trace is shown."""

    def run(*args: str | os.PathLike[str]) -> Outcome:
        folders = [Path(a) for a in args if (Path(a) / "session.toml").is_file()]
        before = [_state(folder) for folder in folders]
        capsys.readouterr()
        code = main([str(a) for a in args])
        captured = capsys.readouterr()
        outcome = Outcome(code, captured.out, " ".join(captured.err.split()))
        assert "Traceback" not in captured.err + captured.out
        assert "defect" not in outcome.err, outcome.err
        assert [_state(folder) for folder in folders] == before, "a command wrote into the session"
        return outcome

    return run


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory):
    """A session of a small rig and the results of ``rotaline calibrate`` on it; not to be changed."""
    folder = tmp_path_factory.mktemp("e2e")
    rig = build_rig((320, 240))
    write_session(folder / "session", rig, small_plan(rig, captures=("camera", "laser", "axis", "ball")))
    assert main(["calibrate", str(folder / "session"), "--quiet"]) == 0
    return Workplace(folder / "session", folder / "session-results")


@pytest.fixture
def fresh(calibrated, tmp_path):
    """A copy of the session without results."""
    shutil.copytree(calibrated.session, tmp_path / "session")
    return Workplace(tmp_path / "session", tmp_path / "session-results")


@pytest.fixture
def place(calibrated, fresh):
    """A copy of the session with the results of its calibration."""
    shutil.copytree(calibrated.results, fresh.results)
    return fresh


@pytest.fixture
def without_pictures(monkeypatch):
    """Reports with everything but their pictures, which take most of the time of a run: for tests that look at other results."""

    def blank(draw, caption, width="full", form="svg"):
        return Picture("data:,", caption, width)

    for section in (artifact, axis, camera, joint, laser_plane, overlays, parts, session):
        monkeypatch.setattr(section, "picture", blank)
