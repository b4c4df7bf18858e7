"""Tests run side by side, so each takes one thread for its linear algebra.

Threads of BLAS only wait for each other on small matrices, at full load: they doubled the processor
time of some tests. The variables are set before numpy is imported, as `tui.commands.main` does, and
processes that tests start inherit them.
"""

import os

for _variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
