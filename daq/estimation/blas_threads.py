"""One thread of linear algebra while an estimate runs.

The matrices are small: further threads of BLAS save no time, and wait for work in loops that cost a
processor each. The command sets environment variables before it imports numpy; a script that
imports huddle has numpy already.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

VARIABLES = "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"
_ONE = "numpy" not in sys.modules and all(os.environ.get(each) == "1" for each in VARIABLES)
"""Whether all libraries find one thread when numpy loads them."""
_lock = threading.Lock()
_limits: list[Any] = []  # of the estimates that run: the process has one number of threads for all


@lru_cache(maxsize=1)
def _libraries(n_modules: int) -> ThreadpoolController:
    """Find the libraries of BLAS; again where modules have been imported, which may bring one."""
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415 - the command needs none

    del n_modules
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Generator[None]:
    """Limit BLAS to one thread; also a decorator.

    The first of several estimates at a time sets the limit, and the last one restores the number
    that was before.
    """
    if _ONE:
        yield
        return
    with _lock:
        libraries = _libraries(len(sys.modules))
        first = _limits[0] if _limits else libraries.limit(limits=1, user_api="blas")
        _limits.append(first)
    try:
        yield
    finally:
        with _lock:
            limit = _limits.pop()
            if not _limits:
                limit.restore_original_limits()
