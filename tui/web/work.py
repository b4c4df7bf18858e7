"""Long work for pages: a queue for each visitor, and one thread that serves them in turn.

Theory of operation
-------------------
Who asks for work that is being done or kept shares it. A visitor may have `WAITING` pieces in their
queue; the thread takes one from each queue in turn, so that nobody waits for the queue of another.
When all who asked for a piece have left, it is dropped; if it has begun, it ends at its next
`check_wanted`. A page that comes again for its result leaves for a while only. The results of the
last `KEPT` pieces with a key are kept.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from functools import partial
from typing import Any

from daq.errors import HuddleError

WAITING = 4
"""Pieces of work that wait for one visitor, at most."""
KEPT = 16
"""Results that are kept, at most: estimates, reports, documents."""


class TooMuchWorkError(HuddleError):
    """A visitor asks for more work than may wait for them."""


class LeftError(Exception):
    """All who asked for the work have left; no fault, so none that work may pass over."""


_OWN = threading.local()


def check_wanted(*_: object) -> None:
    """Raise LeftError in work that nobody waits for any more; takes what a `progress` receives."""
    check: Callable[[], None] | None = getattr(_OWN, "check", None)
    if check is not None:
        check()


class WorkPiece:
    """Work, its result, how many wait for it, and until when others may come again."""

    def __init__(self, act: Callable[[], Any], visitor: str, key: Hashable) -> None:
        self.act, self.visitor, self.key = act, visitor, key
        self.future: Future[Any] = Future()
        self.n_waiting, self.until = 0, 0.0


class Work:
    """One thread that works for all visitors in turn."""

    def __init__(self, name: str, *, now: Callable[[], float] = time.monotonic) -> None:
        self._name, self._now = name, now
        self._queues: OrderedDict[str, deque[WorkPiece]] = OrderedDict()
        self._known: OrderedDict[Hashable, WorkPiece] = OrderedDict()
        self._changed = threading.Lock()
        self._thread: threading.Thread | None = None

    def ask(self, visitor: str, key: Hashable, act: Callable[[], Any]) -> WorkPiece:
        """Return work, begun later unless it is known; `leave` gives it back.

        Parameters
        ----------
        visitor : str
            Whose queue it waits in.
        key : hashable
            Of the same result; None for a result that is neither shared nor kept.
        act : callable
            Does the work.

        Raises
        ------
        TooMuchWorkError
            If too much waits for this visitor.
        """
        with self._changed:
            piece = self._known.get(key)
            if piece is None or _has_failed(piece.future):
                queue = self._queues.setdefault(visitor, deque())
                for each in [each for each in queue if not self._is_wanted(each)]:
                    self._drop(each, queue)
                if len(queue) >= WAITING:
                    raise TooMuchWorkError(
                        f"{WAITING} pages wait to be made for you; try again in a moment"
                    )
                piece = WorkPiece(act, visitor, key)
                queue.append(piece)
                if self._thread is None:
                    self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                    self._thread.start()
            piece.n_waiting += 1
            if key is not None:
                self._known[key] = piece
                self._known.move_to_end(key)
                done = [known for known, each in self._known.items() if each.future.done()]
                for known in done[: max(0, len(done) - KEPT)]:
                    del self._known[known]
            return piece

    def leave(self, piece: WorkPiece, *, lease: float = 0.0) -> None:
        """Drop work that nobody waits for any more; `lease`: seconds for which it is kept on."""
        with self._changed:
            piece.n_waiting -= 1
            piece.until = max(piece.until, self._now() + lease)
            queue = self._queues.get(piece.visitor)
            if not self._is_wanted(piece) and queue is not None and piece in queue:
                self._drop(piece, queue)
                if not queue:
                    del self._queues[piece.visitor]

    def _is_wanted(self, piece: WorkPiece) -> bool:
        return piece.n_waiting > 0 or piece.until > self._now()

    def _drop(self, piece: WorkPiece, queue: deque[WorkPiece]) -> None:
        queue.remove(piece)
        piece.future.cancel()
        self._known.pop(piece.key, None)

    def _check(self, piece: WorkPiece) -> None:
        with self._changed:  # who asks from now on has it begun again
            if not self._is_wanted(piece):
                self._known.pop(piece.key, None)
                raise LeftError

    def close(self) -> None:
        """Begin no further work."""
        with self._changed:
            for queue in self._queues.values():
                for piece in queue:
                    piece.future.cancel()
            self._queues.clear()

    def _next(self) -> WorkPiece | None:
        """Return the next piece, of the visitor who has waited longest; None ends the thread."""
        with self._changed:
            if not self._queues:
                self._thread = None
                return None
            visitor, queue = self._queues.popitem(last=False)
            piece = queue.popleft()
            if queue:
                self._queues[visitor] = queue  # behind all others
            return piece

    def _run(self) -> None:
        while (piece := self._next()) is not None:
            if not piece.future.set_running_or_notify_cancel():
                continue
            _OWN.check = partial(self._check, piece)
            try:
                check_wanted()
                piece.future.set_result(piece.act())
            except BaseException as error:  # noqa: BLE001 - whoever waits for it raises it
                piece.future.set_exception(error)


def _has_failed(future: Future[Any]) -> bool:
    return future.done() and (future.cancelled() or future.exception() is not None)
