"""Recordings straight from the model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from daq.errors import BenchFileError, RecordingError
from daq.recording.reader import Recording
from sim_devices.errors import ScenarioError
from sim_devices.world import paper_scenarios
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World
from tui.simulation.write_recording import bench_of, simulate_recording, write

BENCH = Path(__file__).parents[3] / "tui" / "resources" / "bench.toml"


def test_a_recording_holds_what_the_sensors_read_to_a_count(tmp_path: Path) -> None:
    out = tmp_path / "model.h5"
    said = tmp_path / "said.json"
    simulate_recording("fig9", out=out, duration=25.0, json=str(said))
    scenario = paper_scenarios.fig9()
    world = World(scenario)
    recording = Recording.open(out)
    assert recording.closed
    assert [sensor.name for sensor in recording.sensors] == list(scenario.names)
    for sensor in recording.sensors:
        assert sensor.n_samples == 5000
        sensitivity = [channel.sensitivity for channel in sensor.channels]
        away = sensor.counts(0, 5000) - world.samples(sensor.name, 0, 5000) * sensitivity
        assert np.max(np.abs(away)) <= 0.5
        assert np.max(np.abs(sensor.counts(0, 5000))) > 1e7  # and counts are fine enough
    assert recording.bench is not None
    assert Scenario.from_dict(recording.bench.simulation) == scenario
    assert json.loads(said.read_text(encoding="utf-8"))["duration"] == 25.0


def test_blocks_are_received_when_a_free_clock_took_their_last_samples(tmp_path: Path) -> None:
    table = paper_scenarios.fig12().to_dict()
    table["sensors"]["j"]["clock"] = {"offset": 0.4, "ppm": 100.0, "wander": 3.0}
    scenario = Scenario.from_dict(table)
    out = tmp_path / "clocks.h5"
    write(out, bench_of("clocks", scenario), scenario, duration=12.0)
    recording = Recording.open(out)
    assert [sensor.clock for sensor in recording.sensors] == ["world", "j", "world"]
    perfect, free = (sensor.blocks for sensor in recording.sensors[:2])
    last = free["first_sample"] + free["n_samples"] - 1
    world = World(scenario)
    taken = np.array([world.sample_times("j", int(n), 1)[0] for n in last])
    assert np.all(np.abs(free["monotonic_ns"] - perfect["monotonic_ns"] - (
        np.round(taken * 1e9) - np.round(last / 200 * 1e9)
    )) <= 1)  # fmt: skip


def test_a_bench_files_own_simulation(tmp_path: Path) -> None:
    out = tmp_path / "bench.h5"
    simulate_recording(str(BENCH), out=out, duration=3.0, json=None)
    recording = Recording.open(out)
    assert [sensor.n_samples for sensor in recording.sensors] == [600] * 3
    assert recording.sensors[0].channels[0].sensitivity == 1710799.9


MIXED = """
name = "mixed"
sampling_rate = 20.0

[simulation]
motion.spectra = [{shape = "white", level = 1e-6}]
"""
SENSOR = """
[[sensors]]
name = "{name}"
driver = "text"
port = "/dev/{name}"
sampling_rate = {rate}
channels = [{{name = "x", sensitivity = 1e6}}]

[simulation.sensors.{name}]
noise = {{shape = "white", level = 1e-9}}
"""


def test_sensors_of_different_rates_have_blocks_of_a_second(tmp_path: Path) -> None:
    rates = {"A": 100.0, "B": 20.0, "C": 20.0}
    bench, out = tmp_path / "mixed.toml", tmp_path / "mixed.h5"
    text = MIXED + "".join(SENSOR.format(name=name, rate=rate) for name, rate in rates.items())
    bench.write_text(text, encoding="utf-8")
    simulate_recording(str(bench), out=out, duration=30.0, json=None)
    with Recording.open(out) as recording:
        for sensor in recording.sensors:
            blocks = sensor.blocks[:]
            assert set(blocks["n_samples"]) == {rates[sensor.name]}
            steps = np.diff(blocks["monotonic_ns"])
            assert abs(steps.mean() - 1e9) < 1e6
            ends = (blocks["monotonic_ns"] - recording.created_at.monotonic_ns) / 1e9
            np.testing.assert_allclose(ends, np.arange(1, 31), atol=1 / rates[sensor.name] + 1e-6)
    far = tmp_path / "far.toml"
    far.write_text(f"{text}clock = {{ppm = -800000.0}}\n", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"ppm.*-1000"):
        simulate_recording(str(far), out=tmp_path / "far.h5", duration=30.0, json=None)
    result = tmp_path / "wrong.toml"
    result.write_text(text + "sampling_rate = 50.0\n", encoding="utf-8")
    with pytest.raises(BenchFileError, match="is 50 Hz; expected 20 Hz, as of the sensor"):
        simulate_recording(str(result), out=tmp_path / "wrong.h5", duration=30.0, json=None)


def test_what_cannot_be_simulated_is_said_and_leaves_no_file(tmp_path: Path) -> None:
    out = tmp_path / "none.h5"
    with pytest.raises(ScenarioError, match="'fig6' is neither a file nor a scenario"):
        simulate_recording("fig6", out=out, duration=1.0, json=None)
    silent = tmp_path / "silent.toml"
    text = BENCH.read_text(encoding="utf-8")
    silent.write_text(text[: text.index("[simulation]")], encoding="utf-8")
    with pytest.raises(BenchFileError, match="simulation: is missing"):
        simulate_recording(str(silent), out=out, duration=1.0, json=None)
    assert list(tmp_path.iterdir()) == [silent]
    out.touch()
    with pytest.raises(RecordingError, match="exists already"):
        simulate_recording("fig4", out=out, duration=1.0, json=None)
