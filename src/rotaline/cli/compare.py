"""The command that holds results of a rendered session against its truth."""

from pathlib import Path
from typing import Annotated

import typer

from rotaline.cli.base import Json, app


@app.command("compare")
def compare_command(
    results: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of a session that was rendered.")],
    truth: Annotated[
        Path | None, typer.Option("--truth", help="The session's truth; default: <session>.truth.json beside it.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Results of a rendered session against its truth: errors of camera, laser plane, rotation axis and measured sizes."""
    import dataclasses

    from rotaline.cli.commands import print_json
    from rotaline.cli.tables import show_comparison
    from rotaline.pipeline.compare_truth import compare_with_truth, truth_beside

    comparison = compare_with_truth(results, truth if truth is not None else truth_beside(results))
    if as_json:
        print_json(dataclasses.asdict(comparison))
    else:
        show_comparison(comparison)
