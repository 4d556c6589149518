"""The commands ``devices`` and ``rig check``: what is connected, and whether it works."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rotaline.cli.base import INCOMPLETE, NO_DEVICE, OK, Json, app

if TYPE_CHECKING:
    from rotaline.io.rig_check_file import CheckLine, RigCheck
    from rotaline.pipeline.connected import Looked

rig = typer.Typer(
    help="Work with a live rig: camera, laser and turntable.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(rig, name="rig")

_STYLES = {"ok": "green", "doubtful": "yellow", "fails": "bold red"}


@app.command()
def devices(
    toml: Annotated[
        str | None,
        typer.Option(
            "--toml", metavar="DRIVER", help="Print a rig.toml to begin with: simulated, or the keys of another driver."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Which cameras, turntables and lasers are connected, and what to write into rig.toml for them.

    Drivers whose library is not installed say how to install it. Nothing is moved, switched or set.
    """
    from rotaline.io.device_file import driver_lines

    if toml is not None:
        typer.echo(driver_lines(toml), nl=False)
        return
    from rotaline.pipeline.connected import all_drivers, look

    answers = look(all_drivers())
    if as_json:
        from rotaline.cli.commands import print_json

        print_json(_document(answers))
    else:
        _show(answers)


def _document(answers: "tuple[Looked, ...]") -> dict[str, Any]:
    from rotaline.io.device_file import lines_of

    return {
        "devices": [
            {"kind": d.kind, "driver": d.driver, "name": d.name, "toml": lines_of(d)} for a in answers for d in a.found
        ],
        "problems": [{"kind": a.kind, "driver": a.driver, "problem": a.problem} for a in answers if a.problem],
    }


def _show(answers: "tuple[Looked, ...]") -> None:
    from rich.console import Console

    from rotaline.io.device_file import lines_of

    console = Console(highlight=False, soft_wrap=True)
    for kind in dict.fromkeys(a.kind for a in answers):
        console.print(f"{kind.capitalize()}s", style="bold")
        some = [a for a in answers if a.kind == kind]
        for device in [d for a in some for d in a.found]:
            console.print(f"  {device.driver}: {device.name}", markup=False)
            for line in lines_of(device).splitlines():
                console.print(f"      {line}", style="cyan", markup=False)
        none = [a.driver for a in some if not a.found and not a.problem]
        if none:
            console.print(f"  {', '.join(none)}: nothing found", style="dim", markup=False)
        for answer in [a for a in some if a.problem]:
            text = answer.problem.removeprefix(f"{answer.driver}: ")
            console.print(f"  {answer.driver}: {text}", style="yellow", markup=False)
        console.print()
    console.print(
        "Write one camera, and a turntable and a laser if there are, into rig.toml (below `version = 1`), then: rotaline rig check rig.toml\n"
        "A table that you turn, a laser that you switch by hand: rotaline devices --toml manual. A recorded session: --toml replay.",
        markup=False,
    )


@rig.command("check")
def rig_check(
    file: Annotated[Path, typer.Argument(metavar="RIG.toml", help="The devices.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Where check.json and check.png go; default: <rig>-check beside the rig file."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Test a rig: frames, focus, laser on against off, a small move and back, delays; and say what to mend.

    Place something with a pattern on the table (a target plate), where the laser's line meets it. The table is homed and moves by a few
    degrees, the laser goes on for some seconds. Exit code 0: all is well, 1: something is doubtful or fails, 5: a device reports an error.
    """
    from rich.console import Console

    from rotaline.cli.acquire import ending_in_order
    from rotaline.cli.person import ask
    from rotaline.io.device_file import read_device_file
    from rotaline.io.files import make_folder
    from rotaline.io.rig_check_file import check_document, write_rig_check
    from rotaline.pipeline.devices import open_devices
    from rotaline.pipeline.rig_check.check import check_rig

    devices_file = read_device_file(file)
    folder = out if out is not None else file.with_name(f"{file.stem}-check")
    console = Console(stderr=as_json, highlight=False)
    with ending_in_order(), open_devices(devices_file, None if as_json else ask).rig as opened:
        make_folder(folder)  # a place that cannot be used is refused before the check, not after it
        found = check_rig(opened, lambda heard: _say(console, heard))
    write_rig_check(found, folder)
    if as_json:
        from rotaline.cli.commands import print_json

        print_json(check_document(found))
    else:
        _conclude(console, found, folder)
    raise typer.Exit(NO_DEVICE if found.broken else OK if found.level == "ok" else INCOMPLETE)


def _say(console: Any, heard: "CheckLine | str") -> None:
    """One line as it is found; what to mend stands below it."""
    from rich.padding import Padding
    from rich.text import Text

    if isinstance(heard, str):
        console.print(Text(heard, style="italic"))
        return
    console.print(Text.assemble((f"{heard.level:<9}", _STYLES[heard.level]), (f"{heard.device}, {heard.name}", "bold")))
    console.print(Padding(Text(heard.text), (0, 0, 0, 9)))
    if heard.mend:
        console.print(Padding(Text(f"-> {heard.mend}", style=_STYLES[heard.level]), (0, 0, 0, 9)))


def _conclude(console: Any, found: "RigCheck", folder: Path) -> None:
    from rich.text import Text

    n = {level: sum(line.level == level for line in found.lines) for level in _STYLES}
    console.print()
    console.print(
        Text(f"{n['ok']} ok, {n['doubtful']} doubtful, {n['fails']} fail", style=f"bold {_STYLES[found.level]}")
    )
    if found.recommended:
        values = ", ".join(f"{name} = {value:g}" for name, value in found.recommended.items())
        console.print(Text(f"For the plan: {values}"))
    console.print(Text(f"Written: {folder / 'check.json'}, {folder / 'check.png'}"), soft_wrap=True)
