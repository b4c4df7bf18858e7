"""A simulated archive of ten years of nine channels, and what its answers cost.

``python -m benchmarks.studies.ten_years FOLDER`` writes 3653 daily recordings of three triaxial
sensors at 100 Hz (segments of 10 s, hours) with the archive's own writer, asks the archive as a
user does, each answer in a process of its own, and prints the table of
``docs/validation/archives.md``. An archive that is there is asked again.

Matrices are drawn, not estimated from samples: those of days as after ``--thin-after``. Sensor B
steps in its channel X by 0.3 dB, channel Z of sensor C drifts by 0.5 dB a year, and five weeks of
the fourth year have no recordings. Ground motion has a year, a working day and a microseism.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.archive.averages import Estimator
from daq.archive.plan import Plan
from daq.archive.rollup import (
    BOUND,
    BOUND_DEVIATION,
    DEVIATION,
    MEAN,
    N_FIELDS,
    RECORDED,
    SKEWNESS,
    TAIL,
    Grid,
    month_of,
)
from daq.archive.spectra_file import DAY_NS, Described, Origin, SpectraWriter, Summary
from daq.archive.store import Store
from daq.bench.channel import Channel
from daq.estimation.settings import Settings

FloatArray = NDArray[np.float64]

FIRST_NS = 16_801 * DAY_NS  # 2016-01-01
N_DAYS = 3653
RATE, SEGMENT = 100.0, 10.0
SENSORS, AXES = "ABC", "XYZ"
NOISE = 1e-14
"""(m/s²)²/Hz at 1 Hz."""
STEP_DAY, STEP_DB, DRIFT_DB = 2100, 0.3, 0.5
MISSING = range(1200, 1235)
ANSWERS: dict[str, Sequence[str]] = {
    "tables": (),
    "JSON": ("--json", "answer.json"),
    "CSV of days": ("--csv", "days.csv"),
    "a band": ("--band", "1:20"),
    "a time zone (roll-ups of its own, made before)": ("--time-zone", "Europe/London"),
}
_MB = 1024


class _Truth:
    """Motion and noise of a day, on the archive's frequencies and fine bands."""

    def __init__(self, estimator: Estimator) -> None:
        self.grid = Grid.of(estimator)
        self.frequency = np.maximum(estimator.welch.frequencies, 0.05)
        self._rng = np.random.default_rng(1)
        self.per_hour = int(3600 / SEGMENT / 0.5)

    def noise(self, day: int) -> FloatArray:
        """Return the noise of each channel, shape (n_freqs, 9)."""
        f = self.frequency[:, None]
        level = np.tile(NOISE * (1 + 0.2 / f + (f / 30) ** 2), (1, 9))
        level *= 10 ** (np.arange(9) / 30)
        level[:, 3] *= 10 ** (STEP_DB / 10 * (day >= STEP_DAY))
        level[:, 8] *= 10 ** (DRIFT_DB / 10 * day / 365.25)
        return np.asarray(level)

    def motion(self, day: int, hour: int) -> FloatArray:
        """Return the motion along each axis, shape (n_freqs, 3)."""
        season = 6 * np.cos(2 * np.pi * day / 365.25)
        work = 8.0 * (7 <= hour < 19) * ((day + 4) % 7 < 5)
        f = self.frequency
        microseism = 1e-12 * np.exp(-(np.log(f / 0.2) ** 2)) * 10 ** (season / 10)
        city = 3e-13 * np.exp(-(np.log(f / 8) ** 2)) * 10 ** (work / 10)
        return np.outer(microseism + city + 1e-13, [1.0, 0.8, 1.3])

    def written(self, store: Store, number: int) -> None:
        """Write the file of a day."""
        rng, grid, n = self._rng, self.grid, self.per_hour
        begin = FIRST_NS + number * DAY_NS
        noise = self.noise(number)
        motion = np.stack([self.motion(number, hour) for hour in range(24)])
        own = grid.mean(noise)
        deviation = own * np.sqrt(2 / (n * grid.n_bins[:, None]))
        hours = own + deviation * rng.standard_normal((24, *own.shape))
        recorded = np.stack([grid.mean(np.tile(each, (1, 3)) + noise) for each in motion])
        recorded *= 10 ** (0.15 * rng.standard_normal((24, 1, 1)))
        row = np.zeros((N_FIELDS, *own.shape))
        row[MEAN], row[DEVIATION] = hours.mean(axis=0), deviation / np.sqrt(24)
        row[SKEWNESS], row[TAIL] = 2 / np.sqrt(24 * n), 6 / (24 * n)
        row[BOUND], row[BOUND_DEVIATION] = 1.5 * row[MEAN], 1.5 * row[DEVIATION]
        row[RECORDED] = recorded.mean(axis=0)
        csm = self._matrices(motion.mean(axis=0), noise, 24 * n)
        days = np.array([begin], np.int64)
        summary = Summary(
            starts=begin + 3600 * 10**9 * np.arange(24, dtype=np.int64),
            n_segments=np.full(24, n, np.int64),
            noise=hours.astype(np.float32),
            recorded=recorded.astype(np.float32),
            changed=np.zeros_like(hours, np.float32),
            days=days,
            day_segments=np.array([24 * n], np.int64),
            levels=row[:, None].astype(np.float32),
            total=csm * 24 * n,
        )
        run = f"{number:08d}"
        described = Described(
            origin=Origin(run, f"{run}.h5", 148_000_000, begin, 3 * 8_640_000, closed=True),
            channels=channels(),
            usable=RATE / 2,
            elapsed=86400.0,
        )
        path = store.folder / month_of(begin)[:4] / f"{run}.h5"
        path.parent.mkdir(exist_ok=True)
        with SpectraWriter(path, n_freqs=len(csm), n_channels=9, daily=True) as writer:
            writer.append(begin, 24 * n, csm)
            writer.commit(described, [(month_of(begin), summary)])

    def _matrices(self, motion: FloatArray, noise: FloatArray, n: int) -> NDArray[np.complex128]:
        """Draw the mean of n matrices: nearly normal about their expectation."""
        axis = np.tile(np.arange(3), 3)
        true = motion[:, axis][:, :, None] * (axis[:, None] == axis)
        true[:, np.arange(9), np.arange(9)] += noise
        root = np.linalg.cholesky(true)
        draw = self._rng.standard_normal((2, *true.shape)) / np.sqrt(2 * n)
        error = draw[0] + 1j * draw[1]
        error = (error + error.conj().swapaxes(1, 2)) / np.sqrt(2)
        found = true + root @ error @ root.swapaxes(1, 2)
        return np.asarray((found + found.conj().swapaxes(1, 2)) / 2)


def channels() -> tuple[tuple[str, Channel], ...]:
    """Return the nine channels."""
    return tuple(
        (sensor, Channel(name=axis, sensitivity=1e9, unit="m/s²"))
        for sensor in SENSORS
        for axis in AXES
    )


def written(folder: Path, n_days: int = N_DAYS) -> Store:
    """Write the archive."""
    plan = Plan(
        settings=Settings(segment=SEGMENT, methods=("three-sensor",), equalise="off", bridge=0.0),
        stretch="hour",
        sampling_rate=RATE,
        sensors=tuple((s, tuple((axis, "m/s²") for axis in AXES)) for s in SENSORS),
    )
    store = Store.create(folder, plan)
    truth = _Truth(Estimator(plan, plan.noise_settings(plan.settings), channels()))
    for number in range(n_days):
        if number not in MISSING:
            truth.written(store, number)
    return store


def cost(store: Path, options: Sequence[str]) -> tuple[float, float]:
    """Return processor time in s and peak memory in MB of one command."""
    program = (
        "import os, re, sys; from tui.commands.main import main\n"
        "try: main()\n"
        "finally:\n"
        "  status = open('/proc/self/status').read()\n"
        "  print(sum(os.times()[:2]), re.findall(r'VmHWM:\\s*(\\d+)', status)[0], file=sys.stderr)"
    )
    command = [sys.executable, "-c", program, "archive", "--store", str(store), *options]
    with tempfile.TemporaryDirectory() as place:
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=place,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip
    seconds, peak = done.stderr.splitlines()[-1].split()
    return float(seconds), int(peak) / _MB


def main() -> None:
    """Write the archive if it is not there, and print what answers cost."""
    parser = argparse.ArgumentParser(prog="benchmarks.studies.ten_years", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--days", type=int, default=N_DAYS)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    if Store.open(given.folder) is None:
        written(given.folder, given.days)
    print("| answer | CPU (least) | CPU (median) | peak memory |\n|---|---|---|---|")
    for name, options in ANSWERS.items():
        runs = [cost(given.folder, options) for _ in range(given.repeats + 1)]
        first, *rest = runs
        seconds = sorted(each[0] for each in rest)
        print(
            f"| {name} | {seconds[0]:.2f} s (first: {first[0]:.1f} s) |"
            f" {seconds[len(seconds) // 2]:.2f} s | {max(each[1] for each in runs):.0f} MB |",
            flush=True,
        )


if __name__ == "__main__":
    main()
