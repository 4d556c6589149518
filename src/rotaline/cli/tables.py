"""Tables of the verification commands."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from rotaline.pipeline.compare_truth import VOLUME_HEIGHT_MM, VOLUME_RADIUS_MM, Comparison
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


def show_comparison(comparison: Comparison) -> None:
    """Errors of a calibration and of measured sizes against the truth of a rendered session."""
    console = Console(width=120, highlight=False)
    errors = comparison.calibration
    table = Table(
        title="Calibration less truth (plane and axes after the best rotation of the camera frame)",
        title_justify="left",
    )
    table.add_column("quantity")
    table.add_column("error", justify="right")
    volume = f"within {VOLUME_RADIUS_MM:g} mm of the axis, up to {VOLUME_HEIGHT_MM:g} mm above the table"
    rows: tuple[tuple[str, float | None, str], ...] = (
        ("focal length fx / px", errors.fx_px, "+.3f"),
        ("focal length fy / px", errors.fy_px, "+.3f"),
        ("principal point cx / px", errors.cx_px, "+.3f"),
        ("principal point cy / px", errors.cy_px, "+.3f"),
        ("viewing rays after the best rotation, RMS / px", errors.rays_px, ".4f"),
        (f"laser plane, RMS / mm, {volume}", errors.plane_rms_mm, ".5f"),
        ("laser plane, largest there / mm", errors.plane_max_mm, ".5f"),
        ("laser plane, angle / µrad", errors.plane_urad, ".1f"),
        ("rotation axis, initial, at the table / mm", errors.initial_axis_low_mm, ".5f"),
        (f"rotation axis, initial, {VOLUME_HEIGHT_MM:g} mm above / mm", errors.initial_axis_high_mm, ".5f"),
        ("rotation axis, initial, angle / µrad", errors.initial_axis_urad, ".1f"),
        ("rotation axis, at the table / mm", errors.axis_low_mm, ".5f"),
        (f"rotation axis, {VOLUME_HEIGHT_MM:g} mm above / mm", errors.axis_high_mm, ".5f"),
        ("rotation axis, angle / µrad", errors.axis_urad, ".1f"),
    )
    for name, value, digits in rows:
        table.add_row(name, "–" if value is None else format(value, digits))
    sense = {True: "right", False: "wrong", None: "–"}[errors.sense_right]
    table.add_row("sense of rotation", sense)
    console.print(table)
    if comparison.sizes:
        table = Table(title="Measured sizes less true sizes, mm", title_justify="left")
        for name, justify in (("capture", "left"), ("quantity", "left")):
            table.add_column(name, justify=justify)  # type: ignore[arg-type]
        for name in ("true", "measured", "error", "stated u", "error with the initial axis"):
            table.add_column(name, justify="right")
        for size in comparison.sizes:
            table.add_row(
                size.capture,
                size.quantity.replace("_", " "),
                f"{size.true:.4f}",
                f"{size.value:.4f}",
                f"{size.error:+.4f}",
                "–" if size.uncertainty is None else f"{size.uncertainty:.4f}",
                "–" if size.initial is None else f"{size.initial - size.true:+.4f}",
            )
        console.print(table)
    show_provenance(console)
