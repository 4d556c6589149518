"""As the command line does: one thread a matrix product, because tests run side by side."""

import os

from hypothesis import settings

# the same examples in every run: a failure can be repeated, and a run that passed passes again
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")


os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
