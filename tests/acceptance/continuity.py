"""Sums of rows over clocks that are set and packets that are lost: ``python -m`` this module.

The digitizer is `tests.peers.digitizer`, which shares no code with the drivers. A row that arrived
has arrived in every channel. Rows behind the last recorded one are still open.
"""

from __future__ import annotations

import itertools
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.protocols.block import BlockFlag, EventKind
from tests.daq.devices.test_stated_steps import (
    SIGNED,
    by_scream,
    by_seedlink,
    recorded,
    true_index,
)
from tests.peers.digitizer import Digitizer

if TYPE_CHECKING:
    from collections.abc import Callable

KINDS: dict[str, Callable[[Digitizer], list[Any]]] = {
    "SeedLink, numbers of a station": by_seedlink,
    "SeedLink, numbers of all stations": lambda one: by_seedlink(one, numbers=lambda n: 7 * n),
    "Scream (GCF), whole seconds": by_scream,
}
LOST = ((110.3, 111.5), (150.0, 152.2))
JITTERS = (0.02, 0.16)
FIELDS = ("seconds", "steps", "lost", "jitter", "whole_seconds", "seed")
"""Of a digitizer, to make it again: it sends the same once."""


def account(receive: Callable[[Digitizer], list[Any]], digitizer: Digitizer) -> Counter[str]:
    """Return sums of one session: rows, and gaps against the truth."""
    has = np.zeros(digitizer.samples.shape, bool)
    for sent in digitizer.records():
        has[sent.first : sent.first + len(sent.counts), sent.channel] = True
    again = Digitizer(**{name: getattr(digitizer, name) for name in FIELDS})
    index, rows, blocks, events = recorded(receive(again))
    truth = true_index(rows, again)
    arrived = np.flatnonzero(np.asarray(has.all(axis=1))[: int(truth[-1]) + 1])
    found = Counter(
        sessions=1,
        sent=int(truth[-1]) + 1,
        arrived=len(arrived),
        recorded=len(truth),
        lacking=len(np.setdiff1d(arrived, truth)),
        steps=sum(each.kind == EventKind.RESET for each in events),
    )
    estimated = {b.first_sample for b in blocks if BlockFlag.MISSING_ESTIMATED in b.flags}
    for row in np.flatnonzero((np.diff(truth) > 1) | (np.diff(index) > 1)).tolist():
        off = abs(int(np.diff(index[row : row + 2])[0] - np.diff(truth[row : row + 2])[0]))
        is_estimated = int(index[row + 1]) in estimated
        found["gaps"] += 1
        found["estimated"] += is_estimated
        found["wrong"] += off > 1 and not is_estimated
    return found


def main() -> None:
    """Print the table of the documentation."""
    print("| device | sessions | rows sent | arrived | recorded | lacking | steps named |", end="")
    print(" gaps | of these estimated | wrong and exact |")
    print("|" + "---|" * 10)
    for name, receive in KINDS.items():
        total: Counter[str] = Counter()
        whole = receive is by_scream
        sizes = [size for size in SIGNED if not whole or size % 1 == 0]
        for size, lost, jitter in itertools.product(sizes, ((), LOST), JITTERS):
            digitizer = Digitizer(
                steps=((77.0, size),), lost=lost, jitter=jitter, whole_seconds=whole, seed=5
            )
            total += account(receive, digitizer)
        names = [
            "sessions",
            "sent",
            "arrived",
            "recorded",
            "lacking",
            "steps",
            "gaps",
            "estimated",
            "wrong",
        ]
        print(f"| {name} | " + " | ".join(f"{total[each]:,}" for each in names) + " |")


if __name__ == "__main__":
    main()
