"""The page as a whole: complete, self-contained, honest about what is missing, and safe with any text."""

import dataclasses
import logging
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from rotaline.errors import OutputError
from rotaline.io.records import read_record, write_record
from rotaline.io.report.contents import CloudSummary, FittedPoints, FrameOverlay, ReportContents, StageWarning
from rotaline.io.report.figures import camera as camera_figures
from rotaline.io.report.write import render_report, write_report
from rotaline.io.results import MeasurementEntry
from rotaline.scanning.cloud import PointCloud

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Checks that tags are balanced and collects what the page holds."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text += " " + " ".join(data.split())

    def count(self, name: str) -> int:
        return sum(tag == name for tag, _ in self.tags)


@pytest.fixture(scope="module")
def full_html(full_contents):
    return render_report(full_contents)


def light(contents: ReportContents, **changes) -> ReportContents:
    """Without what takes long to draw."""
    nothing = {
        "camera": None,
        "laser_plane": None,
        "cross_ratio": None,
        "axis": None,
        "artifact": None,
        "calibration": None,
        "clouds": (),
        "surfaces": (),
        "overlays": (),
        "fitted_points": (),
        "measurements": (),
        "measurements_initial_axis": (),
        "warnings": (),
    }
    return dataclasses.replace(contents, **(nothing | changes))


def test_everything_is_there_and_nothing_comes_from_outside(full_html):
    page = Page(full_html)
    assert "could not be drawn" not in page.text
    images = [a["src"] for tag, a in page.tags if tag == "img"]
    assert len(images) > 35
    assert all(src.startswith("data:image/") for src in images)
    assert all(a.get("alt") for tag, a in page.tags if tag == "img")
    assert page.count("script") == page.count("link") == page.count("iframe") == 0
    without_images = re.sub(r'src="data:[^"]*"', "", full_html)
    assert "http" not in without_images
    assert "url(" not in without_images
    assert len(full_html) < 10e6


def test_the_order_is_warnings_results_rig_stages(full_html):
    text = Page(full_html).text
    places = [
        "Rotaline measurement report",
        "2 serious warnings",
        "5 warnings",
        "Camera, reprojection RMS",
        "Measured features, with the final calibration",
        "(the article's table 2)",
        "Captures of the session",
        "px RMS over 12 of 14 views",
        "stripe points in 9 of 10 poses",
        "Interval RMSE 20.6 → 2.8 µm",
        "Circles 11.2 µm RMS",
        "Mean distance to the ideal circles",
        "Clouds of points in the table frame",
        "1 of 2 surfaces reconstructed",
        "5 of 6 features fitted",
        "Time of each stage",
    ]
    assert sorted(places, key=text.index) == places


def test_figures_and_tables_are_numbered_without_gaps_and_every_anchor_exists(full_html):
    page = Page(full_html)
    for kind in ("Figure", "Table"):
        found = [int(n) for n in re.findall(rf"\b{kind} (\d+)\.", page.text)]
        assert found == list(range(1, len(found) + 1))
    ids = {a["id"] for _, a in page.tags if "id" in a}
    links = {a["href"] for tag, a in page.tags if tag == "a"}
    assert {link[1:] for link in links} <= ids


def test_table_rows_are_as_wide_as_their_heads(full_html):
    for table in re.findall(r"<table.*?</table>", full_html, re.S):
        width = table.count("<th ")
        for row in re.findall(r"<tr.*?</tr>", table.split("</thead>")[1], re.S):
            spans = [int(n) for n in re.findall(r'colspan="(\d+)"', row)]
            assert row.count("<td") - len(spans) + sum(spans) == width


def test_before_and_after_as_in_the_article(full_html):
    text = Page(full_html).text
    # stepped-1, small diameter: +0.311 with the initial axis, +0.002 with the optimised one
    assert "stepped-1 23.0510 +0.3110 23.0530 +0.0020 0.0087 99.36" in text
    assert "Average of |error| 0.3115 0.0025 0.0108 99.20" in text


def test_without_an_initial_axis_there_is_no_before(full_contents):
    text = Page(render_report(light(full_contents, measurements=full_contents.measurements))).text
    assert "Error before" not in text
    assert "no before and after" in text
    assert "stepped-1 23.0510 23.0530 +0.0020 0.0087" in text


def test_stages_that_are_missing_say_so(bare_contents):
    text = Page(render_report(bare_contents)).text
    assert "No warnings." in text
    for line in (
        "The camera was not calibrated",
        "The laser plane was not calibrated",
        "it needs a dot plate",
        "No initial axis from a target on the turntable.",
        "No artefact captures: the initial axis is final.",
        "Nothing was scanned.",
        "No surfaces were reconstructed.",
        "Nothing was to be measured",
    ):
        assert line in text
    assert "Figure 1." not in text


def test_an_axis_from_the_artefact_alone_is_said_to_be_one(full_contents):
    text = Page(render_report(light(full_contents, artifact=full_contents.artifact))).text
    assert "the axis was found from the artefact alone" in text


def test_warnings_are_never_said_twice(full_contents):
    inside = full_contents.camera.warnings[0]
    contents = light(
        full_contents, camera=full_contents.camera, warnings=(StageWarning("camera", f"camera: {inside}"),)
    )
    text = Page(render_report(contents)).text
    assert text.count(inside) == 2  # at the top, and in the stage's own section
    assert "1 warning " in text


def test_warnings_spoil_the_judgement_of_their_stage(full_contents):
    calm = light(full_contents, cross_ratio=full_contents.cross_ratio)
    assert 'class="judgement good"' in render_report(calm)
    uneasy = dataclasses.replace(calm, warnings=(StageWarning("cross-ratio", "few rows"),))
    assert 'class="judgement fair"' in render_report(uneasy)
    alarmed = dataclasses.replace(calm, warnings=(StageWarning("cross-ratio", "the dots moved", serious=True),))
    html = render_report(alarmed)
    assert 'class="judgement poor"' in html
    assert "1 serious warning: do not rely on" in Page(html).text


def test_names_are_text_and_never_markup(full_contents):
    odd = "<script>alert('x')</script>\"&"
    measurement = full_contents.measurements[2]
    contents = light(
        full_contents,
        run=dataclasses.replace(
            full_contents.run,
            session=odd,
            machine=odd,
            options={odd: odd},
            versions={odd: odd},
            stage_seconds={odd: 1.0},
        ),
        captures=(dataclasses.replace(full_contents.captures[0], folder=odd, target=odd),),
        targets={odd: odd},
        warnings=(StageWarning(odd, odd), StageWarning("camera", odd, serious=True)),
        measurements=(
            MeasurementEntry(odd, odd, odd, None, {}, odd),
            MeasurementEntry(odd, "sphere", odd, measurement.measurement, {odd: 1.0}),
        ),
        overlays=(FrameOverlay("axis", odd, odd, np.zeros((20, 30, 3), np.uint8), 1.0, np.zeros((0, 2))),),
        fitted_points=(FittedPoints(odd, "sphere", odd, np.zeros((0, 3)), np.zeros(0)),),
    )
    html = render_report(contents)
    page = Page(html)
    assert page.count("script") == 0
    assert "<script" not in html
    assert page.text.count(odd) > 10


def test_nan_rows_empty_clouds_and_failures_are_shown_not_hidden(full_contents):
    rng = np.random.default_rng(0)
    view = full_contents.camera.views[0]
    empty_view = dataclasses.replace(
        view, used=False, reason="no pose", rms_px=float("nan"), uv=np.zeros((0, 2)), residuals_px=np.zeros((0, 2))
    )
    camera = dataclasses.replace(
        full_contents.camera, views=(empty_view,), rms_px=float("nan"), mean_error_px=float("nan")
    )
    stripe = full_contents.laser_plane.views[0]
    nan_stripe = dataclasses.replace(
        stripe, points_camera=stripe.points_camera * np.nan, residuals_mm=stripe.residuals_mm * np.nan
    )
    nothing = dataclasses.replace(
        full_contents.cross_ratio,
        view=np.zeros(0, int),
        row=np.zeros(0, int),
        reference_mm=np.zeros(0),
        measured_before_mm=np.zeros(0),
        measured_after_mm=np.zeros(0),
        history_mm=np.zeros(0),
        rmse_before_mm=float("nan"),
        rmse_after_mm=float("nan"),
        accepted=False,
        reason="no intervals",
    )
    axis = full_contents.axis
    lost_axis = dataclasses.replace(
        axis,
        frames=tuple(dataclasses.replace(f, used=False, reason="lost") for f in axis.frames),
        corners_camera=axis.corners_camera * np.nan,
        circle_centres_camera=axis.circle_centres_camera * np.nan,
        circle_radii_mm=axis.circle_radii_mm * np.nan,
        circle_rms_mm=axis.circle_rms_mm * np.nan,
        u_position_mm=float("nan"),
    )
    mount = full_contents.artifact.mounts[0]
    lost_mount = dataclasses.replace(
        mount,
        features_before_base=mount.features_before_base * np.nan,
        features_base=mount.features_base * np.nan,
        distances_before_mm=mount.distances_before_mm * np.nan,
        distances_mm=mount.distances_mm * np.nan,
        mean_distance_mm=float("nan"),
        mean_distance_before_mm=float("nan"),
        eccentricity_mm=float("nan"),
    )
    artifact = dataclasses.replace(full_contents.artifact, mounts=(lost_mount,), history_mm=np.zeros(0))
    zero = np.zeros(0)
    no_points = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)), zero, zero, np.zeros(0, int), zero, zero)
    points = rng.normal(size=(5, 3))
    points[2] = np.nan
    nan = np.full(5, np.nan)
    unknown = PointCloud(points, points, nan, np.zeros(5), np.zeros(5, int), nan, nan)
    entry = full_contents.measurements[2]
    nan_fit = FittedPoints(entry.capture, entry.feature, entry.name, points * np.nan, np.full(5, np.nan))
    odd_measurement = dataclasses.replace(
        entry.measurement, value={"diameter": float("nan")}, rms=float("nan"), form_error=float("nan")
    )
    contents = dataclasses.replace(
        light(full_contents),
        camera=camera,
        laser_plane=dataclasses.replace(full_contents.laser_plane, views=(nan_stripe,), rms_mm=float("nan")),
        cross_ratio=nothing,
        axis=lost_axis,
        artifact=artifact,
        clouds=(CloudSummary("black", no_points, 0, 90, 90), CloudSummary("odd", unknown, 5, 90, 89)),
        measurements=(dataclasses.replace(entry, measurement=odd_measurement), full_contents.measurements[-1]),
        fitted_points=(nan_fit,),
        artifacts={},
    )
    text = Page(render_report(contents)).text
    assert "could not be drawn" not in text
    assert re.search(r"\bnan\b", text, re.I) is None
    assert "black: not a single point was measured" in text
    assert "no plane with more than 50 points; name a region." in text
    assert "The optimised plane is not used: no intervals" in text
    assert "no: no pose" in text


def test_a_picture_that_fails_does_not_cost_the_report(full_contents, monkeypatch, caplog):
    def broken(_):
        raise RuntimeError("out of ink")

    monkeypatch.setattr(camera_figures, "coverage", broken)
    with caplog.at_level(logging.WARNING):
        text = Page(render_report(light(full_contents, camera=full_contents.camera))).text
    assert "This picture could not be drawn (RuntimeError: out of ink)." in text
    assert "out of ink" in caplog.text


def test_the_file_is_written_whole_or_not_at_all(bare_contents, tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    write_report(bare_contents, path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    before = path.read_text(encoding="utf-8")
    assert before.startswith("<!DOCTYPE html>")
    (tmp_path / "a-file").write_text("")
    with pytest.raises(OutputError):
        write_report(bare_contents, tmp_path / "a-file" / "report.html")
    assert path.read_text(encoding="utf-8") == before


def test_the_report_can_be_written_again_from_stored_results(full_contents, tmp_path):
    entry = full_contents.measurements[2]
    assert entry.measurement is not None
    round_numbers = dataclasses.replace(
        entry, measurement=dataclasses.replace(entry.measurement, geometry={"radius": 14.2})
    )
    some = light(
        full_contents,
        cross_ratio=full_contents.cross_ratio,
        measurements=(round_numbers,),
    )
    write_record(tmp_path / "report.npz", some)
    again, before = (
        re.sub(r'src="data:[^"]*"', "", render_report(c)) for c in (read_record(tmp_path / "report.npz"), some)
    )
    assert again == before
