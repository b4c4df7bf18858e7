"""The estimate from the file: decompression, alignment, spectra, noise; diagnosis; the command.

Two kinds of file: as the recorder leaves it, in chunks of one to two seconds, and as it is
imported, in chunks of 4096 rows. Ratios are of wall times within one run; notes give the
processor's time, all threads together, which says more where the machine is shared, and what of
it no reader can save: inflating, and the imports.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import scipy.fft
from isal import isal_zlib

from benchmarks.row import Row
from daq.alignment.resampling import resample
from daq.bench.model import Channel
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.settings import Settings
from daq.protocols.block import HostTime
from daq.recording.array_writer import BLOCK_ROWS, ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.results.store import store_results

if TYPE_CHECKING:
    from collections.abc import Callable

RATE, LENGTH, HOURS = 200, 2000, 3
SLOW_RATE, SLOW_LENGTH, SLOW_HOURS = 40, 400, 24
REPEATS = 3
MEMORY = """
import sys
from benchmarks.row import peak_memory
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
estimate([sys.argv[1]], Settings(methods=("three-sensor",)))
print(peak_memory())
"""


@dataclass(frozen=True, slots=True)
class Cost:
    """Least wall and processor time of some repetitions, in seconds."""

    wall: float
    work: float


def run() -> list[Row]:
    """Measure what a recording costs, with one clock and with three."""
    with tempfile.TemporaryDirectory() as folder:
        return [
            *_three_hours(Path(folder)),
            *_a_day(Path(folder)),
        ]


def _three_hours(folder: Path) -> list[Row]:
    samples = sensor_samples(HOURS)
    recorded = recorded_file(folder / "recorded.h5", samples)
    imported = recorded_file(folder / "imported.h5", samples, chunk_rows=BLOCK_ROWS)
    ppm = (0.0, 15.0, -20.0)
    free = recorded_file(folder / "free.h5", sensor_samples(HOURS, ppm=ppm), ppm=ppm)
    frames = np.lib.stride_tricks.sliding_window_view(samples, LENGTH, axis=0)[:: LENGTH // 2]
    window = np.hanning(LENGTH)

    def bare() -> None:
        for first in range(0, len(frames), 24):
            scipy.fft.rfft(frames[first : first + 24] * window, axis=-1)

    settings = Settings()
    ffts, of_recorded_noise, of_imported_noise, with_diagnosis, from_free = _least(
        bare,
        lambda: _noise(recorded, settings),
        lambda: _noise(imported, settings),
        lambda: estimate([recorded], settings),
        lambda: estimate([free], settings),
    )
    of_recorded, of_imported, start = _least(
        lambda: _command(recorded),
        lambda: _command(imported),
        lambda: _run("-c", "import tui.commands.estimate"),
        repeats=2,
    )
    (loop,) = _least(lambda: _csd_loop(samples), repeats=1)
    (rectangular,) = _least(
        lambda: _command(imported, "--window", "rectangular", "--overlap", "0"), repeats=2
    )
    (rectangular_loop,) = _least(lambda: _csd_loop(samples, window="boxcar", noverlap=0), repeats=1)
    snapshot = estimate([recorded], Settings(methods=("all",)))
    (stored,) = _least(lambda: store_results(recorded, snapshot))
    rows = []
    for kind, path, cost, command in (
        ("recorded", recorded, of_recorded_noise, of_recorded),
        ("imported", imported, of_imported_noise, of_imported),
    ):
        rows += [
            Row(
                f"3 h × 9 × 200 Hz {kind}, one clock: matrix and noise against the bare FFTs",
                cost.wall / ffts.wall,
                "×",
                at_most=4.0,
                note=f"{cost.wall:.2f} s; work {cost.work / ffts.work:.1f} ×, {cost.work:.2f} s, of"
                f" which inflating alone {_inflating(path).work:.2f} s",
            ),
            Row(
                f"csd loop in memory against the whole command, {kind}",
                loop.wall / command.wall,
                "×",
                at_least=5.0,
                note=f"{command.wall:.2f} s; work {loop.work / command.work:.1f} ×,"
                f" {command.work:.2f} s, of which imports {start.work:.2f} s",
            ),
        ]
    return [
        *rows,
        Row(
            "csd loop in memory against the whole command, imported, rectangular, no overlap",
            rectangular_loop.wall / rectangular.wall,
            "×",
            at_least=5.0,
            note=f"{rectangular.wall:.2f} s; work {rectangular_loop.work / rectangular.work:.1f} ×,"
            f" {rectangular.work:.2f} s",
        ),
        Row(
            "3 h × 9 × 200 Hz recorded, one clock: with diagnosis, against the bare FFTs",
            with_diagnosis.wall / ffts.wall,
            "×",
            note=f"{with_diagnosis.wall:.2f} s; work {with_diagnosis.work / ffts.work:.1f} ×",
        ),
        Row(
            "3 h × 9 × 200 Hz, three clocks refined, against the bare FFTs",
            from_free.wall / ffts.wall,
            "×",
            note=f"{from_free.wall:.2f} s, two passes with resampling",
        ),
        Row(
            "3 h × 9 × 200 Hz: results of all methods into the recording, against its estimate",
            stored.wall / of_recorded_noise.wall,
            "×",
            at_most=0.5,
            note=f"{stored.wall:.2f} s",
        ),
        Row("memory of an estimate, 3 h", _memory(recorded), "MB", at_most=250.0),
        Row("memory of an estimate, three clocks, 3 h", _memory(free), "MB", at_most=250.0),
    ]


def _a_day(folder: Path) -> list[Row]:
    samples = sensor_samples(SLOW_HOURS, rate=SLOW_RATE)
    recorded = recorded_file(folder / "day.h5", samples, rate=SLOW_RATE)
    imported = recorded_file(
        folder / "day-imported.h5", samples, rate=SLOW_RATE, chunk_rows=BLOCK_ROWS
    )
    channels = np.ascontiguousarray(samples.T.astype(float))
    spectra, of_recorded, of_imported = _least(
        lambda: _mlab(channels),
        lambda: _command(recorded, "--method", "three-channel"),
        lambda: _command(imported, "--method", "three-channel"),
        repeats=2,
    )
    rows = [
        Row(
            f"24 h × 9 × 40 Hz {kind}: the whole command against mlab.csd, 18 spectra in memory",
            command.wall / spectra.wall,
            "×",
            at_most=0.6,
            note=f"{command.wall:.2f} s; work {command.work / spectra.work:.2f} ×,"
            f" {command.work:.2f} s, of which inflating alone {_inflating(path).work:.2f} s",
        )
        for kind, path, command in (
            ("recorded", recorded, of_recorded),
            ("imported", imported, of_imported),
        )
    ]
    return [*rows, Row("memory of an estimate, 24 h", _memory(recorded), "MB", at_most=250.0)]


def _least(*actions: Callable[[], object], repeats: int = REPEATS) -> list[Cost]:
    """Return the least cost of each action, taken in turns, its processes included."""
    costs: list[list[Cost]] = [[] for _ in actions]
    for _ in range(repeats):
        for found, action in zip(costs, actions, strict=True):
            begin = time.perf_counter(), _work()
            action()
            found.append(Cost(time.perf_counter() - begin[0], _work() - begin[1]))
    return [Cost(min(c.wall for c in each), min(c.work for c in each)) for each in costs]


def _work() -> float:
    of_processes = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + of_processes.ru_utime + of_processes.ru_stime


def sensor_samples(
    hours: float, *, rate: int = RATE, ppm: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Three triaxial sensors on one white motion, in counts, each sampled by its own clock."""
    rng = np.random.default_rng(0)
    n_samples = round(hours * 3600 * rate)
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


def recorded_file(
    path: Path,
    samples: np.ndarray,
    *,
    rate: int = RATE,
    ppm: tuple[float, ...] = (0.0, 0.0, 0.0),
    chunk_rows: int | None = None,
) -> Path:
    """Write the samples as a recording of three sensors, by one clock or by three."""
    shared = len(set(ppm)) == 1
    layouts = [
        SensorLayout(
            name,
            tuple(Channel(name=axis, sensitivity=1e5) for axis in "xyz"),
            float(rate),
            np.dtype(np.int32),
            clock="one" if shared else name,
        )
        for name in "abc"
    ]
    created = HostTime(10**12, 1_790_000_000 * 10**9)
    seconds = 1.0 if chunk_rows is None else chunk_rows / rate
    length = 10 * rate
    begins = range(0, len(samples) - length + 1, length)
    with ArrayWriter(path, sensors=layouts, created=created, chunk_seconds=seconds) as writer:
        for number, layout in enumerate(layouts):
            own_rate = rate * (1 + ppm[number] * 1e-6)
            # one digitizer sends what it has of all its sensors together
            delays = np.random.default_rng(0 if shared else number).exponential(1e-3, len(begins))
            writer.samples(
                layout.name,
                samples[: len(begins) * length, 3 * number : 3 * number + 3],
                block_rows=length,
                received_ns=[
                    round(((first + length - 1) / own_rate + delay) * 1e9)
                    for first, delay in zip(begins, delays, strict=True)
                ],
                restart=False,
            )
    return path


def _noise(path: Path, settings: Settings) -> None:
    """Estimate the noise and nothing else."""
    with Estimation([path], settings) as estimation:
        estimation.update()
        estimation.snapshot()


def _inflating(path: Path) -> Cost:
    """Return what inflating takes for all samples of a recording, one stream after the other."""
    streams = []
    with h5py.File(path, "r") as file:
        for sensor in file["sensors"].values():
            rows = sensor["samples"]
            chunks = range(0, len(rows), rows.chunks[0])
            streams += [rows.id.read_direct_chunk((first, 0))[1] for first in chunks]

    def inflate() -> None:
        for stream in streams:
            isal_zlib.decompress(stream)

    return _least(inflate, repeats=2)[0]


def _command(path: Path, *options: str) -> None:
    """Run the whole command."""
    _run("-m", "tui", "estimate", str(path), *options, "--json", f"{path}.json")


def _run(*arguments: str) -> str:
    return subprocess.run(
        [sys.executable, *arguments], check=True, capture_output=True, text=True
    ).stdout


def _csd_loop(samples: np.ndarray, **options: Any) -> None:  # noqa: ANN401 - of scipy's csd
    from scipy import signal  # noqa: PLC0415 - takes 1.6 s

    channels = np.ascontiguousarray(samples.T.astype(float))
    for p in range(9):
        for q in range(p, 9):
            signal.csd(channels[p], channels[q], fs=RATE, nperseg=LENGTH, **options)


def _mlab(channels: np.ndarray) -> None:
    """Take the spectra of a three-channel test: six for each direction."""
    from matplotlib import mlab  # noqa: PLC0415 - takes 1 s

    for axis in range(3):
        of_axis = channels[axis::3]
        for p in range(3):
            for q in range(p, 3):
                mlab.csd(
                    of_axis[p],
                    of_axis[q],
                    NFFT=SLOW_LENGTH,
                    Fs=SLOW_RATE,
                    detrend="mean",
                    noverlap=SLOW_LENGTH // 2,
                )


def _memory(path: Path) -> float:
    """Return the peak of a process that only estimates, in MB."""
    return float(_run("-c", MEMORY, str(path)))
