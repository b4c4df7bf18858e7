"""An hour of three polled sensors with 10,000 gaps, against the same hour without."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.row import Row, least_work
from daq.bench.channel import Channel
from daq.estimation.estimation import estimate
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter

RATE, N_GAPS = 50, 10_000
N_SAMPLES = 3600 * RATE
LOSSY_FROM = 48
"""Second of each minute from which single samples are lost; the others give segments."""
CREATED = HostTime(10**12, 1_790_000_000 * 10**9)


def run(*, smallest: bool = False) -> list[Row]:
    """Measure the estimate with gaps and without."""
    with tempfile.TemporaryDirectory() as folder:
        n_samples = N_SAMPLES // 12 if smallest else N_SAMPLES
        n_gaps = N_GAPS * n_samples // N_SAMPLES
        whole = _record(Path(folder) / "whole.h5", n_samples, 0)
        gappy = _record(Path(folder) / "gappy.h5", n_samples, n_gaps)
        without, with_gaps = least_work(
            lambda: estimate([whole]),
            lambda: estimate([gappy]),
            repeats=1 if smallest else 5,
        )
    return [
        Row(
            f"{n_samples / RATE / 60:g} min of three polled sensors, {n_gaps} gaps against none",
            with_gaps / without,
            "×",
            at_most=2.0,
            note=f"{with_gaps:.2f} s and {without:.2f} s",
        )
    ]


def _record(path: Path, n_samples: int, n_gaps: int) -> Path:
    rng = np.random.default_rng(0)
    motion = rng.standard_normal((n_samples, 3))
    second = np.arange(n_samples) // RATE % 60
    lossy = np.flatnonzero((second >= LOSSY_FROM) & (np.arange(n_samples) % 2 == 1))[:-1]
    layouts = [
        SensorLayout(
            name,
            tuple(Channel(name=axis, sensitivity=1e3) for axis in "xyz"),
            float(RATE),
            np.dtype(np.int16),
        )
        for name in "abc"
    ]
    blocks: list[Block] = []
    for number, layout in enumerate(layouts):
        gone = np.zeros(n_samples, dtype=np.bool_)
        share = n_gaps // 3 + (number < n_gaps % 3)
        gone[rng.choice(lossy, share, replace=False)] = True
        counts = np.round(1e3 * (motion + 0.1 * rng.standard_normal(motion.shape)))
        blocks += _blocks(layout.name, counts.astype(np.int16), gone, rng)
    writer = RecordingWriter.create(path, sensors=layouts, created=CREATED)
    for block in sorted(blocks, key=lambda block: block.received.monotonic_ns):
        writer.append(block)
    writer.close()
    return path


def _blocks(
    sensor: str, counts: np.ndarray, gone: np.ndarray, rng: np.random.Generator
) -> list[Block]:
    n_samples = len(counts)
    instants = np.round(1e9 * (np.arange(n_samples) / RATE + 1e-4 * rng.random(n_samples)))
    times = CREATED.monotonic_ns + instants.astype(np.int64)
    edges = np.flatnonzero(np.diff(gone, prepend=True, append=True)).reshape(-1, 2)
    found = []
    for low, high in edges.tolist():
        for first in range(low, high, RATE // 2):
            end = min(first + RATE // 2, high)
            flags = BlockFlag.MISSING_ESTIMATED if first == low else BlockFlag.NONE
            ns = int(times[end - 1]) - CREATED.monotonic_ns + 1_000_000
            found.append(
                Block(
                    sensor,
                    first,
                    counts[first:end],
                    HostTime(CREATED.monotonic_ns + ns, CREATED.utc_ns + ns),
                    flags=flags if first else BlockFlag.CLOCK_RESTART,
                    instants_ns=times[first:end],
                )
            )
    return found
