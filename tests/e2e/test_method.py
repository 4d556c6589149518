"""``--method``: the way of calibrating, and the defaults that go with it."""

import json
import tomllib


def test_the_article_s_way_is_chosen_by_a_word(place, call):
    done = call("calibrate", place.session, "--method", "article", "--out", place.results, "--json")
    assert done.code == 0
    quality = json.loads(done.out)["quality"]
    assert "cross_ratio" in quality
    assert "joint" not in quality


def test_its_defaults_are_printed_and_may_be_overruled(place, call):
    printed = tomllib.loads(call("options", "--method", "article").out)
    assert printed["calibration"] == {"method": "article"}
    assert printed["stripe"]["method"] == "improved-gray-gravity"
    wrong = call("calibrate", place.session, "--method", "article", "--option", "stripe.method=none")
    assert wrong.code == 2
    assert "stripe.method: found 'none'" in wrong.err
    unknown = call("calibrate", place.session, "--method", "sqp")
    assert unknown.code == 2
    assert "sqp" in unknown.err
