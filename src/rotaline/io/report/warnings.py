"""The warnings of a run: collected from the contents and from the stages' results, without saying anything twice."""

from collections.abc import Iterable, Iterator

from rotaline.io.report.contents import STAGES, ReportContents, StageWarning


def stage_title(stage: str) -> str:
    """How a stage is called on the page; a name that is not in ``STAGES`` stands for itself."""
    return STAGES.get(stage, stage)


def collect_warnings(contents: ReportContents) -> tuple[StageWarning, ...]:
    """All warnings, serious ones first; those of a stage's result are added if the run did not pass them on."""
    found = list(contents.warnings)
    known = "\n".join(w.text for w in found)
    for warning, core in _warnings_of_results(contents):
        if not core or core not in known:
            found.append(warning)
            known += "\n" + warning.text
    return tuple(sorted(found, key=lambda w: not w.serious))


def _warnings_of_results(contents: ReportContents) -> Iterator[tuple[StageWarning, str]]:
    """Warnings that the results carry, each with the text by which it is known if the run has passed it on."""
    results = (
        ("camera", contents.camera),
        ("laser-plane", contents.laser_plane),
        ("cross-ratio", contents.cross_ratio),
        ("axis", contents.axis),
        ("artifact", contents.artifact),
        ("joint", contents.joint),
    )
    for stage, result in results:
        for text in result.warnings if result is not None else ():
            yield StageWarning(stage, text), text
    for scan in contents.clouds:
        if scan.n_points == 0:
            text = f"{scan.folder}: not a single point was measured. Look at the frames of this capture."
            yield StageWarning("scan", text, serious=True), text
    for entry in contents.measurements:
        place = f"{entry.capture}, {entry.name or entry.feature}"
        if entry.measurement is None:
            yield StageWarning("measure", f"{place}: not measured: {entry.failure}", serious=True), entry.failure
            continue
        for text in entry.measurement.warnings:
            yield StageWarning("measure", f"{place}: {text}"), text
    for surface in contents.surfaces:
        if surface.failure:
            yield StageWarning("surface", f"{surface.folder}: no surface: {surface.failure}"), surface.failure


def warnings_of(stage: str, warnings: tuple[StageWarning, ...]) -> tuple[StageWarning, ...]:
    """Those of one stage."""
    return tuple(w for w in warnings if w.stage == stage)


def grouped(warnings: Iterable[StageWarning]) -> tuple[tuple[str, str], ...]:
    """Titles of the stages and text, a text that several stages share only once."""
    stages: dict[str, list[str]] = {}
    for warning in warnings:
        titles = stages.setdefault(warning.text, [])
        if stage_title(warning.stage) not in titles:
            titles.append(stage_title(warning.stage))
    return tuple((", ".join(titles), text) for text, titles in stages.items())
