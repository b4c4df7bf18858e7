"""A day of nine channels against time: how long it takes to open, and to scroll at any zoom."""

from __future__ import annotations

import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.row import Row, least_work
from daq.bench.channel import Channel
from daq.protocols.block import Block, HostTime
from daq.recording.extremes import SUFFIX
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.writer import RecordingWriter
from daq.results.signal import Signal

RATE, SECONDS, PER_BLOCK = 100, 86400, 2
COLUMNS = 320
"""Of a terminal of 160 columns."""
CREATED = HostTime(10**12, 1_790_000_000 * 10**9)


def run(*, smallest: bool = False) -> list[Row]:
    """Measure opening, with extremes kept and without, and the slowest of views at seven zooms."""
    seconds = SECONDS // 100 if smallest else SECONDS
    with tempfile.TemporaryDirectory() as folder, patch("daq.recording.extremes.KEPT_FROM", 1):
        path = _record(Path(folder) / "day.h5", seconds)
        (kept,) = least_work(lambda: _opened(path), repeats=1 if smallest else 3)
        path.with_suffix(SUFFIX).unlink()
        (old,) = least_work(lambda: _opened(path), repeats=1)
        with Recording.open(path) as recording:
            signal = Signal(recording)
            begin, end = signal.span
            views = [
                _Shown(signal, begin + 0.3 * (end - begin), (end - begin) * 0.6 / 4**n)
                for n in range(7)
            ]
            scrolled = max(least_work(*views, repeats=1 if smallest else 3))
    what = f"{seconds / 3600:g} h of nine channels at {RATE} Hz against time"
    return [
        Row(f"{what}: open", kept, "s", at_most=1.0, note=f"without extremes {old:.2f} s"),
        Row(f"{what}: scroll, at the slowest zoom", 1000 * scrolled, "ms", at_most=100.0),
    ]


def _opened(path: Path) -> None:
    with Recording.open(path) as recording:
        signal = Signal(recording)
        signal.view(*signal.span, COLUMNS)


class _Shown:
    """Shows a span, each time another one."""

    def __init__(self, signal: Signal, begin: float, length: float) -> None:
        self._signal, self._begin, self._length = signal, begin, length

    def __call__(self) -> None:
        self._begin += self._length / 4
        self._signal.view(self._begin, self._begin + self._length, COLUMNS)


def _record(path: Path, seconds: int) -> Path:
    rng = np.random.default_rng(0)
    layouts = [
        SensorLayout(
            name,
            tuple(Channel(name=axis, sensitivity=1e6) for axis in "XYZ"),
            float(RATE),
            np.dtype(np.int32),
        )
        for name in "ABC"
    ]
    writer = RecordingWriter.create(path, sensors=layouts, created=CREATED, hidden=True)
    length = PER_BLOCK * RATE
    minutes = rng.integers(-5000, 5000, (60, length, 3)).astype(np.int32)
    for number in range(seconds // PER_BLOCK):
        ns = (number + 1) * PER_BLOCK * 10**9 + int(rng.exponential(2e6))
        at = HostTime(CREATED.monotonic_ns + ns, CREATED.utc_ns + ns)
        for layout in layouts:
            writer.append(Block(layout.name, number * length, minutes[number % 60], at))
    writer.close()
    return path
