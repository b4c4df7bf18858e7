"""An event loop in which waiting takes no time.

Tests that are marked ``virtual_time`` run in it: when nothing is ready and no thread works for the
loop, its clock jumps to the next timer. It is for tests whose every participant is a coroutine of
the test, or a socket between two of them.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable
from concurrent.futures import Executor
from typing import TypeVar, TypeVarTuple, Unpack

_Result = TypeVar("_Result")
_Arguments = TypeVarTuple("_Arguments")


class Jumping(selectors.DefaultSelector):
    """Waits for I/O only where there is no timer to jump to."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.n_threads = 0
        """At work for the loop."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready; if nothing is, let the time pass."""
        ready: list[tuple[selectors.SelectorKey, int]] = super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None or self.n_threads:
            return super().select(None)
        self.now += timeout
        return []


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Begins at time 0."""

    def __init__(self, selector: Jumping | None = None) -> None:
        self._jumping = selector or Jumping()
        super().__init__(self._jumping)

    def time(self) -> float:
        """Return the virtual time in s."""
        return self._jumping.now

    def time_ns(self) -> int:
        """Return the virtual time in ns."""
        return round(self._jumping.now * 1e9)

    def hold_up(self, seconds: float) -> None:
        """Let time pass as if the running callback took so long."""
        self._jumping.now += seconds

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:  # noqa: ASYNC109 - as in asyncio
        """Wait for the threads: a limit (from Python 3.12 on) would pass at once."""
        del timeout
        await super().shutdown_default_executor()

    def run_in_executor(
        self,
        executor: Executor | None,
        func: Callable[[Unpack[_Arguments]], _Result],
        *args: *_Arguments,
    ) -> asyncio.Future[_Result]:
        """Run a function in a thread, for which the time stands still."""
        self._jumping.n_threads += 1
        future = super().run_in_executor(executor, func, *args)
        future.add_done_callback(self._returned)
        return future

    def _returned(self, _: asyncio.Future[_Result]) -> None:
        self._jumping.n_threads -= 1
