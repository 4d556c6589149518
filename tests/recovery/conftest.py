"""Shapes and types are checked while testing; where the same code runs many times over, that takes most of the time."""

import pytest
from jaxtyping import config


@pytest.fixture
def shapes_unchecked():
    """No checks of shapes and types during a test: for tests that repeat what others do with checks."""
    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", before)
