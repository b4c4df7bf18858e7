"""Reading pieces of a recording while the one before is worked on."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

_Piece = TypeVar("_Piece")
_Read = TypeVar("_Read")

_READERS = 2  # pieces being read while one is worked on


def read_ahead(read: Callable[[_Piece], _Read], pieces: Sequence[_Piece]) -> Iterator[_Read]:
    """Read pieces in order, the next ones while the one before is worked on."""
    if len(pieces) < 2:
        yield from map(read, pieces)
        return
    with ThreadPoolExecutor(_READERS) as pool:
        coming: deque[Future[_Read]] = deque()
        for piece in pieces:
            coming.append(pool.submit(read, piece))
            if len(coming) > _READERS:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
