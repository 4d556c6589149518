"""Options from files and settings, and the defaults of the two methods."""

import tomllib

import pytest

from rotaline.errors import SessionError
from rotaline.pipeline.options import ARTICLE_OPTIONS, Options, options_toml, read_options


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "options.toml"
        path.write_text(text)
        return path

    return write


def test_without_anything_the_defaults_hold():
    assert read_options(None) == Options()


@pytest.mark.parametrize(
    "read",
    [
        lambda file: read_options(None, (), "article"),
        lambda file: read_options(None, ("calibration.method=article",)),
        lambda file: read_options(file('[calibration]\nmethod = "article"\n')),
        lambda file: read_options(file('[calibration]\nmethod = "joint"\n'), (), "article"),
    ],
    ids=["argument", "setting", "file", "argument over file"],
)
def test_the_method_of_the_article_brings_its_options(read, file):
    assert read(file) == ARTICLE_OPTIONS


def test_the_other_method_has_the_defaults_of_the_stages():
    options = read_options(None, (), "joint")
    assert options.calibration.method == "joint"
    assert (options.camera, options.stripe, options.axis) == (Options().camera, Options().stripe, Options().axis)


def test_file_and_settings_go_over_the_options_of_the_article(file):
    path = file("[cross_ratio]\nmax_iterations = 7\n[axis]\nmin_range_deg = 5.0\n")
    options = read_options(path, ("axis.method=joint",), "article")
    assert options.cross_ratio.max_iterations == 7
    assert options.cross_ratio.dots == ARTICLE_OPTIONS.cross_ratio.dots == "triple"
    assert (options.axis.method, options.axis.min_range_deg) == ("joint", 5.0)
    assert options.camera == ARTICLE_OPTIONS.camera


@pytest.mark.parametrize("method", ["joint", "article"])
def test_the_printed_file_gives_the_options_that_it_shows(method, file):
    text = options_toml(method)
    assert tomllib.loads(text)["calibration"]["method"] == method
    assert read_options(file(text)) == read_options(None, (), method)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (("calibration.method=sqp",), "calibration.method: found 'sqp'"),
        (("calibration.way=joint",), "calibration.way: there is no such option; expected one of method"),
        (("nothing.x=1",), r"\[nothing\]: there is no such stage"),
        (("calibration=joint",), "expected stage.name=value"),
    ],
)
def test_what_is_wrong_is_named(settings, says):
    with pytest.raises(SessionError, match=says):
        read_options(None, settings)


@pytest.mark.parametrize("method", [None, "article"])
def test_a_stage_must_be_a_table(file, method):
    with pytest.raises(SessionError, match="calibration: found 'joint', expected a table"):
        read_options(file('calibration = "joint"\n'), (), method)
