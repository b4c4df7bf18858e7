"""A digitizer of three components, written from the manuals: miniSEED 2 over SeedLink, and GCF.

It shares no code with the drivers. It has a clock that may be set and an oscillator that may be
off; its link delivers late, in bursts, and may lose records.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

CODES = ("HNZ", "HNN", "HNE")
START = datetime(2026, 11, 28, 7, tzinfo=UTC)
IntArray = NDArray[np.int32]
_EPOCH_OF_GCF = datetime(1989, 11, 17, tzinfo=UTC)


@dataclass(frozen=True)
class Sent:
    """One record as sent: its channel, the true index of its first sample, and what it states."""

    channel: int
    first: int
    counts: IntArray
    stated: datetime
    arrival: float
    number: int


@dataclass
class Digitizer:
    """Records of a digitizer in the order of their arrival.

    Attributes
    ----------
    steps
        (true time in s, size in s): when its clock was set, and by how much.
    ppm
        By how much its oscillator is fast. Its stated times are right but for the steps.
    lost
        (true begin, end in s): records that end in between are lost, with their numbers.
    jitter
        Mean in s of the delay of a record, exponential.
    stalls
        (true begin, end in s): nothing is delivered in between.
    """

    seconds: float = 240.0
    rate: int = 100
    steps: tuple[tuple[float, float], ...] = ()
    ppm: float = 0.0
    lost: tuple[tuple[float, float], ...] = ()
    jitter: float = 0.05
    stalls: tuple[tuple[float, float], ...] = ()
    lengths: tuple[int, int] = (80, 112)
    whole_seconds: bool = False
    seed: int = 1
    samples: IntArray = field(init=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        n = round(self.seconds * self.rate * (1 + self.ppm * 1e-6))
        self.samples = self._rng.integers(-9000, 9000, (n, 3)).astype(np.int32)

    def time(self, index: float) -> float:
        """Return when a sample was taken, in s."""
        return index / (self.rate * (1 + self.ppm * 1e-6))

    def stated(self, index: int) -> datetime:
        """Return the time that the digitizer states for a sample."""
        true = self.time(index)
        return START + timedelta(seconds=true + sum(size for at, size in self.steps if true >= at))

    def records(self) -> list[Sent]:
        """Return what arrives, in order."""
        found: list[tuple[float, int, int, int]] = []
        for channel in range(3):
            first = 0
            while True:
                length = self.rate if self.whole_seconds else int(self._rng.integers(*self.lengths))
                # A record begins when the clock is set.
                cuts = [np.ceil(at * self.rate * (1 + self.ppm * 1e-6)) for at, _ in self.steps]
                ends = [int(cut) for cut in cuts if first < cut < first + length]
                end = min([first + length, *ends])
                if end > len(self.samples):
                    break
                found.append((self.time(end - 1), channel, first, end))
                first = end
        found.sort()
        sent, latest = [], 0.0
        for number, (ended, channel, first, end) in enumerate(found):
            arrival = ended + 0.1 + float(self._rng.exponential(self.jitter))
            for begin, until in self.stalls:
                arrival = until if begin <= arrival < until else arrival
            latest = max(latest, arrival)  # TCP keeps the order
            if not any(begin <= ended < until for begin, until in self.lost):
                counts = self.samples[first:end, channel]
                sent.append(Sent(channel, first, counts, self.stated(first), latest, number))
        return sent


def miniseed(sent: Sent, rate: int) -> bytes:
    """Return a miniSEED 2 record of 512 bytes, 32-bit integers (SEED manual 2.4, chapter 8)."""
    at, day = sent.stated, sent.stated.timetuple().tm_yday
    ticks = round(at.microsecond / 100)
    if ticks == 10_000:
        at, ticks = at + timedelta(seconds=1), 0
    time = struct.pack(">HHBBBBH", at.year, day, at.hour, at.minute, at.second, 0, ticks)
    head = b"%06dD " % (sent.number % 1_000_000) + b"STA  " + b"00" + CODES[sent.channel].encode()
    head += b"XX" + time + struct.pack(">Hhh", len(sent.counts), rate, 1)
    head += struct.pack(">BBBBiHH", 0, 0, 0, 1, 0, 64, 48)
    head += struct.pack(">HHBBBB", 1000, 0, 3, 1, 9, 0)  # blockette 1000: integers, 2**9 bytes
    return (head.ljust(64, b"\0") + sent.counts.astype(">i4").tobytes()).ljust(512, b"\0")


def seedlink(sent: Sent, rate: int, number: int) -> bytes:
    """Return a packet of SeedLink 3."""
    return b"SL%06X" % (number % (1 << 24)) + miniseed(sent, rate)


def gcf(sent: Sent, rate: int) -> bytes:
    """Return a GCF block of a whole second with differences of 32 bits (Güralp SWA-RFC-GCFR)."""
    since = sent.stated - _EPOCH_OF_GCF
    date = since.days << 17 | since.seconds
    stream = int(f"DEMO{'ZNE'[sent.channel]}2", 36)
    differences = np.diff(sent.counts, prepend=sent.counts[:1])
    head = struct.pack(">IIIBBBB", int("DEMO", 36), stream, date, 0, rate, 1, len(sent.counts))
    body = struct.pack(">i", sent.counts[0]) + differences.astype(">i4").tobytes()
    return head + body + struct.pack(">i", sent.counts[-1])


def scream(sent: Sent, rate: int, number: int) -> bytes:
    """Return a Scream packet of version 40 (DM24 operator's guide, section 8.2)."""
    tail = struct.pack(">BBHB", 40, 1, number % 65536, 4) + b"DEMO".ljust(48, b"\0")
    return gcf(sent, rate).ljust(1024, b"\0") + tail
