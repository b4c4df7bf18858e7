"""Bounds the memory that other people's files take from libraries that know no limit."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def memory_limit(n_bytes: int) -> Iterator[None]:
    """Raise MemoryError where this process takes so many bytes more than before; on Linux alone."""
    try:
        import resource  # noqa: PLC0415 - not on Windows

        n_pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (ImportError, OSError):
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limits = [n_pages * resource.getpagesize() + n_bytes, soft, hard]
    limit = min(each for each in limits if each != resource.RLIM_INFINITY)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
