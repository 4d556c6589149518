"""The simulation of section 5.4 reproduces the article."""

from pathlib import Path

import numpy as np
import pytest

from rotaline.errors import OutputError
from rotaline.pipeline.verify_axis import AxisVerification, verify_axis, write_convergence_picture


@pytest.fixture(scope="module")
def verification() -> AxisVerification:
    return verify_axis()


def test_every_case_of_table_1_converges(verification: AxisVerification) -> None:
    assert [case.name for case in verification.cases] == ["T1", "T2", "T3", "T4", "T5"]
    for case in verification.cases:
        assert 0.05 < case.mean_distance_before_mm < 0.5
        assert case.sqp_converged
        assert case.sqp_iterations <= 150
        assert case.sqp_mean_distance_mm < 1e-6
        assert case.sqp_axis_error_mm < 1e-5
        assert case.least_squares_mean_distance_mm < 1e-12
        assert case.least_squares_axis_error_mm < 1e-11
        assert len(case.sqp_history_mm) == case.sqp_iterations + 1
        assert case.sqp_history_mm[0] == pytest.approx(case.mean_distance_before_mm)
        assert np.all(case.least_squares_history_mm[1:3] < 0.5 * case.least_squares_history_mm[:2])


def test_picture(verification: AxisVerification, tmp_path: Path) -> None:
    path = tmp_path / "convergence.png"
    write_convergence_picture(verification, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(OutputError, match="cannot be written"):
        write_convergence_picture(verification, tmp_path / "nowhere" / "convergence.png")
