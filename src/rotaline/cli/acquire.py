"""The command ``acquire``: take a session with a live rig."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from rotaline.cli.base import Quiet, app
from rotaline.errors import RigError


@app.command()
def acquire(
    paths: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RIG.toml [PLAN.toml] OUT", help="The devices, the plan (or --plan), the session folder."
        ),
    ] = None,
    plan: Annotated[str | None, typer.Option("--plan", metavar="NAME", help="article, instead of a file.")] = None,
    toml: Annotated[bool, typer.Option("--toml", help="Print the plan as a file, to be edited; take nothing.")] = False,
    quiet: Quiet = False,
) -> None:
    """Take a session: camera, laser and turntable driven together, as a plan says.

    The plan states captures: role, target, angles or poses, exposures. To begin with: `rotaline acquire --plan article --toml > plan.toml`.
    Poses that you place are guided on the screen. What ends it (Ctrl-C, an error, a power cut): frames that were taken are kept, and the same
    command goes on with the first that is missing.
    """
    from rotaline.cli.acquisition_screen import AcquisitionScreen, summary
    from rotaline.cli.person import TerminalPerson
    from rotaline.io.acquired_session import AcquiredSession
    from rotaline.io.device_file import read_device_file
    from rotaline.io.plan_file import plan_text, read_plan
    from rotaline.pipeline.acquire.acquire import acquire as take
    from rotaline.pipeline.acquire.guidance import lit_preview
    from rotaline.pipeline.devices import open_devices

    given = list(paths or ())
    if toml:
        if plan is None or given:
            raise RigError("--toml prints a plan: `rotaline acquire --plan article --toml`.")
        typer.echo(plan_text(plan), nl=False)
        return
    if len(given) != (2 if plan is not None else 3):
        raise RigError(
            "expected `rotaline acquire RIG.toml PLAN.toml OUT` or `rotaline acquire --plan article RIG.toml OUT`, "
            f"found {len(given)} path{'' if len(given) == 1 else 's'}{'' if plan is None else ' and a plan'}."
        )
    file, out = read_device_file(Path(given[0])), Path(given[-1])
    wanted = read_plan(plan if plan is not None else given[1])
    screen, began_s = AcquisitionScreen(0 if quiet else 1), time.monotonic()
    AcquiredSession(
        out, wanted.text, file.text
    ).close()  # a place that cannot be used is refused before a device is opened
    with ending_in_order():
        opened = open_devices(file, screen.ask)
        with opened.rig as rig:
            person = opened.person or TerminalPerson(wanted.tables, out, screen, lit_preview(rig))
            result = take(wanted, file.text, rig, out, person, screen, screen.watch)
    screen.console.print(summary(result, wanted.tables, time.monotonic() - began_s))
    typer.echo(f"Session: {result.path}")
    typer.echo(f"Next:    rotaline run {result.path}")


@contextmanager
def ending_in_order() -> Iterator[None]:
    """SIGTERM and a closed terminal end the block as Ctrl-C does: the laser goes off, the table stands.

    What the program was started to ignore (a closed terminal, under nohup) it goes on ignoring.
    """

    def end(number: int, _: Any) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    known = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    names = [name for name in known if signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN]
    before = {name: signal.signal(getattr(signal, name), end) for name in names}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)
