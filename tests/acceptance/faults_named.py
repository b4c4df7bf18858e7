"""How soon the application names what is wrong with a test.

`python -m tests.acceptance.faults_named [SEEDS]`: simulated live tests of the demo's bench.
One sensor is on another floor, has two channels swapped, or one that is dead or clips, from the
start or from some time on. The recording grows by a second at a time; each time the lines are made
that the Test view shows. Prints how many seconds of recording it took from the fault to its line.
Not run by pytest: five seeds take some minutes.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.estimation.estimation import Estimation
from daq.estimation.settings import Settings
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recording.monitor import RecordingMonitor
from daq.recording.reader import Recording
from daq.results.result import Result
from estimator.types import FloatArray
from sim_devices.world.world import World
from tests.tui.example_snapshot import demo_bench, growing
from tui.application.following import CURVE_GROWTH
from tui.application.test_view.panels import alerts, findings
from tui.application.test_view.recent_motion import RecentMotion, with_advice
from tui.simulation.devices import scenario_of

RATE, COUNTS = 200, 1710799.9
LONGEST = 150
"""Seconds after the fault."""
COMMITTED = 2.0
"""Seconds by which the file lies behind the sensors, at most."""


@dataclass(frozen=True, slots=True)
class Case:
    """A fault, what its line says, and the second from which on it is there.

    `change` takes the samples of a sensor in m/s², and those of another floor.
    """

    name: str
    sensor: str
    words: str
    change: Callable[[FloatArray, FloatArray], FloatArray]
    at: int = 0


def _dead(samples: FloatArray, _: FloatArray) -> FloatArray:
    return samples * (1.0, 0.0, 1.0)


def _clipping(samples: FloatArray, _: FloatArray) -> FloatArray:
    most = 2 * np.std(samples, axis=0)
    return np.clip(samples, -most, most)


def _flag(case: Case, name: str, second: int) -> BlockFlag:
    """Return what the driver, which knows the full scale, flags a block with."""
    if case.change is not _clipping or name != case.sensor or second < case.at:
        return BlockFlag.NONE
    return BlockFlag.CLIPPED


CASES = (
    *(Case("on another floor", "C", "C records none", lambda _, o: o, at) for at in (0, 300)),
    Case("two channels swapped", "B", "channels are swapped", lambda s, _: s[:, [1, 0, 2]]),
    *(Case("dead channel", "A", "A.Y is stuck", _dead, at) for at in (0, 60)),
    *(Case("clipping", "B", "B is clipping", _clipping, at) for at in (0, 60)),
)


def seconds_to_name(case: Case, seed: int) -> tuple[float, str]:
    """Return the seconds from the fault to its line; infinity where it did not come."""
    n = (case.at + LONGEST) * RATE
    bench = demo_bench()
    for sensor in bench.simulation["sensors"].values():
        del sensor["clock"]  # all blocks arrive at whole seconds
    scenario = scenario_of(bench)
    here, other = (
        World(scenario.model_copy(update={"seed": each})) for each in (seed, seed + 1000)
    )
    samples = {name: here.samples(name, 0, n) for name in scenario.names}
    faulty, start = samples[case.sensor], case.at * RATE
    faulty[start:] = case.change(faulty[start:], other.samples(case.sensor, 0, n)[start:])
    recent, begun = RecentMotion(), SystemClock().now()
    with tempfile.TemporaryDirectory() as folder, growing(Path(folder) / "run.h5") as writer:
        recording = Recording.open(writer.path)
        with Estimation([recording], diagnosis_share=1.0, live=True) as estimation:
            monitor, wanted = RecordingMonitor(recording), 0.0
            found: list[str] = []
            for second in range(case.at + LONGEST):
                ns = (second + 1) * 10**9
                at = HostTime(begun.monotonic_ns + ns, begun.utc_ns + ns)
                for name, values in samples.items():
                    block = np.rint(values[second * RATE : (second + 1) * RATE] * COUNTS)
                    flags = _flag(case, name, second)
                    block = block.astype(np.int32)
                    writer.append(Block(name, second * RATE, block, at, flags=flags))
                writer.commit()
                recording.refresh()
                estimation.update()
                status = monitor.status_with_stuck_channels()
                lines = [*alerts(status, None)]
                if estimation.n_seen >= wanted:
                    wanted = max(estimation.n_seen + 1, estimation.n_seen * (1 + CURVE_GROWTH))
                    snapshot = estimation.snapshot()
                    snapshot = with_advice(snapshot, recent.strangers(snapshot))
                    found = [
                        line.plain for line in findings(Result(snapshot, Settings()), width=200)
                    ]
                for line in lines + found:
                    if case.words in line and second >= case.at:
                        return second + 1 - case.at + COMMITTED, line
    return float("inf"), "; ".join(found)


def main(n_seeds: int) -> None:
    """Print a line for each case."""
    for case in CASES:
        results = [seconds_to_name(case, seed) for seed in range(1, n_seeds + 1)]
        took = ", ".join(f"{seconds:.0f}" for seconds, _ in results)
        print(f"{case.name} from {case.at} s: {took} s\n  {results[0][1]}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
