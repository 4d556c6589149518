"""As the command line does: one thread a matrix product, because tests run side by side; and which worker gets which tests."""

import os

import pytest
from hypothesis import settings
from tests import shape_checks

shape_checks.install()

# the same examples in every run: a failure can be repeated, and a run that passed passes again
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")


os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


ON_ONE_SESSION = ("test_bad_input", "test_pack", "test_diagnose", "test_method")
"""Files in ``e2e`` that use the same rendered session."""

FIRST = (
    "e2e/calibrated",
    "recovery/test_joint",
    "recovery/test_verdict",
    "e2e/test_run",
    "unit/calibration",
    "unit/simulation",
    "unit/pipeline",
    "unit/metrology",
    "unit/io",
    "recovery/test_features",
    "recovery/test_camera",
    "e2e/test_ways_of_running",
    "unit/vision",
    "e2e/test_verify_methods",
)
"""What takes longest, so that no worker is left with it at the end.

The kernels are compiled in the first of these, and those that run beside it meanwhile need few of them: or else all workers would compile
the same ones at the same time.
"""


def _unit_of_work(nodeid: str) -> str:
    """Tests with the same rendered sessions: a file, or a folder of unit tests with its common fixtures."""
    folders, _, name = nodeid.partition("::")[0].removeprefix("tests/").rpartition("/")
    file = name.removesuffix(".py")
    if folders.startswith("unit"):
        return folders
    return "e2e/calibrated" if file in ON_ONE_SESSION else f"{folders}/{file}"


def _place(unit: str) -> int:
    return next((i for i, first in enumerate(FIRST) if f"{unit}/".startswith(f"{first}/")), len(FIRST))


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: _place(_unit_of_work(item.nodeid)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A worker gets all tests that share fixtures of a module or session, which then are made once; in the order of the collection."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return _unit_of_work(nodeid)

    config.option.loadscopereorder = False
    return Scheduling(config, log)
