"""`python -m benchmarks [NAME…]`: every benchmark module's rows as one table."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import pkgutil
import signal
import sys
import time
import traceback

import benchmarks
from benchmarks.row import Row

LONGEST = 1800.0
"""Seconds after which a benchmark is ended, and the next begins."""


def table(rows: list[Row]) -> str:
    """Lay rows out as text."""
    cells = [("what", "measured", "to reach", "")]
    for row in rows:
        limit = row.at_most if row.at_most is not None else row.at_least
        sign = "≤" if row.at_most is not None else "≥"
        cells.append(
            (
                f"{row.what} ({row.note})" if row.note else row.what,
                f"{_figure(row.measured)} {row.unit}",
                "" if limit is None else f"{sign} {_figure(limit)} {row.unit}",
                {True: "reached", False: "MISSED", None: ""}[row.reached],
            )
        )
    widths = [max(len(line[column]) for line in cells) for column in range(4)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in cells
    )


def _figure(value: float) -> str:
    """Write three figures, or all before the point."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def main(names: list[str]) -> int:
    """Run the named benchmarks, or all; 1 if a promise is missed or a benchmark fails."""
    modules = [
        module.name
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if not module.ispkg  # studies, which take hours
        and module.name not in {"__main__", "row"}
        and (not names or module.name in names)
    ]
    unknown = set(names) - set(modules)
    if unknown:
        print(f"no benchmark named {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    reached = [_is_reached(name) for name in modules]
    return int(not all(reached))


def _is_reached(name: str) -> bool:
    """Measure in a process of its own, which ends with all it started when its time is over."""
    part = multiprocessing.get_context("fork").Process(target=_show, args=(name,))
    part.start()
    part.join(LONGEST)
    is_over = part.is_alive()
    if part.pid is not None:
        with contextlib.suppress(ProcessLookupError):  # nothing that it started is left
            os.killpg(part.pid, signal.SIGKILL)
    part.join()
    if is_over:
        print(f"{name}: FAILED\nnot at its end after {LONGEST:g} s\n", flush=True)
    return part.exitcode == 0


def _show(name: str) -> None:
    os.setsid()
    begin = time.perf_counter()
    try:
        rows: list[Row] = importlib.import_module(f"benchmarks.{name}").run()
    except Exception:  # noqa: BLE001 - said here, and the others are measured
        print(f"{name}: FAILED\n{traceback.format_exc()}", flush=True)
        sys.exit(1)
    print(f"{name} ({time.perf_counter() - begin:.0f} s)\n{table(rows)}\n", flush=True)
    sys.exit(any(row.reached is False for row in rows))


if __name__ == "__main__":
    # BLAS's own threads only get in the way of ours; it reads this when numpy is first imported.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    sys.exit(main(sys.argv[1:]))
