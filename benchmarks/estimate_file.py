"""The estimate from the file: decompression, alignment, spectra, result; and the whole command."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import scipy.fft

from benchmarks.row import Row, fastest
from daq.bench_model import Channel
from daq.estimation import Settings, estimate
from daq.protocols.block import Block, HostTime
from daq.recording.layout import SensorLayout
from daq.recording.writer import RecordingWriter
from daq.resampling import resample

RATE, LENGTH, HOURS = 200, 2000, 3
BLOCK = 2000
MEMORY = r"""
import re, sys
from pathlib import Path
from daq.estimation import Settings, estimate
estimate([sys.argv[1]], Settings(methods=("three-sensor",)))
print(re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text()).group(1))
"""


def run() -> list[Row]:
    """Measure what a recording costs, with one clock and with three."""
    with tempfile.TemporaryDirectory() as folder:
        samples = _samples(HOURS)
        shared = _record(Path(folder) / "shared.h5", samples, ppm=(0.0, 0.0, 0.0))
        ppm = (0.0, 15.0, -20.0)
        free = _record(Path(folder) / "free.h5", _samples(HOURS, ppm), ppm=ppm)
        frames = np.lib.stride_tricks.sliding_window_view(samples, LENGTH, axis=0)[:: LENGTH // 2]
        window = np.hanning(LENGTH)

        def bare() -> None:
            for first in range(0, len(frames), 24):
                scipy.fft.rfft(frames[first : first + 24] * window, axis=-1)

        settings = Settings()
        bare_time, shared_time, free_time = fastest(
            bare,
            lambda: estimate([shared], settings),
            lambda: estimate([free], settings),
            repeats=3,
        )
        command = _command(shared)
        return [
            Row(
                "from HDF5, one clock, against the bare FFTs",
                shared_time / bare_time,
                "×",
                at_most=4.0,
                note=f"{shared_time:.2f} s",
            ),
            Row(
                "from HDF5, three clocks refined, against the bare FFTs",
                free_time / bare_time,
                "×",
                note=f"{free_time:.2f} s, two passes with resampling",
            ),
            Row(
                "csd loop in memory against the whole command",
                _csd_loop(samples) / command,
                "×",
                at_least=5.0,
                note=f"{command:.2f} s",
            ),
            Row("memory of an estimate, 3 h", _memory(shared), "MB", at_most=250.0),
            Row("memory of an estimate, three clocks, 3 h", _memory(free), "MB", at_most=250.0),
            Row(
                "memory of an estimate, 9 h",
                _memory(_record(Path(folder) / "long.h5", _samples(9), ppm=(0.0, 0.0, 0.0))),
                "MB",
                at_most=250.0,
            ),
        ]


def _samples(hours: float, ppm: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Three triaxial sensors on one white motion, in counts, each sampled by its own clock."""
    rng = np.random.default_rng(0)
    n_samples = round(hours * 3600 * RATE)
    motion = rng.standard_normal((n_samples, 3), dtype=np.float32)
    samples = np.empty((n_samples, 9), dtype=np.int32)
    for sensor in range(3):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0].astype(np.float32)
        felt = motion @ turn
        if ppm[sensor]:
            felt = resample(felt.astype(float), np.arange(n_samples) / (1 + ppm[sensor] * 1e-6))
        felt += 0.01 * rng.standard_normal((n_samples, 3), dtype=np.float32)
        samples[:, 3 * sensor : 3 * sensor + 3] = 1e5 * felt
    return samples


def _record(path: Path, samples: np.ndarray, *, ppm: tuple[float, ...]) -> Path:
    shared = len(set(ppm)) == 1
    layouts = [
        SensorLayout(
            name,
            tuple(Channel(name=axis, sensitivity=1e5) for axis in "xyz"),
            float(RATE),
            np.dtype(np.int32),
            clock="one" if shared else name,
        )
        for name in "abc"
    ]
    created = HostTime(10**12, 1_790_000_000 * 10**9)
    writer = RecordingWriter.create(path, sensors=layouts, created=created)
    rng = np.random.default_rng(1)
    for number, layout in enumerate(layouts):
        rate = RATE * (1 + ppm[number] * 1e-6)
        for first in range(0, len(samples) - BLOCK + 1, BLOCK):
            late = round(((first + BLOCK - 1) / rate + rng.exponential(1e-3)) * 1e9)
            counts = samples[first : first + BLOCK, 3 * number : 3 * number + 3]
            received = HostTime(created.monotonic_ns + late, created.utc_ns + late)
            writer.append(Block(layout.name, first, counts, received))
    writer.close()
    return path


def _command(path: Path) -> float:
    """Return the wall time of the whole command in seconds, process start included."""
    least = float("inf")
    for _ in range(3):
        begin = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "tui", "estimate", str(path), "--json", str(path) + ".json"],
            check=True,
            capture_output=True,
        )
        least = min(least, time.perf_counter() - begin)
    return least


def _csd_loop(samples: np.ndarray) -> float:
    from scipy import signal  # noqa: PLC0415 - takes 1.6 s

    channels = np.ascontiguousarray(samples.T.astype(float))
    begin = time.perf_counter()
    for p in range(9):
        for q in range(p, 9):
            signal.csd(channels[p], channels[q], fs=RATE, nperseg=LENGTH)
    return time.perf_counter() - begin


def _memory(path: Path) -> float:
    """Return the peak of a process that only estimates, in MB."""
    told = subprocess.run(
        [sys.executable, "-c", MEMORY, str(path)], check=True, capture_output=True, text=True
    )
    return int(re.findall(r"\d+", told.stdout)[-1]) / 1024
