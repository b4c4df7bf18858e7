"""Recordings of free-running sensors, straight from the model, and the study of their clocks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from daq.bench_model import Channel
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recording.layout import SensorLayout
from daq.recording.writer import RecordingWriter
from sim_devices.scenario import Scenario

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

ORIGIN = HostTime(5_000_000_000_000, 1_790_000_000_000_000_000)
SENSITIVITY = 1e8  # counts per m/s²: quantisation 60 dB under the noise


@dataclass(frozen=True, slots=True)
class Latency:
    """How long after its last sample a block arrives.

    ``exponential``: `shortest` plus an exponential with mean `spread`. ``batching``: at the next
    poll of a USB adapter, every `spread` seconds, plus `shortest` and 50 µs of jitter.
    """

    kind: Literal["exponential", "batching"] = "exponential"
    spread: float = 1e-3
    shortest: float = 4e-4

    def arrivals(self, instants: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return when blocks arrive whose last samples were taken at `instants`, in order."""
        if self.kind == "exponential":
            arrival = instants + self.shortest + rng.exponential(self.spread, len(instants))
        else:
            phase = rng.uniform(0, self.spread)
            arrival = np.ceil((instants - phase) / self.spread) * self.spread + phase
            arrival = arrival + self.shortest + rng.exponential(5e-5, len(instants))
        return np.maximum.accumulate(arrival)


def synthesise(
    path: str | Path,
    scenario: Scenario,
    *,
    duration: float,
    latency: Latency | None = None,
    block: float = 0.1,
    seed: int = 1,
    clock: str | None = None,
) -> Path:
    """Write the recording that a bench of this scenario would have given.

    Parameters
    ----------
    path : path
    scenario : Scenario
    duration : float
        Seconds of world time.
    latency : Latency, optional
        Exponential by default.
    block : float
        Seconds of samples a block holds.
    seed : int
        Of the latencies.
    clock : str, optional
        Name of the one clock they share; each has its own where not given.
    """
    latency = latency or Latency()
    layouts = [
        SensorLayout(
            name=name,
            channels=tuple(
                Channel(name="xyz"[number], sensitivity=SENSITIVITY)
                for number in range(scenario.n_channels(name))
            ),
            sampling_rate=scenario.sensors[name].sampling_rate,
            dtype=np.dtype(np.int32),
            clock=clock or name,
        )
        for name in scenario.names
    ]
    writer = RecordingWriter.create(path, sensors=layouts, created=ORIGIN, chunk_seconds=10.0)
    rng = np.random.default_rng(seed)
    for layout in layouts:
        begin = scenario.sensors[layout.name].clock.offset
        length = max(1, round(block * layout.sampling_rate))
        n_blocks = int((duration - begin) * layout.sampling_rate) // length
        instants = scenario.sample_times(layout.name, 0, n_blocks * length)[length - 1 :: length]
        for each in _blocks(scenario, layout.name, length, latency.arrivals(instants, rng)):
            writer.append(each)
    writer.close()
    return Path(path)


def _blocks(scenario: Scenario, name: str, length: int, arrivals: FloatArray) -> Iterator[Block]:
    """Yield the blocks of one sensor, each `length` samples, that arrive then (world seconds)."""
    arrivals_ns = np.round(arrivals * 1e9).astype(np.int64).tolist()
    at_once = max(1, 20_000 // length)
    for first in range(0, len(arrivals_ns), at_once):
        some = arrivals_ns[first : first + at_once]
        samples = scenario.samples(name, first * length, len(some) * length)
        counts = np.round(samples * SENSITIVITY).astype(np.int32)
        for number, arrival in enumerate(some):
            yield Block(
                name,
                (first + number) * length,
                counts[number * length : (number + 1) * length],
                HostTime(ORIGIN.monotonic_ns + arrival, ORIGIN.utc_ns + arrival),
                flags=BlockFlag.NONE if first + number else BlockFlag.CLOCK_RESTART,
            )


def free_running(
    *, n_dims: int = 2, snr: float = 1e4, duration: float = 3600.0, seed: int = 1
) -> Scenario:
    """Return three misaligned sensors with clocks 0, +15 and -20 ppm, wandering, one stepping.

    Motion is white with ``S_y = 1.5 S_x``; noise is white, `snr` below the weakest direction.
    Clocks wander 0.2 ppm over an hour, and the second settles 2 ppm away in the middle.
    """
    level = 1e-9
    table: dict[str, Any] = {
        "seed": seed,
        "motion": {
            "spectra": [
                {"shape": "white", "level": level * factor} for factor in (1.0, 1.5, 1.2)[:n_dims]
            ]
        },
        "sensors": {},
    }
    turns = ((0.0, 0.0, 0.0), (10.0, 4.0, -3.0), (-7.0, 2.0, 5.0))
    clocks: tuple[dict[str, Any], ...] = (
        {"ppm": 0.0, "wander": 0.2},
        {
            "ppm": 15.0,
            "wander": 0.2,
            "offset": 0.0321,
            "step": {"time": duration / 2, "ppm": 2.0, "time_constant": 60.0},
        },
        {"ppm": -20.0, "wander": 0.2, "offset": 0.0573},
    )
    for name, turn, clock in zip("ABC", turns, clocks, strict=True):
        table["sensors"][name] = {
            "rotation": {1: 0.0, 2: turn[0], 3: turn}[n_dims],
            "noise": {"shape": "white", "level": level / snr},
            "clock": clock,
        }
    return Scenario.from_dict(table, sampling_rate=200.0)
