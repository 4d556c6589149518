"""The command ``simulate``: render the session of a rig that a file describes."""

from pathlib import Path
from typing import Annotated

import typer

from rotaline.cli.base import Quiet, app
from rotaline.errors import RigError


@app.command()
def simulate(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RIG.toml] OUT", help="The rig file (or --preset), and the folder to be written."),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option("--preset", metavar="NAME", help="article, webcam, high-resolution or demo, instead of a file."),
    ] = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the preset as a rig file, to be edited; render nothing.")
    ] = False,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Of noise and drawn poses, instead of the file's.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A first look: half the pixels along each side, half the frames.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Render what a rig would record: a session, and beside it OUT.truth.json with all that is true of it.

    The rig file states camera, laser, turntable, their errors, targets, parts and captures. To begin with:
    `rotaline simulate --preset article --toml > rig.toml`. A rendering that was interrupted goes on where it stopped.
    """
    from rotaline.cli.console import ConsoleObserver
    from rotaline.io.rig_file import preset_text, quick_look, read_preset, read_rig_file
    from rotaline.pipeline.run import results_folder
    from rotaline.pipeline.simulate import simulate as render
    from rotaline.simulation.truth import truth_path

    given = list(paths or ())
    if toml:
        if preset is None or given:
            raise RigError("--toml prints a preset: `rotaline simulate --preset article --toml`.")
        typer.echo(preset_text(preset), nl=False)
        return
    if len(given) != (1 if preset is not None else 2):
        raise RigError(
            "expected `rotaline simulate RIG.toml OUT` or `rotaline simulate --preset NAME OUT`, "
            f"found {len(given)} path{'' if len(given) == 1 else 's'}{'' if preset is None else ' and a preset'}."
        )
    out = given[-1]
    file = read_preset(preset) if preset is not None else read_rig_file(given[0])
    if quick:
        file = quick_look(file)
    render(file, out, ConsoleObserver(0 if quiet else 1), seed=seed, quick=quick)
    typer.echo(f"Session: {out}")
    typer.echo(f"Truth:   {truth_path(out)}")
    typer.echo(f"Next:    rotaline run {out}")
    typer.echo(f"then:    rotaline compare {results_folder(out, None)}")
