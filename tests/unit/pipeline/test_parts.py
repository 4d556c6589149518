import numpy as np
import pytest

from rotaline.io.results import MeasurementEntry
from rotaline.metrology.model import FeatureMeasurement
from rotaline.pipeline.parts import reference_contradiction


def _entry(diameter, reference):
    nothing = np.empty(0)
    value = FeatureMeasurement(
        "cylinder", {"diameter": diameter}, {"diameter": 0.001}, 9, 0.01, 0.03, nothing.astype(int), nothing, {}
    )
    return MeasurementEntry("rod", "cylinder", "rod", value, reference)


@pytest.mark.parametrize(
    ("diameter", "says"), [(81.5, True), (38.8, True), (37.2, True), (38.1, False), (38.004, False)]
)
def test_a_size_far_from_its_reference_is_said_to_be_wrong(diameter, says):
    text = reference_contradiction(_entry(diameter, {"diameter": 38.004}))
    assert bool(text) == says
    assert not says or ("38.004" in text and "pitch" in text)


def test_without_a_reference_or_a_measurement_there_is_nothing_to_contradict():
    assert reference_contradiction(_entry(81.5, {})) == ""
    assert (
        reference_contradiction(MeasurementEntry("rod", "cylinder", "rod", None, {"diameter": 38.0}, "no points")) == ""
    )
