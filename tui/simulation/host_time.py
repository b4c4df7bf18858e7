"""Host time of a bench: the system's, or that of its simulated devices."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from daq.host_clock import HostClock, SystemClock

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop
    from collections.abc import Callable

    from daq.bench.model import Bench


def host_time(bench: Bench) -> tuple[HostClock, Callable[[], AbstractEventLoop] | None]:
    """Return the host clock of a bench, and what makes the event loop that reads its devices.

    Simulated devices that run have a clock, named in the bench file, that waits for them and for
    the loop that reads them: a busy computer makes the bench slow, and loses no sample.
    """
    if not bench.simulated_clock or not Path(bench.simulated_clock).exists():
        return SystemClock(bench.speed), None
    from sim_devices.server.paced_clock import PacedClock, PacedLoop  # noqa: PLC0415  (simulated)

    paced = PacedClock(bench.simulated_clock)
    clock = SystemClock(
        bench.speed, monotonic_ns=paced.now_ns, always_ns=paced.now_ns, utc_ns=paced.utc_ns
    )
    return clock, partial(PacedLoop, paced)
