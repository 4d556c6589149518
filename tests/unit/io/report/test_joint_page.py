"""The first page with the verdict, the measured features with U, and the section of the joint estimate."""

import dataclasses
import re
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest

from rotaline.calibration.model import AngleError
from rotaline.calibration.scatter import mount_scatter
from rotaline.calibration.verdict.model import Figure, Finding, StepVerdict
from rotaline.io.records import read_record, write_record
from rotaline.io.report.figures import joint as figures
from rotaline.io.report.verdict_words import figure_text
from rotaline.io.report.write import render_report


class _Text(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.text = ""
        self.tags: list[str] = []
        self.feed(re.sub(r"<style>.*?</style>", "", html, flags=re.S))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text += " " + " ".join(data.split())


def text_of(contents) -> str:
    """The text of the page, blanks once."""
    return " ".join(_Text(render_report(contents)).text.split())


def light(contents, **changes):
    """Without the pictures of the stages before."""
    nothing = {"camera": None, "laser_plane": None, "axis": None, "clouds": (), "surfaces": (), "overlays": ()}
    return dataclasses.replace(contents, **(nothing | {"fitted_points": ()} | changes))


@pytest.fixture(scope="module")
def page(joint_contents) -> str:
    return text_of(light(joint_contents))


def test_the_first_page_is_verdict_then_what_to_do_then_measured_features(page):
    places = [
        "Doubtful The calibration can be used",
        "U of a point near the axis 13.6 µm",
        "U of a single point 10.2 µm",
        "The steps",
        "held-out RMS 0.0452 px, below 0.06 px",
        "Turntable Not there",
        "What to do, most useful first",
        "Mount the cylinder 5 to 8 mm off centre",
        "about 6.4 times smaller",
        "Shorten the exposure",
        "Measured features with their expanded uncertainty U (k = 2)",
        "2 serious warnings",
        "Captures of the session",
        "Calibrated quantities with their expanded uncertainty",
        "Residuals of each group",
        "Distances of the stripe points from the surfaces",
        "Errors of the turntable",
    ]
    assert sorted(places, key=page.index) == places
    assert "could not be drawn" not in page


def test_measured_features_have_u_its_parts_and_whether_the_error_is_within(page):
    # u: hypot(0.3, 1.1) um = 1.140 um; ball: error -2.3 um > U = 2.28 um, rod: +0.3 um
    assert "ball sphere – ceramic ball diameter 28.4727 2.3 0.60 2.2 28.4750 −2.3 no, 1.01 U" in page
    assert "rod diameter 38.0043 2.3 0.60 2.2 38.0040 +0.30 yes" in page


def test_the_joint_estimate_is_told_in_full(page):
    for said in (
        "312 parameters from 61 234 observations, 9 iterations, converged",
        "focal length fx 2450.02 px 0.600 px image",
        "place of the axis along x 0.0000 mm 2.20 µm base",
        "angle harmonics yes cos 21.0 ± 8.0 µrad; sin −44.0 ± 8.0 µrad",
        "pitch of checkerboard no true over stated 1.000020 ± 0.000060",
        "axis position across the laser plane 68.0 µm 83 the mounts are too well centred",
        "13 of 14",
        "Frames left out: camera/0003.png: RMS 0.42 px",
        "5.100 mm off centre (U = 1.4 µm)",
        "angle 35.0 4.0 µrad",
        "Speckle limits a single point to",
        "Dorsch",
    ):
        assert said in page, said


def test_sections_of_the_articles_way_are_not_there(page, full_contents):
    for title in ("Axis optimisation (stepped cylinder)", "cross-ratio", "Cross-ratio"):
        assert title not in page
    article = text_of(dataclasses.replace(light(full_contents), measurements=(), measurements_initial_axis=()))
    assert "Axis optimisation (stepped cylinder)" in article
    assert "Joint estimate" not in article
    assert "What to do" not in article


def test_a_joint_estimate_that_failed_says_so(full_contents):
    run = dataclasses.replace(full_contents.run, options={"calibration.method": "joint"})
    failed = dataclasses.replace(light(full_contents), run=run, cross_ratio=None, artifact=None)
    assert "There is no joint estimate: see the warnings." in text_of(failed)


def test_a_verdict_without_findings_and_with_odd_names(joint_contents):
    odd = "<script>alert('x')</script>\"&"
    verdict = dataclasses.replace(
        joint_contents.verdict,
        level="fail",
        text=odd,
        steps=(StepVerdict(odd, "fail", odd),),
        findings=(Finding(odd, odd, "fail", odd, odd, float("nan")),),
        u_point_mm=float("nan"),
    )
    html = render_report(dataclasses.replace(light(joint_contents), joint=None, verdict=verdict))
    assert "script" not in _Text(html).tags
    assert re.search(r"\bnan\b", _Text(html).text) is None
    assert 'class="badge fail"' in html
    calm = dataclasses.replace(verdict, level="pass", findings=())
    assert "Nothing needs to be done." in text_of(dataclasses.replace(light(joint_contents), joint=None, verdict=calm))


def test_it_can_be_written_again_from_stored_results(joint_contents, tmp_path):
    stored = light(joint_contents, measurements=(), measurements_initial_axis=())
    write_record(tmp_path / "report.npz", stored)
    again, before = (
        re.sub(r'src="data:[^"]*"', "", render_report(c)) for c in (read_record(tmp_path / "report.npz"), stored)
    )
    assert again == before


def test_a_joint_estimate_without_anything_is_no_mishap(joint_contents):
    mount = joint_contents.joint.mounts[0]
    lost = dataclasses.replace(mount, weight=mount.weight * 0.0, tilt_rad=float("nan"))
    bare = dataclasses.replace(
        joint_contents.joint, groups=(), mounts=(lost,), table=None, optional=(), weak_directions=(), converged=False
    )
    text = text_of(light(joint_contents, joint=bare, speckle_limit=None))
    assert "could not be drawn" not in text
    assert "not converged" in text
    assert re.search(r"\bnan\b", text, re.I) is None
    assert "the session does not state its optics" in text


def test_left_out_points_are_not_among_the_residuals_of_targets(joint_contents):
    groups = joint_contents.joint.groups
    uv, residuals = figures.target_points(groups)
    used = [g.n_used for g in groups if "target" in g.kind]
    assert len(uv) == len(residuals) == sum(used)
    assert np.abs(residuals).max() < 0.3  # those of the frames that were left out reach 0.9 px


def test_the_profile_runs_from_the_bottom_to_the_middle_of_the_top(joint_contents):
    mount = joint_contents.joint.mounts[0]
    along = figures.profile_mm(mount.points_part, len(mount.surfaces))
    spans = [along[mount.surface == s] for s in (3, 2, 1, 0)]
    assert min(spans[0]) == 0.0
    assert all(below.max() < above.min() for below, above in pairwise(spans))


def test_waves_that_may_be_chance_are_open_and_the_limit_is_drawn(joint_contents):
    parts = [mount_scatter(m) for m in joint_contents.joint.mounts]
    (ax,) = figures.scatter(parts, joint_contents.speckle_limit).axes
    filled = [line for line in ax.lines if line.get_marker() != "None" and line.get_markerfacecolor() != "none"]
    sure = {round(float(x), 6) for line in filled for x in line.get_xdata()}
    for part in parts:
        assert (round(part.waves_mm[0] * 1e3, 6) in sure) == (part.waves_mm[0] > part.chance_mm)
        assert (round(part.waves_mm[3] * 1e3, 6) in sure) == (part.waves_mm[3] > part.chance_mm)
    limit = joint_contents.speckle_limit.depth_mm * 1e3
    assert any(np.allclose(line.get_xdata(), limit) for line in ax.lines if len(line.get_xdata()) == 2)
    low, high = ax.get_xlim()
    assert low < limit < high
    assert not any("limit" in t.get_text() for t in figures.scatter(parts, None).legends[0].get_texts())


def test_the_estimated_angle_error_is_drawn_over_the_frames(joint_contents):
    joint = joint_contents.joint
    ax = figures.table_errors(joint.table, joint.angle_error).axes[0]
    wave = next(line for line in ax.lines if len(line.get_xdata()) == 181)
    amplitude = np.hypot(joint.angle_error.cos_rad, joint.angle_error.sin_rad) * 1e6
    assert np.max(wave.get_ydata()) == pytest.approx(amplitude, rel=1e-3)
    without = figures.table_errors(joint.table, AngleError()).axes[0]
    assert len(without.lines) == len(ax.lines) - 1


@pytest.mark.parametrize(
    ("figure", "text"),
    [
        (Figure("views used", 20.0, "views", "of 20"), "views used 20 views, of 20"),
        (Figure("off the plane", 0.00351, "mm RMS"), "off the plane 3.51 µm RMS"),
        (Figure("direction", 0.000255, "rad"), "direction 255 µrad"),
        (Figure("depth", 62.0, "mm"), "depth 62.0 mm"),
        (Figure("turned against read", 0.98, ""), "turned against read 0.980"),
        (Figure("not known", float("nan"), "views"), "not known – views"),
    ],
)
def test_figures_behind_a_judgement_are_readable(figure, text):
    assert figure_text(figure) == text
