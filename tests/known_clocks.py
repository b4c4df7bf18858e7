"""Builds recordings of three sensors whose clocks, and whose noise, are known.

Shares no code with the alignment: the motion is a spectrum, made on a grid four times finer than
the fastest sensor, and read from there by splines of the fifth degree (error below -100 dB).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from daq.bench.channel import Channel
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

Motion: TypeAlias = Literal["white", "red", "coloured", "hum"]

NAMES = "ABC"
NOISE = 1.0
"""One-sided PSD of every channel's noise, unit²/Hz."""
_ORIGIN = HostTime(7_000_000_000_000, 1_468_458_000_000_000_000)
_MARGIN = 5.0  # seconds of motion before and after
_FINE = 4
_COUNTS = 1000.0  # of one standard deviation of noise
_BLOCK = 0.1  # seconds
_POLL = 0.016


@dataclass(frozen=True)
class Oscillator:
    """A clock: its rate in ppm, and a cycle of the rate, as of a heated room."""

    ppm: float = 0.0
    cycle_ppm: float = 0.0
    period: float = 600.0
    phase: float = 0.0

    def seconds(self, nominal: FloatArray) -> FloatArray:
        """Return the true time of samples, given by their number over the nominal rate."""
        turn = 2 * np.pi / self.period
        cycle = (np.cos(self.phase) - np.cos(turn * nominal + self.phase)) / turn
        return np.asarray(nominal - 1e-6 * (self.ppm * nominal + self.cycle_ppm * cycle))


STEADY = (Oscillator(), Oscillator(15.0), Oscillator(-20.0))


@dataclass(frozen=True, eq=False)
class Scene:
    """What is recorded.

    Attributes
    ----------
    slips : mapping of int to sequence of (float, int)
        By sensor: when (s), and how many samples are lost without being counted; negative: samples
        that are counted twice.
    leaps : mapping of int to sequence of (float, int)
        How many samples the count runs ahead though none is lost.
    restarts : mapping of int to (float, float, float)
        Shortest and longest time between restarts, and how long the sensor is gone, in s.
    bends : int, optional
        The sensor whose converter follows a curve: 2e-3 of the rms, with waves of half of it.
    """

    rates: tuple[float, float, float] = (200.0, 200.0, 200.0)
    snr: float = 1e4
    motion: Motion = "white"
    seconds: float = 600.0
    polled: bool = False
    clocks: tuple[Oscillator, Oscillator, Oscillator] = STEADY
    slips: Mapping[int, Sequence[tuple[float, int]]] = field(default_factory=dict)
    leaps: Mapping[int, Sequence[tuple[float, int]]] = field(default_factory=dict)
    restarts: Mapping[int, tuple[float, float, float]] = field(default_factory=dict)
    bends: int | None = None
    n_channels: int = 3
    seed: int = 1
    reach: float = 0.43
    """Highest frequency of the motion's flat part, as a fraction of the lowest sampling rate."""

    @property
    def top(self) -> float:
        """Highest frequency of the motion's flat part, Hz."""
        return self.reach * min(self.rates)


@dataclass(frozen=True)
class Truth:
    """When each sample that is in the recording was taken, by its index in it."""

    scene: Scene
    index: tuple[IntArray, ...]
    seconds: tuple[FloatArray, ...]

    def residual(self, snapshot: Snapshot) -> FloatArray:
        """Return the rms of what varies of the real errors against the first sensor, in s.

        Of the segments that no sensor interrupts.
        """
        delays, at = snapshot.drift[:, 1:], snapshot.drift[:, 0]
        at = at + (snapshot.start_utc_ns - _ORIGIN.utc_ns) * 1e-9
        error = []
        whole = np.ones(len(at), dtype=bool)
        half = 1.0 + (at[1] - at[0] if len(at) > 1 else 0.0)
        for number, rate in enumerate(self.scene.rates):
            position = (at - delays[:, number]) * rate
            error.append(np.interp(position, self.index[number], self.seconds[number]))
            steps = np.diff(self.seconds[number]) * rate
            breaks = np.flatnonzero((np.abs(steps - 1) > 0.1) | (np.diff(self.index[number]) != 1))
            for stop in self.seconds[number][breaks]:
                whole &= np.abs(error[-1] - stop) > half
        for clock in snapshot.clocks:
            for slip in clock.slips:
                whole &= np.abs(at - seconds_of(slip.utc_ns)) > half + slip.within
        apart = np.array(error)[:, whole] - error[0][whole]
        return np.asarray(apart.std(axis=1)) if whole.any() else np.full(len(apart), np.nan)


def _spectrum(scene: Scene, frequency: FloatArray) -> FloatArray:
    """Return the PSD of the motion."""
    f, top = frequency, scene.top
    level = {
        "white": np.ones_like(f),
        "red": 1 / (1 + (f / 2.0) ** 4),
        "coloured": 1e-3
        + 1 / (1 + ((f - 0.1 * top) / (0.02 * top)) ** 2)
        + 0.3 / (1 + ((f - 0.6 * top) / (0.03 * top)) ** 2),
        "hum": 1e-4 / (1 + (f / 2.0) ** 4) + np.exp(-0.5 * ((f - 50.0) / 0.02) ** 2),
    }[scene.motion]
    edge = np.clip((f - top) / (0.1 * top), 0.0, 1.0)
    return np.asarray(scene.snr * NOISE * level * np.cos(np.pi / 2 * edge) ** 2)


def _motion(scene: Scene, rng: np.random.Generator) -> BSpline:
    """Return the motion in three directions, as a function of time.

    Scenes of one motion come one after the other, so the last one is kept, with the state of the
    generator after it: what is drawn then is the same.
    """
    given = scene.rates, scene.snr, scene.motion, scene.seconds, scene.seed, scene.reach
    if _last_motion.get("given") != given:
        drawn = make_interp_spline(*_drawn_motion(scene, rng), k=5)
        _last_motion.update(given=given, spline=drawn, state=rng.bit_generator.state)
    rng.bit_generator.state = _last_motion["state"]
    spline: BSpline = _last_motion["spline"]
    return spline


_last_motion: dict[str, Any] = {}


def _drawn_motion(scene: Scene, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return times and the motion in three directions, shape (n, 3)."""
    rate = _FINE * max(scene.rates)
    n = int((scene.seconds + 2 * _MARGIN) * rate) // 2 * 2
    frequency = np.arange(n // 2 + 1, dtype=np.float64) * (rate / n)
    size = np.sqrt(_spectrum(scene, frequency) * rate * n / 4)
    lines = rng.standard_normal((len(frequency), 3, 2)) @ np.array([1.0, 1j])
    lines[0] = 0.0
    return np.arange(n) / rate - _MARGIN, np.fft.irfft(lines * size[:, None], n, axis=0)


def _taken(
    scene: Scene, sensor: int, rng: np.random.Generator
) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Return index, true time and noise number of recorded samples, and where the clock restarts.

    A sample counted twice has one noise.
    """
    rate, clock = scene.rates[sensor], scene.clocks[sensor]
    number = np.arange(int(scene.seconds * rate))
    seconds = clock.seconds(number / rate) + 0.1 * sensor + 0.37 / rate * sensor
    copies = np.ones(len(number), np.int64)
    for when, lost in scene.slips.get(sensor, ()):
        at = int(np.searchsorted(seconds, when))
        if lost > 0:
            copies[at : at + lost] = 0
        else:
            copies[at] += -lost
    begins: list[float] = []
    if sensor in scene.restarts:
        shortest, longest, gone = scene.restarts[sensor]
        stop = float(rng.uniform(shortest, longest))
        while stop < scene.seconds - shortest:
            copies[(seconds >= stop) & (seconds < stop + gone)] = 0
            begins.append(stop + gone)
            stop += gone + float(rng.uniform(shortest, longest))
    kept = np.repeat(np.arange(len(number)), copies)
    taken = seconds[kept]
    index = np.arange(len(kept))
    for when, ahead in scene.leaps.get(sensor, ()):
        index = index + ahead * (taken >= when)
    restarts = np.searchsorted(taken, begins)
    for row in restarts.tolist():  # another phase of the sampling, and a count that is only near
        taken[row:] += rng.uniform(0, 1) / rate
        index[row:] += int(rng.integers(0, 30))
    return index, taken, kept, restarts


def record(path: Path, scene: Scene) -> Truth:
    """Write a recording and return what is true of it."""
    for _ in growing(path, scene, every=scene.seconds):
        pass
    return truth_of(scene)


def truth_of(scene: Scene) -> Truth:
    """Return what is true of a recording."""
    _, _, truth = _made(scene)
    return truth


def growing(
    path: Path, scene: Scene, *, every: float, control: tuple[int, str] | None = None
) -> Iterator[float]:
    """Write a recording; yield the seconds so far each time that so many are on disk."""
    layouts, blocks, _ = _made(scene)
    writer = RecordingWriter.create(path, sensors=layouts, created=_ORIGIN, control=control)
    later = every
    for block in blocks:
        writer.append(block)
        seconds = (block.received.monotonic_ns - _ORIGIN.monotonic_ns) * 1e-9
        if seconds > later:
            later += every
            writer.commit()
            yield seconds
    writer.close()
    yield scene.seconds


@lru_cache(maxsize=1)
def _made(scene: Scene) -> tuple[list[SensorLayout], list[Block], Truth]:
    rng = np.random.default_rng(scene.seed)
    spline = _motion(scene, rng)
    layouts: list[SensorLayout] = []
    blocks: list[Block] = []
    indices, times = [], []
    for sensor, rate in enumerate(scene.rates):
        index, taken, kept, restarts = _taken(scene, sensor, rng)
        deviation = np.sqrt(NOISE * rate / 2)
        noise = deviation * rng.standard_normal((kept[-1] + 1, scene.n_channels))
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0][: scene.n_channels]
        scale = _COUNTS / deviation
        felt = spline(taken) @ turn.T
        if sensor == scene.bends:
            felt += 2e-3 * felt.std() * np.sin(4 * np.pi * felt / felt.std())
        counts = np.round(scale * (felt + noise[kept])).astype(np.int32)
        layouts.append(
            SensorLayout(
                NAMES[sensor],
                tuple(Channel(name=f"c{n}", sensitivity=scale) for n in range(scene.n_channels)),
                rate,
                counts.dtype,
            )
        )
        edges = {0, len(index), *range(0, len(index), round(_BLOCK * rate)), *restarts.tolist()}
        edges |= set((np.flatnonzero(np.diff(index) != 1) + 1).tolist())
        rows = sorted(edges)
        phase = rng.uniform(0, _POLL)
        for first, end in itertools.pairwise(rows):
            arrival = taken[end - 1] + 1e-3 * rng.exponential()
            if scene.polled:
                arrival = np.ceil((arrival - phase) / _POLL) * _POLL + phase
            ns = round(float(arrival) * 1e9)
            begins = first == 0 or first in restarts
            blocks.append(
                Block(
                    NAMES[sensor],
                    int(index[first]),
                    counts[first:end],
                    HostTime(_ORIGIN.monotonic_ns + ns, _ORIGIN.utc_ns + ns),
                    flags=BlockFlag.CLOCK_RESTART if begins else BlockFlag.NONE,
                )
            )
        indices.append(index)
        times.append(taken)
    blocks.sort(key=lambda block: block.received.monotonic_ns)
    return layouts, blocks, Truth(scene, tuple(indices), tuple(times))


def seconds_of(utc_ns: int) -> float:
    """Return the seconds from the beginning of a recording to an instant."""
    return (utc_ns - _ORIGIN.utc_ns) * 1e-9
