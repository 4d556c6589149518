"""Speed and accuracy, measured: ``python -m benchmarks``. See docs/benchmarks.md."""

import os

# as the command line does: frames are what is done side by side
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
