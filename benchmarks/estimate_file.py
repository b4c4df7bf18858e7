"""The estimate from the file: decompression, alignment, spectra, noise; diagnosis; the command.

Files of three sensors: as the recorder leaves it, in chunks of one to two seconds; as it is
imported, in chunks of 4096 rows, by one clock. `benchmarks.reach` has what users wait for. Ratios
are of processor times within one run, all threads and processes together. Notes give what no
reader can save: inflating.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.fft
from isal import isal_zlib

from benchmarks.row import Row, least_work
from daq.bench.channel import Channel
from daq.clocks.resampling import resample
from daq.estimation.estimation import MIN_SENSORS, Estimation, estimate
from daq.estimation.settings import Settings
from daq.protocols.block import HostTime
from daq.recording.array_writer import BLOCK_ROWS, ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.results.store import store_results

RATE, LENGTH, HOURS = 200, 2000, 3
SLOW_RATE, SLOW_LENGTH, SLOW_HOURS = 40, 400, 24
REPEATS = 3
ESTIMATE = (
    "rich.table, daq.estimation.estimation, tui.output.results, tui.output.diagnosis,"
    " tui.runs.estimate_settings, tui.wording.facts"
)
"""Modules that ``huddle estimate`` imports when it runs."""
SHORT = 0.05
"""Hours of the smallest form."""
ALONE, ALONE_HOURS = 64, 0.5
"""Sensors of one channel whose result is to take little memory, at `RATE`."""
COMMAND_MEMORY = """
import sys
from benchmarks.row import peak_memory
from tui.commands.main import main
try:
    main()
except SystemExit:
    pass
print(peak_memory())
"""
MEMORY = """
import sys
from benchmarks.row import peak_memory
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
estimate([sys.argv[1]], Settings(methods=("three-sensor",)))
print(peak_memory())
"""


def run(*, smallest: bool = False) -> list[Row]:
    """Measure what a recording costs, with one clock and with three."""
    repeats = 1 if smallest else REPEATS
    with tempfile.TemporaryDirectory() as folder:
        return [
            *_three_hours(Path(folder), SHORT if smallest else HOURS, repeats),
            *_a_day(Path(folder), SHORT if smallest else SLOW_HOURS, repeats),
            _memory_of_many(Path(folder), MIN_SENSORS if smallest else ALONE),
        ]


def _three_hours(folder: Path, hours: float, repeats: int) -> list[Row]:
    what = f"{hours:g} h × 9 × {RATE} Hz"
    samples = sensor_samples(hours)
    recorded = recorded_file(folder / "recorded.h5", samples)
    imported = recorded_file(folder / "imported.h5", samples, chunk_rows=BLOCK_ROWS)
    ppm = (0.0, 15.0, -20.0)
    free = recorded_file(folder / "free.h5", sensor_samples(hours, ppm=ppm), ppm=ppm)
    frames = np.lib.stride_tricks.sliding_window_view(samples, LENGTH, axis=0)[:: LENGTH // 2]
    window = np.hanning(LENGTH)

    def bare() -> None:
        for first in range(0, len(frames), 24):
            scipy.fft.rfft(frames[first : first + 24] * window, axis=-1)

    settings = Settings()
    ffts, of_recorded_noise, of_imported_noise, with_diagnosis = least_work(
        bare,
        lambda: _noise(recorded, settings),
        lambda: _noise(imported, settings),
        lambda: estimate([recorded], settings),
        repeats=repeats,
    )
    rows = [
        Row(
            f"{what} {kind}, one clock: matrix and noise against the bare FFTs",
            cost / ffts,
            "×",
            at_most=4.0,
            note=f"{cost:.2f} s, of which inflating alone {_inflating(path):.2f} s",
        )
        for kind, path, cost in (
            ("recorded", recorded, of_recorded_noise),
            ("imported", imported, of_imported_noise),
        )
    ]
    snapshot = estimate([recorded], Settings(methods=("all",)))
    (stored,) = least_work(lambda: store_results(recorded, snapshot), repeats=repeats)
    return [
        *rows,
        Row(
            f"{what} recorded, one clock: with diagnosis, against the bare FFTs",
            with_diagnosis / ffts,
            "×",
            note=f"{with_diagnosis:.2f} s",
        ),
        Row(
            f"{what}: results of all methods into the recording, against its estimate",
            stored / of_recorded_noise,
            "×",
            at_most=0.5,
            note=f"{stored:.2f} s",
        ),
        Row(f"memory of an estimate, {hours:g} h", _memory(recorded), "MB", at_most=180.0),
        Row(
            f"memory of an estimate, three clocks, {hours:g} h",
            _memory(free),
            "MB",
            at_most=180.0,
        ),
    ]


def _a_day(folder: Path, hours: float, repeats: int) -> list[Row]:
    samples = sensor_samples(hours, rate=SLOW_RATE)
    recorded = recorded_file(folder / "day.h5", samples, rate=SLOW_RATE)
    imported = recorded_file(
        folder / "day-imported.h5", samples, rate=SLOW_RATE, chunk_rows=BLOCK_ROWS
    )
    channels = np.ascontiguousarray(samples.T.astype(float))
    _mlab(channels[:, :SLOW_LENGTH])  # imports it
    spectra, of_recorded, of_imported = least_work(
        lambda: _mlab(channels),
        lambda: command(recorded, "--method", "three-channel"),
        lambda: command(imported, "--method", "three-channel"),
        repeats=repeats,
    )
    rows = [
        Row(
            f"{hours:g} h × 9 × {SLOW_RATE} Hz {kind}: the whole command"
            " against mlab.csd, 18 spectra in memory",
            command / spectra,
            "×",
            at_most=0.6,
            note=f"{command:.2f} s, of which inflating alone {_inflating(path):.2f} s",
        )
        for kind, path, command in (
            ("recorded", recorded, of_recorded),
            ("imported", imported, of_imported),
        )
    ]
    memory = _memory(recorded)
    return [*rows, Row(f"memory of an estimate, {hours:g} h", memory, "MB", at_most=250.0)]


def _memory_of_many(folder: Path, n_sensors: int) -> Row:
    samples = sensor_samples(ALONE_HOURS if n_sensors == ALONE else SHORT, ppm=(0.0,) * n_sensors)
    path = recorded_file(
        folder / "alone.h5",
        samples[:, ::3],
        ppm=(0.0,) * n_sensors,
        chunk_rows=BLOCK_ROWS,
        axes="x",
    )
    memory = run_python("-c", COMMAND_MEMORY, "estimate", str(path), "--json", f"{path}.json")
    matrix = 16 * (LENGTH // 2 + 1) * n_sensors**2 / 1e6
    return Row(
        f"memory of the whole command, {n_sensors} sensors of one channel × {RATE} Hz",
        float(memory.split()[-1]),
        "MB",
        at_most=500.0,
        note=f"all cross-spectra alone take {matrix:.0f} MB",
    )


def sensor_samples(
    hours: float, *, rate: int = RATE, ppm: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Triaxial sensors on one white motion, in counts, each sampled by its own clock."""
    rng = np.random.default_rng(0)
    n_samples = round(hours * 3600 * rate)
    motion = rng.standard_normal((n_samples, 3), dtype=np.float32)
    samples = np.empty((n_samples, 3 * len(ppm)), dtype=np.int32)
    for sensor in range(len(ppm)):
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
    axes: str = "xyz",
) -> Path:
    """Write the samples as a recording of sensors of these axes, by one clock or by one each."""
    shared = len(set(ppm)) == 1
    layouts = [
        SensorLayout(
            name,
            tuple(Channel(name=axis, sensitivity=1e5) for axis in axes),
            float(rate),
            np.dtype(np.int32),
            clock="one" if shared else name,
        )
        for name in (f"s{number:02}" for number in range(len(ppm)))
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
                samples[: len(begins) * length, len(axes) * number : len(axes) * (number + 1)],
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


def _inflating(path: Path) -> float:
    """Return what inflating takes for all samples of a recording, one stream after the other."""
    streams = []
    with h5py.File(path, "r") as file:
        for sensor in file["sensors"].values():
            rows = sensor["samples"]
            chunks = range(0, len(rows), rows.chunks[0])
            read = (rows.id.read_direct_chunk((first, 0)) for first in chunks)
            streams += [stream for skipped, stream in read if not skipped]  # others are raw

    def inflate() -> None:
        for stream in streams:
            isal_zlib.decompress(stream)

    return least_work(inflate, repeats=2)[0]


def command(path: Path, *options: str) -> None:
    """Run the whole command."""
    run_python("-m", "tui", "estimate", str(path), *options, "--json", f"{path}.json")


def run_python(*arguments: str) -> str:
    """Return what a Python process prints; modules it imports are compiled already."""
    kept = {key: text for key, text in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    return subprocess.run(
        [sys.executable, *arguments], check=True, capture_output=True, text=True, env=kept
    ).stdout


def csd_loop(samples: np.ndarray, **options: Any) -> None:  # noqa: ANN401 - of scipy's csd
    """Take all cross-spectra of nine channels one by one, as a script would."""
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
    return float(run_python("-c", MEMORY, str(path)))
