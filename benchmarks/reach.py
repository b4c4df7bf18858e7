"""What an estimate is to cost, each figure beside its limit: short, long, of many sensors.

Recordings are of triaxial sensors. Ratios are of processor times within one run, by turns.
"""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import scipy.fft

from benchmarks.estimate_file import (
    COMMAND_MEMORY,
    LENGTH,
    RATE,
    command,
    csd_loop,
    recorded_file,
    run_python,
    sensor_samples,
)
from benchmarks.row import Row, least_work
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from estimator.checks.count_limits import CountLimits

LIBRARIES = "import numpy, h5py, typer, rich"
FREE = (0.0, 15.0, -20.0)
"""How far clocks of three sensors are off, in ppm."""
SENSORS, MANY_RATE, MANY_HOURS = (8, 16, 32), 100, 0.5
HOURS, DAY, DAY_RATE = 3.0, 24.0, 40
SHORT = 0.05
"""Hours of the smallest form."""
_UNTESTED: dict[str, object] = {
    "estimator.checks.diagnose.stability": None,
    "estimator.checks.diagnose.shared_noise": None,
    "daq.estimation.snapshot_builder.nonlinear_channels": ((), (), None),
    "daq.estimation.snapshot_builder.limits_by_column": CountLimits(),
    "daq.estimation.snapshot_builder.still_for_a_while": {},
    "daq.estimation.equalisation.Equalisation.leakage": None,
}
"""Tests of what an estimate assumes, and what they find if that holds."""
_ONLY_OWN = "import sys\nsys.modules.update(cryptography=None, lxml=None)\n"
"""Without packages that PDF reports load where they are installed, and do not need."""


def run(*, smallest: bool = False) -> list[Row]:
    """Return the rows."""
    repeats = 1 if smallest else 3
    with tempfile.TemporaryDirectory() as folder:
        return [
            *_four_minutes(Path(folder), repeats),
            *_three_hours(Path(folder), SHORT if smallest else HOURS, repeats),
            *_many_sensors(Path(folder), SENSORS[:1] * 3 if smallest else SENSORS),
            *_two_cores(Path(folder), SHORT if smallest else DAY, repeats),
        ]


def _untested(path: Path) -> None:
    """Estimate without the tests of what is assumed."""
    with ExitStack() as stack:
        for name, found in _UNTESTED.items():
            stack.enter_context(mock.patch(name, return_value=found))
        estimate([path], Settings())


def _four_minutes(folder: Path, repeats: int) -> list[Row]:
    nominal = recorded_file(folder / "nominal.h5", sensor_samples(4 / 60))
    free = recorded_file(folder / "free.h5", sensor_samples(4 / 60, ppm=FREE), ppm=FREE)
    report = ("report", str(nominal), "--out", str(folder / "report.pdf"), "--force")
    libraries, whole, without, paper, one, three, untested = least_work(
        partial(run_python, "-c", LIBRARIES),
        partial(command, nominal),
        partial(run_python, "-m", "tui", "estimate", str(nominal)),
        partial(run_python, "-m", "tui", *report),
        partial(estimate, [nominal], Settings()),
        partial(estimate, [free], Settings()),
        partial(_untested, nominal),
        repeats=2 * repeats + 1,
    )
    memory = float(run_python("-c", _ONLY_OWN + COMMAND_MEMORY, *report).split()[-1])
    return [
        Row(
            "4 min: the command, against importing numpy, h5py, typer, rich",
            whole / libraries,
            "×",
            at_most=1.9,
            note=f"{whole:.2f} s against {libraries:.2f} s",
        ),
        Row("4 min: JSON of nine channels, of the command", 1 - without / whole, "", at_most=0.05),
        Row("4 min, one process: three free clocks against nominal ones", three / one, "×", 2.0),
        Row("4 min, one process: tests of assumptions against without", one / untested, "×", 1.1),
        Row("4 min: report as PDF", paper, "s", at_most=2.5),
        Row("4 min: memory of the PDF, without lxml and cryptography", memory, "MB", at_most=150.0),
    ]


def _three_hours(folder: Path, hours: float, repeats: int) -> list[Row]:
    samples = sensor_samples(hours)
    moved = recorded_file(folder / "moved.h5", samples)
    noise = 1e3 * np.random.default_rng(1).standard_normal(samples.shape, dtype=np.float32)
    still = recorded_file(folder / "still.h5", noise.astype(np.int32))
    free = recorded_file(folder / "free-3h.h5", sensor_samples(hours, ppm=FREE), ppm=FREE)
    frames = np.lib.stride_tricks.sliding_window_view(samples, LENGTH, axis=0)[:: LENGTH // 2]

    def transforms() -> None:
        for first in range(0, len(frames), 24):
            scipy.fft.rfft(frames[first : first + 24] * np.hanning(LENGTH), axis=-1)

    boxcar = ("--window", "rectangular", "--overlap", "0")
    loop, loop_boxcar = least_work(
        partial(csd_loop, samples),
        partial(csd_loop, samples, window="boxcar", noverlap=0),
        repeats=1,
    )
    bare, hann, rectangular, unmoved, octaves, reject, three, one, untested = least_work(
        transforms,
        partial(command, moved),
        partial(command, moved, *boxcar),
        partial(command, still),
        partial(command, moved, "--octaves"),
        partial(command, moved, "--reject"),
        partial(estimate, [free], Settings()),
        partial(estimate, [moved], Settings()),
        partial(_untested, moved),
        repeats=repeats,
    )
    what = f"{hours:g} h × 9 × {RATE} Hz"
    return [
        Row(f"{what}, rectangular: csd loop against the command", loop_boxcar / rectangular, "×",
            at_least=4.5, note=f"{rectangular:.2f} s"),
        Row(f"{what}, Hann 50 %: csd loop against the command", loop / hann, "×", at_least=7.0,
            note=f"{hann:.2f} s"),
        Row(f"{what}: without motion against with it", unmoved / hann, "×", at_most=1.2),
        Row(f"{what}: three free clocks against bare FFTs, imports taken off", three / bare, "×",
            at_most=9.0, note=f"{three:.2f} s"),
        Row(f"{what}, one process: tests of assumptions against without", one / untested, "×", 1.1),
        Row(f"{what}: --octaves against the default", octaves / hann, "×", at_most=2.5),
        Row(f"{what}: --reject against the default", reject / hann, "×", at_most=1.5),
    ]  # fmt: skip


def _many_sensors(folder: Path, numbers: tuple[int, ...]) -> list[Row]:
    paths = [
        recorded_file(
            folder / f"{place}.h5",
            sensor_samples(MANY_HOURS / 10 if numbers[0] == numbers[-1] else MANY_HOURS,
                           rate=MANY_RATE, ppm=(0.0,) * number),
            rate=MANY_RATE,
            ppm=(0.0,) * number,
        )
        for place, number in enumerate(numbers)
    ]  # fmt: skip
    few, more, most = least_work(
        *(partial(estimate, [path], Settings()) for path in paths), repeats=1
    )
    few_name, more_name, most_name = numbers
    return [
        Row(f"{more_name} triaxial sensors against {few_name}", more / few, "×", at_most=3.0),
        Row(f"{most_name} triaxial sensors against {more_name}", most / more, "×", at_most=3.5),
        Row(f"{most_name} triaxial sensors", most, "s", at_most=12.0),
    ]


def _two_cores(folder: Path, hours: float, repeats: int) -> list[Row]:
    path = recorded_file(folder / "day.h5", sensor_samples(hours, rate=DAY_RATE), rate=DAY_RATE)
    allowed = os.sched_getaffinity(0)

    def wall(n_cores: int) -> float:
        os.sched_setaffinity(0, sorted(allowed)[:n_cores])
        try:
            begin = time.perf_counter()
            command(path, "--jobs", str(n_cores))
            return time.perf_counter() - begin
        finally:
            os.sched_setaffinity(0, allowed)

    one, two = (min(wall(n_cores) for _ in range(repeats)) for n_cores in (1, 2))
    main, every = time.thread_time(), time.process_time()
    estimate([path], Settings())
    of_main = (time.thread_time() - main) / (time.process_time() - every)
    return [
        Row(
            f"{hours:g} h on two cores, --jobs 2, against one: wall clock",
            two / one,
            "×",
            at_most=0.65,
        ),
        Row(f"{hours:g} h: main thread, of all processor time", of_main, "", at_most=0.55),
    ]
