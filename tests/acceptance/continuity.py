"""Sums of rows over clocks that are set, packets that are lost, and limits of counts.

``python -m`` this module prints the tables. Digitizer and logger are those of `tests.peers`, which
share no code with the drivers. A row that arrived has arrived in every channel. Rows behind the
last recorded one are still open.
"""

from __future__ import annotations

import itertools
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.protocols.block import BlockFlag, EventKind
from daq.results.result import Result
from estimator.checks.advice import Rank
from tests.daq.clocks.recordings import Sensor, write
from tests.daq.devices.test_stated_steps import by_scream, by_seedlink, recorded
from tests.daq.devices.text.test_stated_steps import by_packets, by_rows
from tests.peers.digitizer import Digitizer
from tests.peers.text_logger import TextLogger

SIGNED = [sign * size for size in (0.02, 0.3, 1.0, 20.0, 3600.0) for sign in (1, -1)]
KINDS: dict[str, Callable[[Digitizer], list[Any]]] = {
    "SeedLink, numbers of a station": by_seedlink,
    "SeedLink, numbers of all stations": lambda one: by_seedlink(one, numbers=lambda n: 7 * n),
    "Scream (GCF), whole seconds": by_scream,
}
LOST = ((110.3, 111.5), (150.0, 152.2))
JITTERS = (0.02, 0.16)
TEXT_JITTERS = (0.005, 0.04)
BITS = (8, 10, 12, 14, 16, 18, 20, 24, 28, 32)
SHARES = (0.1, 0.2, 0.25, 0.4, 0.6, 0.8, 0.95, 1.0)
FIELDS = ("seconds", "steps", "lost", "jitter", "whole_seconds", "seed")
"""Of a digitizer, to make it again: it sends the same once."""


def account(receive: Callable[[Digitizer], list[Any]], digitizer: Digitizer) -> Counter[str]:
    """Return sums of one session of a digitizer."""
    has = np.zeros(digitizer.samples.shape, bool)
    for sent in digitizer.records():
        has[sent.first : sent.first + len(sent.counts), sent.channel] = True
    again = Digitizer(**{name: getattr(digitizer, name) for name in FIELDS})
    return sums(receive(again), digitizer, np.asarray(has.all(axis=1)))


def sums(
    items: list[Any], peer: Digitizer | TextLogger, has_arrived: NDArray[np.bool_]
) -> Counter[str]:
    """Return sums of one session: rows, and gaps against the truth."""
    index, rows, blocks, events = recorded(items)
    known = {row.tobytes(): n for n, row in enumerate(peer.samples.astype("<i4"))}
    truth = np.array([known[row.tobytes()] for row in np.ascontiguousarray(rows)])
    arrived = np.flatnonzero(has_arrived[: int(truth[-1]) + 1])
    found = Counter(
        sessions=1,
        sent=int(truth[-1]) + 1,
        arrived=len(arrived),
        recorded=len(truth),
        lacking=len(np.setdiff1d(arrived, truth)),
        steps=sum(each.kind == EventKind.RESET for each in events),
    )
    estimated = {b.first_sample for b in blocks if BlockFlag.MISSING_ESTIMATED in b.flags}
    return found + compared(index, truth, estimated)


def compared(
    index: NDArray[np.int64], truth: NDArray[np.int64], estimated: set[int]
) -> Counter[str]:
    """Return how many gaps recorded rows have, and how many are wrong and not estimated.

    Parameters
    ----------
    index, truth : (n_rows,) int arrays
        Recorded and true indices.
    estimated : set of int
        Indices behind estimated gaps.
    """
    found = Counter[str]()
    for row in np.flatnonzero((np.diff(truth) > 1) | (np.diff(index) > 1)).tolist():
        off = abs(int(np.diff(index[row : row + 2])[0] - np.diff(truth[row : row + 2])[0]))
        is_estimated = int(index[row + 1]) in estimated
        found += Counter(gaps=1, estimated=is_estimated, wrong=off > 1 and not is_estimated)
    return found


NOISE, SCALE = 0.03, 3e4
SETTINGS = Settings(segment=2.0, methods=("three-sensor",))


def by_text(logger: TextLogger, *, packets: bool) -> Counter[str]:
    """Return sums of one session of a logger of text."""
    length = 25 if packets else 1
    has = np.repeat(~np.isin(np.arange(len(logger.samples) // length), list(logger.lost)), length)
    return sums(by_packets(logger) if packets else by_rows(logger), logger, has)


def at_limits(make: Callable[[NDArray[np.float64]], NDArray[Any]]) -> tuple[float, str]:
    """Return by how many dB the noise of B is too high, and why it has no lower bound, if so.

    `make` returns the counts of B for motion of one unit with noise.
    """
    rng = np.random.default_rng(5)
    motion = rng.standard_normal((20_000, 3))
    felt = {name: motion + NOISE * rng.standard_normal(motion.shape) for name in "ABC"}
    sensors = {name: Sensor(np.rint(SCALE * each).astype("<i4")) for name, each in felt.items()}
    counts = make(felt["B"])
    scale = float(np.ptp(counts) / np.ptp(felt["B"]) if counts.dtype != "<i4" else SCALE)
    sensors["B"] = Sensor(counts, channel={"sensitivity": scale / SCALE})
    with tempfile.TemporaryDirectory() as folder:
        snapshot = estimate([write(Path(folder, "r.h5"), sensors)], SETTINGS)
    result = Result(snapshot, SETTINGS)
    found = result.means("three-sensor", (1.0, 40.0))[3:6]
    off = 10 * np.log10(found[0].mean[0] / (2 * (NOISE * SCALE) ** 2 / 100))
    causes = {each.name for each in result.facts if each.rank is Rank.INVALIDATES}
    is_bounded = any(each.low[0] > 0 for each in found)
    return float(off), "bounded" if is_bounded else ", ".join(sorted(causes))


def wrapped(bits: int) -> Callable[[NDArray[np.float64]], NDArray[Any]]:
    """Return a device whose counts wrap: its range is 1.5 standard deviations of the motion."""

    def make(felt: NDArray[np.float64]) -> NDArray[Any]:
        half = 2 ** (bits - 1)
        counts = np.rint(felt * half / 1.5).astype(np.int64)
        return np.asarray((counts + half) % (2 * half) - half)

    return make


def held(share: float) -> Callable[[NDArray[np.float64]], NDArray[Any]]:
    """Return a device that has new readings in this share of the rows."""

    def make(felt: NDArray[np.float64]) -> NDArray[Any]:
        newest = np.floor(np.floor(np.arange(len(felt)) * share + 1e-9) / share + 1e-9)
        return np.asarray(np.rint(SCALE * felt[newest.astype(int)]), np.dtype("<i4"))

    return make


def main() -> None:
    """Print the tables of the documentation."""
    names = (
        "sessions",
        "sent",
        "arrived",
        "recorded",
        "lacking",
        "steps",
        "gaps",
        "estimated",
        "wrong",
    )
    print("| device | " + " | ".join(names) + " |")
    print("|" + "---|" * (1 + len(names)))
    kinds = {name: of_digitizer(receive) for name, receive in KINDS.items()}
    kinds["text rows with times"] = of_text(packets=False)
    kinds["datacast"] = of_text(packets=True)
    for name, sessions in kinds.items():
        total = sum(sessions, Counter[str]())
        print(f"| {name} | " + " | ".join(f"{total[each]:,}" for each in names) + " |", flush=True)
    for bits in BITS:
        off, causes = at_limits(wrapped(bits))
        print(f"wraps at {bits} bits: {off:+.1f} dB, {causes}", flush=True)
    for share in SHARES:
        off, causes = at_limits(held(share))
        print(f"{share:.0%} of rows new: {off:+.1f} dB, {causes}", flush=True)


def of_digitizer(receive: Callable[[Digitizer], list[Any]]) -> Iterator[Counter[str]]:
    """Yield the sums of each session of a digitizer."""
    whole = receive is by_scream
    sizes = [size for size in SIGNED if not whole or size % 1 == 0]
    for size, lost, jitter in itertools.product(sizes, ((), LOST), JITTERS):
        steps = ((77.0, size),)
        one = Digitizer(steps=steps, lost=lost, jitter=jitter, whole_seconds=whole, seed=5)
        yield account(receive, one)


def of_text(*, packets: bool) -> Iterator[Counter[str]]:
    """Yield the sums of each session of a logger of text."""
    lost_once = range(400, 405) if packets else range(10_000, 10_120)
    for size, lost, jitter in itertools.product(SIGNED, ((), lost_once), TEXT_JITTERS):
        steps = ((77.0, size),)
        logger = TextLogger(240.0, steps=steps, lost=frozenset(lost), jitter=jitter)
        yield by_text(logger, packets=packets)


if __name__ == "__main__":
    main()
