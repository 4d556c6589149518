"""Tables of the verification commands."""

from rich.console import Console
from rich.table import Table

from rotaline.pipeline.summary import machine, versions
from rotaline.pipeline.verify_axis import ARTICLE_MEAN_DISTANCE_MM, AxisVerification


def show_axis_verification(verification: AxisVerification) -> None:
    """Table 1 of the article with the mean distances before and after."""
    console = Console(width=150, highlight=False)
    table = Table(
        title="Simulation of section 5.4: mean distance of the feature points from the ideal circles, mm",
        title_justify="left",
    )
    for name in (
        "",
        "change of Pa / mm",
        "change of Pb / mm",
        "before",
        "after, SQP",
        "iterations",
        "after, least squares",
        "iterations",
    ):
        table.add_column(name, justify="right")
    for case in verification.cases:
        table.add_row(
            case.name,
            ", ".join(f"{v:+.1f}" for v in case.delta_pa_mm),
            ", ".join(f"{v:+.1f}" for v in case.delta_pb_mm),
            f"{case.mean_distance_before_mm:.3f}",
            f"{case.sqp_mean_distance_mm:.3e}",
            str(case.sqp_iterations),
            f"{case.least_squares_mean_distance_mm:.3e}",
            str(case.least_squares_iterations),
        )
    console.print(table)
    console.print(f"Article: 0.08 to 0.40 mm before, {ARTICLE_MEAN_DISTANCE_MM:.3e} mm after, for all five.")
    show_provenance(console)


def show_provenance(console: Console) -> None:
    """The machine and the versions that the numbers above come from."""
    text = ", ".join(f"{name} {version}" for name, version in versions().items())
    console.print(f"{machine()}; {text}", style="dim")
