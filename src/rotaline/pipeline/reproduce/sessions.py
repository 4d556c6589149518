"""Rendering the experiments' sessions, those that are not there yet, and reading them as one."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rotaline.io.files import output_error, whole_file
from rotaline.io.session import Session, read_session
from rotaline.pipeline.observer import Observer
from rotaline.simulation.plan import SessionPlan
from rotaline.simulation.rig import Rig
from rotaline.simulation.session import fingerprint, write_session
from rotaline.simulation.truth import truth_path


def render_session(folder: Path, name: str, rig: Rig, plan: SessionPlan, observer: Observer) -> Session:
    """The session ``folder/name``, rendered unless it is there already, from the same rig and plan by the same renderer.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    path, key_file = folder / name, folder / f"{name}.key"
    wanted = fingerprint(rig, plan)
    stored = path.is_dir() and key_file.is_file() and key_file.read_text(encoding="utf-8") == wanted
    observer.stage(f"Rendering {name}", stored)
    if not stored:
        _remove(path)
        with observer.work("frames", plan.n_frames) as count:
            write_session(path, rig, plan, count)
        with whole_file(key_file) as temporary:
            temporary.write_text(wanted, encoding="utf-8")
    return read_session(path)


def _remove(path: Path) -> None:
    try:
        if path.is_dir():
            shutil.rmtree(path)
        truth_path(path).unlink(missing_ok=True)
    except OSError as error:
        raise output_error(path, error) from error


def joined(sessions: Mapping[str, Session]) -> Session:
    """All captures of several sessions of one rig as one session.

    Raises
    ------
    ValueError
        If two sessions use the same name for a capture.
    """
    first = next(iter(sessions.values()))
    captures = tuple(capture for session in sessions.values() for capture in session.captures)
    names = [capture.folder for capture in captures]
    if len(set(names)) < len(names):
        raise ValueError(f"Captures of the same name in several sessions: {', '.join(sorted(names))}.")
    targets = {name: target for session in sessions.values() for name, target in session.targets.items()}
    return replace(first, targets=targets, captures=captures, measurements=())
