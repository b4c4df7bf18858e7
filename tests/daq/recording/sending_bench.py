"""A recording that grows by what its sensors send."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.recording.writer import RecordingWriter

RATE = 200


def felt(first: int, rng: np.random.Generator) -> NDArray[np.int32]:
    """Return a second of counts from a sample on: a motion that all sensors feel, and noise.

    Without the motion an estimate searches for it, which takes most of its time.
    """
    motion = np.random.default_rng([7, first]).integers(-999, 999, (RATE, 3))
    return (motion + rng.integers(-99, 99, (RATE, 3))).astype(np.int32)


class Bench:
    """Three sensors that send what the test wants, at times it gives in seconds."""

    def __init__(self, writer: RecordingWriter) -> None:
        self.writer, self.begun = writer, SystemClock().now()
        self._rng = np.random.default_rng(7)
        self._sent = dict.fromkeys("ABC", 0)

    def at(self, seconds: float) -> HostTime:
        """Return an instant after the start."""
        ns = round(seconds * 1e9)
        return HostTime(self.begun.monotonic_ns + ns, self.begun.utc_ns + ns)

    def send(
        self, sensors: str, until: float, *, dead: int | None = None, clipped: bool = False
    ) -> None:
        """Send one block a second up to a time."""
        for sensor in sensors:
            while self._sent[sensor] < until * RATE:
                first = self._sent[sensor]
                counts = felt(first, self._rng)
                if dead is not None:
                    counts[:, dead] = 4
                flags = BlockFlag.CLIPPED if clipped else BlockFlag.NONE
                at = self.at(first / RATE + 1)
                self.writer.append(Block(sensor, first, counts, at, flags=flags))
                self._sent[sensor] += RATE
        self.writer.commit()

    def say(self, sensor: str, kind: str, at: float, text: str = "") -> None:
        """Write an event."""
        self.writer.event(Event(sensor, kind, text, self.at(at)))
        self.writer.commit()
