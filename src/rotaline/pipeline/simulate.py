"""Rendering the session that a rig file describes: checks first, then frames that are not there yet."""

from pathlib import Path

from rotaline.io.rig_file import RigFile
from rotaline.pipeline.observer import Observer
from rotaline.simulation.checks import require_rig, require_scene
from rotaline.simulation.session import unfinished, write_session


def simulate(file: RigFile, out: Path, observer: Observer, *, seed: int | None = None, quick: bool = False) -> None:
    """Render a session into ``out`` and its truth beside it; go on where an interrupted rendering stopped.

    Parameters
    ----------
    file : RigFile
    out : Path   the session's folder; must not exist yet
    observer : Observer   hears of warnings about the scene, and of each frame
    seed : int or None   of noise and drawn poses; None: the file's
    quick : bool   whether the file is a :func:`rotaline.io.rig_file.quick_look`; goes into the truth

    Raises
    ------
    RigError
        If the rig cannot be, or a capture cannot show what it should.
    OutputError
        If the folder exists, or cannot be written.
    """
    rig = file.rig()
    file.named(lambda: require_rig(rig))
    plan = file.plan(seed)
    left = unfinished(out, rig, plan)
    shapes = {id(placed.shape): placed.shape for c in plan.captures for placed in c.shots[0].on_table}
    for note in (note for shape in shapes.values() for note in getattr(shape, "notes", ())):
        observer.warning(note)
    for problem in file.named(lambda: require_scene(rig, plan)):
        observer.warning(str(problem))
    observer.stage(f"Rendering {plan.n_frames} frames into {out}", stored=False)
    if left is not None:
        observer.note(
            f"{left.n_frames} frames are there already."
            if left.same
            else "The unfinished session there is of another rig, seed or version of the program; it is rendered anew."
        )
    with observer.work("frames", plan.n_frames) as count:
        write_session(out, rig, plan, count, notes={"source": file.source, "quick": quick, "rig_file": file.text})
