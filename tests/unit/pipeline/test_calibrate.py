import numpy as np
import pytest

from rotaline.geometry.primitives import Line
from rotaline.pipeline.calibrate import axis_disagreement

UP = np.array([0.0, -1.0, 0.0])


@pytest.mark.parametrize(
    ("moved_mm", "u_mm", "says"), [(0.05, 0.001, False), (0.5, 0.01, True), (0.5, 0.2, False), (8.0, 0.2, True)]
)
def test_an_initial_axis_that_the_artefact_contradicts_is_named(moved_mm, u_mm, says):
    initial = Line(np.array([0.0, 0.0, 300.0]), UP)
    final = Line(np.array([moved_mm, 5.0, 300.0]), UP)
    text = axis_disagreement(initial, final, u_mm)
    assert bool(text) == says
    assert not says or f"{moved_mm:.2f} mm" in text
