"""What the page says of values that are corrected for the width of the laser line."""

import dataclasses
import re

from rotaline.io.report.sections.parts import feature_section


def _paragraphs(contents):
    return [b.text for b in feature_section(contents, ()).blocks if hasattr(b, "text")]


def test_the_page_says_what_was_added_for_the_width_of_the_line(joint_contents):
    entries = list(joint_contents.measurements)
    k = next(i for i, e in enumerate(entries) if e.measurement is not None and "diameter" in e.measurement.value)
    before = " ".join(_paragraphs(joint_contents))
    corrected = entries[k].measurement.with_line_width({"diameter": 0.0031}, 0.25)
    entries[k] = dataclasses.replace(entries[k], measurement=corrected)
    after = " ".join(_paragraphs(dataclasses.replace(joint_contents, measurements=tuple(entries))))
    assert "width of the laser line" not in before
    assert re.search(r"width of the laser line.* diameter \+3\.1 µm\.", after)
    assert entries[k].to_json()["line_width_correction"] == {"diameter": 0.0031}
