"""A logger that writes text with times, for tests: it shares no code with the driver.

Rows of three columns behind a time, over a serial line, or packets of one channel each (Raspberry
Shake's datacast). Its clock may be set, its oscillator be off, and its lines be lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

CHANNELS = ("ENZ", "ENN", "ENE")
UNIX = 1_795_849_200.0


@dataclass
class TextLogger:
    """Bytes and when they arrive.

    Attributes
    ----------
    steps
        (true time in s, size in s) by which its clock was set.
    lost
        Rows, or packets, that never arrive.
    jitter
        Mean in s of the delay of a read, exponential; and stalls, (begin, end) without a read.
    """

    seconds: float = 120.0
    rate: float = 100.0
    steps: tuple[tuple[float, float], ...] = ()
    ppm: float = 0.0
    lost: frozenset[int] = frozenset()
    jitter: float = 0.005
    stalls: tuple[tuple[float, float], ...] = ()
    digits: int = 4
    seed: int = 1
    samples: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        shape = (round(self.seconds * self.rate), 3)
        self.samples = self._rng.integers(-30_000, 30_000, shape)

    def time(self, index: int) -> float:
        """Return when a sample was taken, in s."""
        return index / (self.rate * (1 + self.ppm * 1e-6))

    def stated(self, index: int) -> str:
        """Return the time that the logger writes."""
        true = self.time(index)
        time = UNIX + true + sum(size for at, size in self.steps if true >= at - 1e-9)
        return f"{time:.{self.digits}f}"

    def rows(self, every: float = 0.05) -> list[tuple[bytes, float]]:
        """Return what is read from a serial line: rows, cut anywhere."""
        lines, taken = [], []
        for index, row in enumerate(self.samples.tolist()):
            if index not in self.lost:
                lines.append(f"{self.stated(index)},{','.join(map(str, row))}\n".encode())
                taken.append(self.time(index) + 0.002)
        ends = np.cumsum([len(line) for line in lines])
        data, found, begin, now = b"".join(lines), [], 0, 0.0
        while begin < len(data):
            now += every + float(self._rng.exponential(self.jitter))
            now = self._delivered(now)
            n = int(np.searchsorted(taken, now))
            end = int(ends[n - 1]) if n else 0
            if end > begin:
                found.append((data[begin:end], now))
                begin = end
        return found

    def stopped(self, begin: float, end: float, buffer: int) -> list[tuple[bytes, float]]:
        """Return what a host reads that stops reading in between, and keeps so many bytes."""
        found: list[tuple[bytes, float]] = []
        kept = b""
        for data, now in self.rows():
            if begin <= now < end:
                kept += data[: max(0, buffer - len(kept))]
                continue
            if now >= end and kept:
                found.append((kept, now))
                kept = b""
            found.append((data, now))
        return found

    def drained(self, begin: float, end: float, speed: float) -> list[tuple[bytes, float]]:
        """Return what a host reads from a server that is held up, and catches up at this speed."""
        found, latest = [], end
        for data, now in self.rows():
            if now < begin:
                found.append((data, now))
                continue
            seconds = data.count(b"\n") / self.rate
            latest = max(now, latest + seconds / speed)
            found.append((data, latest))
        return found

    def packets(self, length: int = 25) -> list[tuple[bytes, float]]:
        """Return datagrams of one channel each."""
        found, latest = [], 0.0
        for packet in range(len(self.samples) // length):
            first = packet * length
            arrival = self.time(first + length) + float(self._rng.exponential(self.jitter))
            latest = max(latest, self._delivered(arrival))
            for column, channel in enumerate(CHANNELS):
                counts = ", ".join(map(str, self.samples[first : first + length, column].tolist()))
                if packet not in self.lost:
                    text = f"{{'{channel}', {self.stated(first)}, {counts}}}"
                    found.append((text.encode(), latest))
        return found

    def _delivered(self, now: float) -> float:
        for begin, end in self.stalls:
            now = end if begin <= now < end else now
        return now
