"""Recordings of sensors with clocks of their own, straight from the model, without devices."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World

FloatArray = NDArray[np.float64]

ORIGIN = HostTime(5_000_000_000_000, 1_790_000_000_000_000_000)
SENSITIVITY = 1e8  # counts per m/s²: quantisation 60 dB under the noise


@dataclass(frozen=True, slots=True)
class Latency:
    """How long after its last sample a block arrives.

    ``exponential``: `shortest` plus an exponential with mean `spread`. ``batching``: at the next
    poll of a USB adapter, every `spread` seconds, plus `shortest` and 50 µs of jitter. On a loaded
    host a share `stalled` of blocks waits for an exponential time of mean `stall` besides.
    """

    kind: Literal["exponential", "batching"] = "exponential"
    spread: float = 1e-3
    shortest: float = 4e-4
    stalled: float = 0.0
    stall: float = 0.05

    def arrivals(self, instants: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return when blocks arrive whose last samples were taken at `instants`, in order."""
        if self.kind == "exponential":
            arrival = instants + self.shortest + rng.exponential(self.spread, len(instants))
        else:
            phase = rng.uniform(0, self.spread)
            arrival = np.ceil((instants - phase) / self.spread) * self.spread + phase
            arrival = arrival + self.shortest + rng.exponential(5e-5, len(instants))
        late = rng.uniform(size=len(instants)) < self.stalled
        arrival = arrival + np.where(late, rng.exponential(self.stall, len(instants)), 0.0)
        return np.maximum.accumulate(arrival)


def synthesise(
    path: str | Path,
    scenario: Scenario,
    *,
    duration: float,
    latency: Latency | None = None,
    block: float = 0.1,
    seed: int = 1,
    instants: bool = False,
    utc: Mapping[str, float] | None = None,
    has_gps: bool = True,
    lost: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    restarts: bool = False,
    computer_ppm: float = 0.0,
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
    instants : bool
        Store when each sample was really taken, as no device could.
    utc : mapping of str to float, optional
        Sensors that state UTC themselves, and by how many seconds the host's is behind theirs.
    has_gps : bool
        Whether they state the UTC of their samples. Else it is that of the nominal rate from their
        first sample on, as that of a digitizer without GPS.
    lost : mapping of str to sequence of (float, float), optional
        Begin and end, in seconds of a sensor's own count, of samples whose blocks never arrive.
    restarts : bool
        Whether clocks restart after each loss, as where nobody knows how many samples were lost.
    computer_ppm : float
        By how much the computer's clock, of arrival times, runs fast.
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
            clock=name,
        )
        for name in scenario.names
    ]
    rng = np.random.default_rng(seed)
    world = World(scenario)
    with ArrayWriter(path, sensors=layouts, created=ORIGIN) as writer:
        for layout in layouts:
            begin, rate = scenario.sensors[layout.name].clock.offset, layout.sampling_rate
            length = max(1, round(block * layout.sampling_rate))
            n_blocks = int((duration - begin) * layout.sampling_rate) // length
            ends = world.sample_times(layout.name, 0, n_blocks * length)[length - 1 :: length]
            arrivals_ns = _ns(latency.arrivals(ends, rng) * (1 + computer_ppm * 1e-6))
            start = world.sample_times(layout.name, 0, 1)[0]
            behind = (utc or {}).get(layout.name)
            at_once = max(1, 20_000 // length)
            arrived = np.ones(n_blocks, dtype=bool)
            for low, high in (lost or {}).get(layout.name, ()):
                first, last = (int(at * layout.sampling_rate) // length for at in (low, high))
                arrived[first : last + 1] = False
            for number, stop in _pieces(arrived, at_once):
                if not arrived[number]:
                    n_lost = (stop - number) * length
                    writer.gap(layout.name, number * length, n_lost, reason="counter")
                    continue
                received_ns = arrivals_ns[number:stop]
                first, n_samples = number * length, len(received_ns) * length
                samples = world.samples(layout.name, first, n_samples)
                times = world.sample_times(layout.name, first, n_samples)
                stated = times if has_gps else start + np.arange(n_samples) / rate + first / rate
                writer.samples(
                    layout.name,
                    np.round(samples * SENSITIVITY).astype(np.int32),
                    first_sample=first,
                    restart=number == 0 or (restarts and not arrived[number - 1]),
                    block_rows=length,
                    received_ns=received_ns,
                    utc_ns=None if behind is None else _ns(stated[::length] + behind),
                    instants_ns=_ns(times) if instants else None,
                )
    return Path(path)


def _pieces(arrived: NDArray[np.bool_], longest: int) -> Iterator[tuple[int, int]]:
    """Yield first block and end of stretches of blocks that all arrived, or were all lost."""
    edges = [0, *(np.flatnonzero(np.diff(arrived)) + 1).tolist(), len(arrived)]
    for low, high in itertools.pairwise(edges):
        for number in range(low, high, longest if arrived[low] else high - low):
            yield number, min(number + longest, high) if arrived[low] else high


def _ns(seconds: FloatArray) -> NDArray[np.int64]:
    return np.round(seconds * 1e9).astype(np.int64)
