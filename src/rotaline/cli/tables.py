"""Tables of the verification commands."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from rotaline.pipeline.summary import machine, versions
from rotaline.pipeline.verify_axis import ARTICLE_MEAN_DISTANCE_MM, AxisVerification
from rotaline.pipeline.verify_stripe import StripeVerificationRow


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


def show_stripe_verification(rows: Sequence[StripeVerificationRow]) -> None:
    """RMS, bias and stated uncertainty of each method on each case, beside the Cramér-Rao bound."""
    console = Console(width=150, highlight=False)
    table = Table(
        title="Stripe centres on synthetic stripes: distance from the truth along the normal, px", title_justify="left"
    )
    for name, justify in (("case", "left"), ("method", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for name in ("bound", "RMS", "bias", "largest", "stated / scatter", "found", "points"):
        table.add_column(name, justify="right")
    case = ""
    for row in rows:
        if row.case != case and case:
            table.add_section()
        table.add_row(
            row.case if row.case != case else "",
            row.method,
            _number(row.bound_px),
            _number(row.rms_px),
            _number(row.bias_px),
            _number(row.largest_px),
            _number(row.stated_over_scatter, 2),
            f"{100 * row.found_fraction:.1f} %",
            str(row.n_points),
        )
        case = row.case
    console.print(table)
    console.print(
        "bound: Cramér-Rao bound of one centre from one pixel of stripe length, noise alone. A method that averages along the stripe "
        "can be below it. stated / scatter: stated standard uncertainty over the observed scatter."
    )
    show_provenance(console)


def _number(value: float, digits: int = 4) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
