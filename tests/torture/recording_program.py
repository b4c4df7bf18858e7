"""Records samples that tell their own index, and says what has been acknowledged.

``python -m tests.torture.recording_program RECORDING ACKNOWLEDGED COMMITS`` appends a line of JSON
to the file ACKNOWLEDGED after each commit: rows, blocks and gaps of every sensor, and events.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.protocols.block import Block, Event, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter

CREATED = HostTime(1_000_000_000, 1_790_000_000_000_000_000)
SENSORS = ("a", "b")
"""The second one is polled."""
POLLED = "b"
N_CHANNELS = 3
_NS_PER_ROW = 10_000_000


def counts_of(sensor: str, first: int, n: int) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    """Return the counts with these sample indices: noise that depends on them alone."""
    channel = np.arange(N_CHANNELS, dtype=np.uint64) + np.uint64(ord(sensor) << 40)
    row = np.arange(first, first + n, dtype=np.uint64)[:, None]
    mixed = (row * np.uint64(N_CHANNELS) + channel + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    return (mixed >> np.uint64(44)).astype(np.int32)


def instants_of(first: int, n: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the times of the samples of a polled sensor."""
    return CREATED.monotonic_ns + np.arange(first, first + n) * _NS_PER_ROW


def main() -> int:
    """Record until the commits are done, or until the disk fails."""
    path, acknowledged, commits = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    said = os.open(acknowledged, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    channels = tuple(Channel(name=name, sensitivity=1.0) for name in "xyz")
    sensors = [SensorLayout(name, channels, 100.0, np.dtype("i4")) for name in SENSORS]
    rng = np.random.default_rng(1)
    try:
        writer = RecordingWriter.create(
            path, sensors=sensors, created=CREATED, control=(7, "token")
        )
        first = 0
        for number in range(commits):
            n = int(rng.integers(1, 300))
            at = HostTime(*(t + (first + n) * _NS_PER_ROW for t in (10**9, CREATED.utc_ns)))
            for name in SENSORS:
                instants = instants_of(first, n) if name == POLLED else None
                block = Block(name, first, counts_of(name, first, n), at, instants_ns=instants)
                writer.append(block)
                if number % 3 == 2:
                    writer.gap(name, first + n, 5, reason=f"gap {number}")
            first += n + 5 * (number % 3 == 2)
            writer.event(Event("a", "mark", f"remark {number}", at))
            done = writer.commit()
            _say(said, done)
        _say(said, writer.close())
    except RecordingError as error:
        print(error)
        return 3
    return 0


def _say(said: int, done: object) -> None:
    sensors = {
        name: [counts.rows, counts.blocks, counts.gaps]
        for name, counts in done.sensors.items()  # type: ignore[attr-defined]
    }
    line = {"sensors": sensors, "events": done.events}  # type: ignore[attr-defined]
    os.write(said, json.dumps(line).encode() + b"\n")


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # as the recorder does: after an error HDF5 may crash in its destructors
