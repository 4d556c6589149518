"""The commands that turn a session into one container and back."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rotaline.cli.base import INCOMPLETE, INTERRUPTED, Quiet, Session, app

if TYPE_CHECKING:
    from collections.abc import Callable

    from rotaline.pipeline.observer import Observer
    from rotaline.pipeline.pack import PackResult

Replace = Annotated[bool, typer.Option("--force", help="Replace what an earlier call wrote there.")]


@app.command()
def pack(
    session: Session,
    out: Annotated[
        Path | None,
        typer.Argument(metavar="OUT", help="Where; default: <session>.rotaline.zarr beside the session."),
    ] = None,
    force: Replace = False,
    quiet: Quiet = False,
) -> None:
    """Write a session into one lossless container, which every command reads like a folder, faster, and from object storage.

    The session stays as it is. Frames that cannot be read are left out; then the exit code is 1.
    """
    from rotaline.pipeline.pack import pack_session

    _finish(lambda observer: pack_session(session, out, observer, force), quiet)


@app.command()
def unpack(
    packed: Annotated[str, typer.Argument(metavar="PACKED", help="A packed session, or the address of one.")],
    out: Annotated[
        Path | None,
        typer.Argument(
            metavar="OUT", help="Where; default: the name without .rotaline.zarr, beside the packed session."
        ),
    ] = None,
    force: Replace = False,
    quiet: Quiet = False,
) -> None:
    """Write a packed session as a folder again: the same pixels, session.toml and frames.csv.

    All images come back as PNG. Those that were JPEG, BMP or TIFF get the suffix .png, in frames.csv too.
    """
    from rotaline.pipeline.pack import unpack_session

    _finish(lambda observer: unpack_session(packed, out, observer, force), quiet)


def _finish(work: "Callable[[Observer], PackResult]", quiet: bool) -> None:
    from rotaline.cli.console import ConsoleObserver

    try:
        result = work(ConsoleObserver(0 if quiet else 1))
    except KeyboardInterrupt:
        typer.echo("rotaline: interrupted. Nothing was written.", err=True)
        raise typer.Exit(INTERRUPTED) from None
    typer.echo(f"{result.folder}: {result.n_images} images, {result.n_bytes / 1e6:.1f} MB")
    if result.n_renamed:
        typer.echo(f"Have the suffix .png now, in frames.csv too: {result.n_renamed}")
    if result.n_left_out:
        typer.echo(f"Left out, because they cannot be read: {result.n_left_out}")
        raise typer.Exit(INCOMPLETE)
