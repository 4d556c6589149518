"""As the command line does: one thread a matrix product, because tests run side by side."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
