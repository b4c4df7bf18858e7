"""``huddle simulate``: a recording from the model, without devices."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from daq.bench.channel import Channel
from daq.bench.model import Bench, Sensor
from daq.devices.bench_file import load
from daq.devices.registry import driver_type
from daq.protocols.block import EventKind, HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SIMULATED, SensorLayout
from estimator.types import FloatArray
from sim_devices.errors import ScenarioError
from sim_devices.world import paper_scenarios
from sim_devices.world.scenario import Scenario
from sim_devices.world.tables import SensorClock
from sim_devices.world.world import World
from tui.output.console import for_people, progress, write_json
from tui.simulation.devices import scenario_of

DEFAULT_DURATION = 600.0
BLOCK_SECONDS = 1.0
CHUNK_SECONDS = 10.0
HEADROOM = 30.0
"""Full scale of a named scenario over the rms of a channel."""
DIRECTIONS = ("X", "Y", "Z")


def simulate_recording(
    scenario: str, *, out: Path, duration: float | None, json: str | None
) -> None:
    """Write a recording of a scenario, given by its name or by a bench file.

    Raises
    ------
    ScenarioError
        No scenario and no file has this name.
    BenchFileError
        The bench file has no simulation, or one for other sensors.
    RecordingError
        The recording exists or cannot be written.
    """
    bench, world = described(scenario)
    seconds = duration or bench.recording.duration or DEFAULT_DURATION
    with progress() as bar:
        task = bar.add_task("simulating", total=seconds)
        write(
            out,
            bench,
            world,
            duration=seconds,
            progress=lambda s: bar.update(task, completed=s),
        )
    for_people(json).print(f"{out}: {seconds:g} s of {', '.join(world.names)}, simulated")
    write_json(
        json,
        {
            "file": str(out),
            "scenario": world.to_dict(),
            "duration": seconds,
            "sampling_rate": {name: model.sampling_rate for name, model in world.sensors.items()},
        },
    )


def write(
    out: Path,
    bench: Bench,
    scenario: Scenario,
    *,
    duration: float,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write a recording whose blocks were received as their last samples were taken.

    Parameters
    ----------
    out
        Must not exist.
    bench
        Gives sensitivities; its sensors have no auxiliary channels.
    scenario
        Holds every sensor of the bench.
    duration
        In seconds.
    progress
        Receives the number of finished seconds.
    """
    world = World(scenario)
    layouts = {sensor.name: _layout(sensor, scenario) for sensor in bench.sensors}
    with ArrayWriter(
        out,
        bench,
        sensors=tuple(layouts.values()),
        created=HostTime(time.monotonic_ns(), time.time_ns()),
        attributes={"origin": SIMULATED},
        chunk_seconds=CHUNK_SECONDS,
    ) as writer:
        writer.event(EventKind.STARTED, SIMULATED)
        for first in np.arange(0.0, duration, CHUNK_SECONDS):
            last = min(first + CHUNK_SECONDS, duration)
            for layout in layouts.values():
                begin, end = (round(at * layout.sampling_rate) for at in (first, last))
                _write_samples(writer, world, layout, begin, end)
            if progress is not None:
                progress(last)
        writer.event(EventKind.STOPPED, SIMULATED, at_ns=round(duration * 1e9))


def _write_samples(
    writer: ArrayWriter, world: World, layout: SensorLayout, first: int, last: int
) -> None:
    """Write samples `first` to `last` of one sensor, in blocks as a driver would make them."""
    sensitivity = np.array([channel.sensitivity for channel in layout.channels])
    counts = world.samples(layout.name, first, last - first) * sensitivity
    if np.issubdtype(layout.dtype, np.integer):
        limits = np.iinfo(layout.dtype)
        counts = np.clip(np.rint(counts), limits.min, limits.max)
    instants = world.sample_times(layout.name, first, last - first)
    n_block = max(1, round(BLOCK_SECONDS * layout.sampling_rate))
    ends = [min(row + n_block, last - first) - 1 for row in range(0, last - first, n_block)]
    writer.samples(
        layout.name,
        counts.astype(layout.dtype),
        first_sample=first,
        block_rows=n_block,
        received_ns=[round(float(instants[end]) * 1e9) for end in ends],
    )


def described(scenario: str) -> tuple[Bench, Scenario]:
    """Return a bench without auxiliary channels, and the world of its sensors."""
    path = Path(scenario)
    if not path.exists():
        if scenario not in paper_scenarios.SCENARIOS:
            raise ScenarioError(
                f"{scenario!r} is neither a file nor a scenario; expected a bench file, or one of"
                f" {', '.join(paper_scenarios.SCENARIOS)}"
            )
        world = paper_scenarios.named(scenario)
        return bench_of(scenario, world), world
    bench = load(path)
    sensors = tuple(
        sensor.model_copy(update={"channels": tuple(c for c in sensor.channels if not c.auxiliary)})
        for sensor in bench.sensors
    )
    return bench.model_copy(update={"sensors": sensors}), scenario_of(bench)


def bench_of(name: str, scenario: Scenario) -> Bench:
    """Return a bench for a scenario: sensitivities leave headroom over motion and noise."""
    sensors = []
    for sensor, model in scenario.sensors.items():
        full_scale = HEADROOM * _rms(scenario, sensor).max()
        sensitivity = 10.0 ** np.floor(np.log10(2**31 / full_scale))
        sensors.append(
            Sensor(
                name=sensor,
                model=SIMULATED,
                driver=SIMULATED,
                port=SIMULATED,
                sampling_rate=model.sampling_rate,
                channels=tuple(
                    Channel(name=DIRECTIONS[number], sensitivity=float(sensitivity))
                    for number in range(scenario.n_channels(sensor))
                ),
            )
        )
    rate = min(model.sampling_rate for model in scenario.sensors.values())
    return Bench(
        name=name, sampling_rate=rate, sensors=tuple(sensors), simulation=scenario.to_dict()
    )


def _rms(scenario: Scenario, sensor: str) -> FloatArray:
    """Root mean square of each channel, in m/s²."""
    step = 0.05
    frequency = np.arange(step, scenario.sensors[sensor].sampling_rate / 2, step)
    csm = World(scenario).true_csm((sensor,), frequency)
    return np.asarray(np.sqrt(np.einsum("fcc->c", csm).real * step))


def _layout(sensor: Sensor, scenario: Scenario) -> SensorLayout:
    shared = scenario.sensors[sensor.name].clock == SensorClock()
    counts: np.dtype[np.generic] = np.dtype(np.int32)
    if sensor.driver != SIMULATED:
        counts = driver_type(sensor.driver).counts_dtype(sensor)
    return SensorLayout.of(sensor, counts, "world" if shared else sensor.name)
