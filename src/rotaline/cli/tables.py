"""Tables of the verification commands."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from rotaline.pipeline.compare_truth import VOLUME_HEIGHT_MM, VOLUME_RADIUS_MM, Comparison
from rotaline.pipeline.summary import machine, versions
from rotaline.pipeline.verify_axis import ARTICLE_MEAN_DISTANCE_MM, AxisVerification
from rotaline.pipeline.verify_efficiency import EfficiencyVerification
from rotaline.pipeline.verify_methods import MethodsVerification
from rotaline.pipeline.verify_stripe import StripeVerificationRow
from rotaline.pipeline.verify_uncertainty import POOLED_BAR, QUANTITY_BAR, UncertaintyVerification


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


def _scaled(value: float, unit: str) -> str:
    """A length in um, an angle in urad, anything else as it is; the unit is that of :func:`_small_unit`."""
    if math.isnan(value):
        return "–"
    return f"{1e6 * value:.1f}" if unit == "rad" else f"{1e3 * value:.2f}" if unit == "mm" else f"{value:.3g}"


def _small_unit(unit: str) -> str:
    return {"rad": "µrad", "mm": "µm", "1": ""}.get(unit, unit)


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{100 * value:.1f}"


def show_uncertainty(verification: UncertaintyVerification) -> None:
    """Coverage of the stated intervals, quantity by quantity."""
    console = Console(width=150, highlight=False)
    table = Table(
        title=f"Stated 95 % intervals against the truth: {verification.n_realisations} realisations of "
        f"{verification.n_sessions} sessions",
        title_justify="left",
    )
    for name in ("group", "quantity"):
        table.add_column(name)
    for name in (
        "cover / %",
        "±",
        "expected / %",
        "error / u, RMS",
        "mean",
        "from noise / %",
        "u",
        "RMS error",
        "unit",
    ):
        table.add_column(name, justify="right")
    for row in verification.rows:
        if not row.name:
            table.add_section()
        judged = row.group != "camera"
        low, high = (_percent(b).removesuffix(".0") for b in row.bar)
        table.add_row(
            row.group if not row.name else "",
            row.name.replace("_", " ") or "pooled",
            _percent(row.coverage),
            _percent(row.u_coverage),
            f"{low} to {high}{'' if row.holds else '  missed'}" if judged else "–",
            _number(row.rms_standardised, 2),
            "–" if math.isnan(row.mean_standardised) else f"{row.mean_standardised:+.2f}",
            _percent(row.noise_share),
            _scaled(row.mean_u, row.unit),
            _scaled(row.rms_error, row.unit),
            _small_unit(row.unit),
        )
    console.print(table)
    console.print(
        f"Expected: {100 * POOLED_BAR[0]:g} to {100 * POOLED_BAR[1]:g} % of all together, {100 * QUANTITY_BAR[0]:g} to "
        f"{100 * QUANTITY_BAR[1]:g} % of each; the camera is not judged. ±: standard uncertainty of the coverage, from the scatter between "
        "sessions. from noise: share of (error / u)² that changes with the noise of the detectors; the rest is common to all "
        "realisations of a session: errors of plates and table."
    )
    if verification.optional:
        chosen = ", ".join(f"{name} {n}" for name, n in verification.optional.items())
        console.print(f"Parameters that were switched on, in how many realisations: {chosen}.")
    _show_failures(console, verification.failures)


def show_efficiency(verification: EfficiencyVerification) -> None:
    """Variance of the joint estimate over the Cramér-Rao bound."""
    console = Console(width=150, highlight=False)
    table = Table(
        title="Variance of the joint estimate over the Cramér-Rao bound, ideal table and plates", title_justify="left"
    )
    for name in ("noise", "parameters"):
        table.add_column(name)
    for name in ("variance / bound", "±", "expected", "bias", "number", "realisations"):
        table.add_column(name, justify="right")
    for row in verification.rows:
        if row.group == "all":
            table.add_section()
        mark = "" if row.holds else "  missed"
        table.add_row(
            row.noise if row.group == "all" else "",
            row.group,
            f"{row.ratio:.3f}",
            f"{row.u_ratio:.3f}",
            f"up to {row.bar:g}{mark}" if row.group == "all" else "–",
            f"{row.bias:.2f}",
            str(row.p),
            str(row.n),
        )
    console.print(table)
    console.print(
        "bias: mean error over its own standard uncertainty, RMS over the parameters; 1 where there is none. Of the points on the artefacts "
        f"that count in the bound, the estimate uses {100 * verification.used_fraction:.1f} %."
    )
    _show_failures(console, verification.failures)
    show_provenance(console)


def show_methods(verification: MethodsVerification) -> None:
    """RMS errors of the article's method and of the joint estimate."""
    console = Console(width=150, highlight=False)
    kind = "rendered" if verification.rendered else "observed"
    table = Table(title=f"RMS errors over {verification.n_sessions} {kind} sessions", title_justify="left")
    table.add_column("quantity")
    for name in ("article", "joint", "unit", "article / joint", "joint: error / u, RMS", "errors"):
        table.add_column(name, justify="right")
    for row in verification.rows:
        table.add_row(
            row.quantity,
            _scaled(row.article, row.unit),
            _scaled(row.joint, row.unit),
            _small_unit(row.unit),
            _number(row.ratio, 1),
            _number(row.rms_standardised, 2),
            str(row.n),
        )
    console.print(table)
    console.print(
        "Axes are compared after the best rotation of the camera frame, their error / u as the covariance counts them."
    )
    _show_failures(console, verification.failures)
    show_provenance(console)


def _show_failures(console: Console, failures: Sequence[str]) -> None:
    for text in failures:
        console.print(f"not done: {text}", style="yellow", markup=False)
