"""What breaks assumptions, and is it said? `python -m tests.acceptance.broken_assumptions`.

Recordings of 15 min at 100 Hz, of three or five sensors of three channels (a quarter: of one) in
any direction, with motion 20, 40 and 60 dB above the noise; with `--pairs`, two kinds together.
What is simulated is numpy's, and shares no code with the estimate. The truth is the *expected*
noise: the PSD that the noise of the channel has on average, by construction.

For every kind, ratio and number of sensors: how many levels of six bands have an interval that
holds the truth; in how many recordings a fact of rank *delays* or worse has the right name and, if
a sensor is concerned, names it; and how many verdicts on limits 3 dB above and below the truth are
wrong. `--seeds N` sets the recordings of each (default 2), `--only TEXT` the kinds, `--json FILE`
keeps every recording's numbers.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from scipy import signal

from daq.errors import HuddleError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.results.facts.fact import Finding
from daq.results.result import Result
from estimator.checks.advice import Rank

FloatArray: TypeAlias = np.ndarray

RATE, N_SAMPLES = 100.0, 90_000
EDGES = np.array([0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0])
RATIOS = (20, 40, 60)
LIMIT = 10**0.3
BROKEN = 0
"""The sensor that is broken, where one is."""


class Scene:
    """What is recorded, in units of the noise of a channel, before anything is broken.

    Attributes
    ----------
    felt : float64, shape (n_sensors, n_samples, n_channels)
    noise : float64, shape (n_sensors, n_samples, n_channels)
    power : float64, shape (n_sensors, n_channels)
        Expected mean square of white noise: the truth.
    further : list of (sensor, channel, callable)
        Expected noise beside it, as a PSD over 2 / RATE of frequency in Hz.
    step : float
        Of counts; 0 for none.
    """

    def __init__(self, rng: np.random.Generator, ratio: float, n_sensors: int) -> None:
        self.rng, self.n_sensors = rng, n_sensors
        self.n_channels = 1 if rng.random() < 0.25 else 3
        self.size = 10 ** (ratio / 20)
        self.motion = self.size * self.coloured(0.0)
        self.turns = [self.turned(self.n_channels) for _ in range(n_sensors)]
        self.felt = np.stack([self.motion @ turn.T for turn in self.turns])
        self.noise = rng.standard_normal(self.felt.shape)
        self.power = np.ones((n_sensors, self.n_channels))
        self.further: list[tuple[int, int, Callable[[FloatArray], FloatArray]]] = []
        self.step = 0.0
        self.time = np.arange(N_SAMPLES) / RATE

    def turned(self, n: int) -> FloatArray:
        """Return a rotation, or a sign."""
        return np.asarray(np.linalg.qr(self.rng.standard_normal((n, n)))[0])

    def coloured(self, slope: float, n: int | None = None) -> FloatArray:
        """Return noise of a power of frequency, of one standard deviation at 1 Hz if white."""
        white = self.rng.standard_normal((N_SAMPLES, self.n_channels if n is None else n))
        if not slope:
            return white
        frequency = np.maximum(np.fft.rfftfreq(N_SAMPLES, 1 / RATE), 0.05)
        return np.fft.irfft(np.fft.rfft(white, axis=0) * frequency[:, None] ** slope, axis=0)

    def truth(self, frequency: FloatArray, edges: FloatArray) -> FloatArray:
        """Return the expected noise in bands, shape (n_bands, n_sensors * n_channels)."""
        psd = np.broadcast_to(self.power, (len(frequency), *self.power.shape)).copy()
        for sensor, channel, extra in self.further:
            psd[:, sensor, channel] += extra(frequency)
        psd = psd.reshape(len(frequency), -1) * 2 / RATE
        return np.stack([psd[a:b].mean(axis=0) for a, b in itertools.pairwise(edges)])

    def samples(self) -> dict[str, FloatArray]:
        """Return what is recorded."""
        found = {f"s{n}": each for n, each in enumerate(self.felt + self.noise)}
        if self.step:
            found = {
                name: np.rint(each / self.step).astype(np.int32) for name, each in found.items()
            }
        return found


def _nothing(scene: Scene) -> None:
    """Break nothing."""


def _weak(share: float) -> Callable[[Scene], None]:
    """Leave motion of a share of the noise, whatever the ratio."""

    def breaks(scene: Scene) -> None:
        scene.felt *= np.sqrt(share) / scene.size

    return breaks


def _red(slope: float) -> Callable[[Scene], None]:
    def breaks(scene: Scene) -> None:
        motion = scene.size * scene.coloured(slope)
        scene.felt = np.stack([motion @ turn.T for turn in scene.turns])

    return breaks


def _course(
    shape: Callable[[Scene], FloatArray], *, every: bool = False
) -> Callable[[Scene], None]:
    """Multiply the motion that a sensor, or every sensor to its own degree, feels by a course."""

    def breaks(scene: Scene) -> None:
        course = shape(scene)
        for n in range(scene.n_sensors if every else 1):
            degree = scene.rng.uniform(-1, 1) if every else 1.0
            scene.felt[n] *= 1 + degree * (course[:, None] - 1)

    return breaks


def _ramp(size: float) -> Callable[[Scene], FloatArray]:
    return lambda scene: 1 + size * scene.time / scene.time[-1]


def _step(size: float) -> Callable[[Scene], FloatArray]:
    return lambda scene: 1 - size * (scene.time > 0.45 * scene.time[-1])


def _temperature(scene: Scene) -> FloatArray:
    walk = np.cumsum(scene.rng.standard_normal(N_SAMPLES))
    walk = walk - walk.mean()
    return np.asarray(1 + 0.02 * walk / walk.std())


def _cycle(scene: Scene) -> FloatArray:
    return 1 + 0.01 * np.sin(2 * np.pi * scene.time / 300)


def _jitter(scene: Scene) -> FloatArray:
    steps = scene.rng.standard_normal(-(-N_SAMPLES // 400))
    return np.asarray(1 + 0.02 * steps.repeat(400)[:N_SAMPLES])


def _one_channel_step(scene: Scene) -> None:
    scene.felt[BROKEN, :, 0] *= _step(0.05)(scene)


def _settles(degrees: float) -> Callable[[Scene], None]:
    def breaks(scene: Scene) -> None:
        angle = np.radians(degrees) * (1 - np.exp(-scene.time / 200))[:, None]
        felt = scene.felt[BROKEN]
        if scene.n_channels > 1:
            a, b = felt[:, :1].copy(), felt[:, 1:2].copy()
            felt[:, :1], felt[:, 1:2] = a + angle * b, b - angle * a
        else:
            felt *= 1 + angle

    return breaks


def _turns_at_once(scene: Scene) -> None:
    if scene.n_channels > 1:
        late = (scene.time > 400)[:, None] * np.radians(0.5)
        a, b = scene.felt[BROKEN, :, :1].copy(), scene.felt[BROKEN, :, 1:2].copy()
        scene.felt[BROKEN, :, :1], scene.felt[BROKEN, :, 1:2] = a + late * b, b - late * a
    else:
        scene.felt[BROKEN] *= 1 + 0.01 * (scene.time > 400)[:, None]


def _filter_moves(before: FloatArray, after: FloatArray) -> Callable[[Scene], None]:
    """Filter what a sensor feels by other sections from 45 % of the time on."""

    def breaks(scene: Scene) -> None:
        early, late = (signal.sosfilt(e, scene.felt[BROKEN], axis=0) for e in (before, after))
        scene.felt[BROKEN] = np.where(scene.time[:, None] < 0.45 * scene.time[-1], early, late)

    return breaks


def _corner(at: float, kind: Literal["high", "low"] = "high") -> FloatArray:
    return np.asarray(signal.butter(2, at, kind, fs=RATE, output="sos"))


def _peak(at: float) -> FloatArray:
    b, a = signal.iirpeak(at, 10, fs=RATE)
    return np.asarray(signal.tf2sos(a + 2 * b, a))


def _octave_gains(scene: Scene) -> None:
    band = signal.butter(2, [0.5, 1], "band", fs=RATE, output="sos")
    late = scene.time[:, None] > 0.45 * scene.time[-1]
    scene.felt[BROKEN] += 0.02 * late * signal.sosfiltfilt(band, scene.felt[BROKEN], axis=0)


def _compresses(at: float) -> Callable[[Scene], None]:
    def breaks(scene: Scene) -> None:
        size = at * scene.felt[BROKEN].std()
        scene.felt[BROKEN] = np.tanh(scene.felt[BROKEN] / size) * size

    return breaks


def _square(share: float, *, cube: bool = False) -> Callable[[Scene], None]:
    def breaks(scene: Scene) -> None:
        x = scene.felt[BROKEN, :, 0]
        scene.felt[BROKEN, :, 0] += share * x.std() * (x / x.std()) ** (3 if cube else 2)

    return breaks


def _square_before_low_pass(scene: Scene) -> None:
    _square(2e-3)(scene)
    taps = signal.butter(1, 20, fs=RATE)
    scene.felt = signal.lfilter(*taps, scene.felt, axis=1)


def _dead_zone(scene: Scene) -> None:
    x = scene.felt[BROKEN, :, 0]
    zone = 0.02 * x.std()
    scene.felt[BROKEN, :, 0] = np.sign(x) * np.maximum(np.abs(x) - zone, 0)


def _rectifies(scene: Scene) -> None:
    x = scene.felt[BROKEN, :, 0]
    scene.felt[BROKEN, :, 0] += 2e-3 * np.abs(x)


def _clips(scene: Scene) -> None:
    x = scene.felt[BROKEN, :, 0]
    scene.felt[BROKEN, :, 0] = np.clip(x, -3 * x.std(), 3 * x.std())


def _counts(own: float, motion: float, *, aligned: bool = True) -> Callable[[Scene], None]:
    """Round to counts: own noise and motion in counts, whatever the ratio."""

    def breaks(scene: Scene) -> None:
        scene.step = 1 / own
        size = motion / own / scene.size
        turns = [np.eye(scene.n_channels) if aligned else turn for turn in scene.turns]
        scene.felt = np.stack([size * scene.motion @ turn.T for turn in turns])
        offsets = scene.rng.uniform(0, scene.step, (scene.n_sensors, 1, scene.n_channels))
        scene.felt += offsets
        scene.power += scene.step**2 / 12

    return breaks


def _noise_step(factor: float) -> Callable[[Scene], None]:
    def breaks(scene: Scene) -> None:
        half = N_SAMPLES // 2
        scene.noise[BROKEN, half:] *= factor
        scene.power[BROKEN] = (1 + factor**2) / 2

    return breaks


def _noise_ramp(scene: Scene) -> None:
    course = 1 + scene.time / scene.time[-1]
    scene.noise[BROKEN] *= course[:, None]
    scene.power[BROKEN] = np.mean(course**2)


def _gusty(scene: Scene) -> None:
    """Add gusts to the noise of every sensor below 5 Hz."""
    taps = signal.butter(2, 5, fs=RATE)
    response = np.abs(signal.freqz(*taps, worN=4001, fs=RATE)[1]) ** 2
    grid = np.linspace(0, RATE / 2, 4001)
    gusts = np.exp(scene.rng.standard_normal(N_SAMPLES // 1000)).repeat(1000)[:, None]
    power = 4 * float(np.mean(gusts**2))
    for n in range(scene.n_sensors):
        white = scene.rng.standard_normal((N_SAMPLES, scene.n_channels))
        scene.noise[n] += signal.lfilter(*taps, 2 * gusts * white, axis=0)
        for c in range(scene.n_channels):
            scene.further.append((n, c, lambda f: power * np.interp(f, grid, response)))


def _spikes(scene: Scene) -> None:
    at = scene.rng.integers(0, N_SAMPLES, 30)
    scene.noise[BROKEN, at, 0] += 200 * scene.rng.choice([-1, 1], 30)
    scene.power[BROKEN, 0] += 30 * 200**2 / N_SAMPLES


def _shared(share: float) -> Callable[[Scene], None]:
    def breaks(scene: Scene) -> None:
        scene.noise[:2, :, 0] += np.sqrt(share) * scene.rng.standard_normal(N_SAMPLES)
        scene.power[:2, 0] += share

    return breaks


def _shared_within(scene: Scene) -> None:
    scene.noise[BROKEN] += scene.rng.standard_normal((N_SAMPLES, 1))
    scene.power[BROKEN] += 1


def _gradient(scene: Scene) -> None:
    further = 0.02 * scene.size * scene.coloured(0.5)
    for number, turn in enumerate(scene.turns):
        scene.felt[number] += scene.rng.standard_normal() * further @ turn.T


def _bursts(scene: Scene) -> None:
    for first in scene.rng.integers(0, N_SAMPLES - 2000, 12):
        scene.felt[:, first : first + int(scene.rng.integers(100, 2000))] *= 30


def _stops(scene: Scene) -> None:
    scene.felt[:, N_SAMPLES // 3 : 2 * N_SAMPLES // 3] *= 1e-3


def _fades(scene: Scene) -> None:
    scene.felt *= np.exp(-3 * scene.time / scene.time[-1])[None, :, None]


def _gain(scene: Scene) -> None:
    scene.felt[BROKEN, :, 0] *= -1.3


def _low_pass(scene: Scene) -> None:
    taps = signal.butter(1, scene.rng.uniform(5, 30), fs=RATE)
    scene.felt[BROKEN] = signal.lfilter(*taps, scene.felt[BROKEN], axis=0)


def _resonance(scene: Scene) -> None:
    peak = signal.iirpeak(20, 15, fs=RATE)
    scene.felt[BROKEN, :, 0] += 3 * signal.lfilter(*peak, scene.felt[BROKEN, :, 0])


def _delayed(scene: Scene, delay: FloatArray) -> None:
    """Delay what a sensor feels by a slow course in seconds."""
    at = np.arange(N_SAMPLES) - delay * RATE
    fine = signal.resample_poly(scene.felt[BROKEN], 16, 1, axis=0)
    place = np.clip(at * 16, 0, len(fine) - 2)
    low = place.astype(int)
    part = (place - low)[:, None]
    scene.felt[BROKEN] = (1 - part) * fine[low] + part * fine[low + 1]
    # linear interpolation between sixteenths of a sample is off by 70 dB below 0.4 of the rate


def _delay(scene: Scene) -> None:
    turn = np.exp(
        -2j * np.pi * np.fft.rfftfreq(N_SAMPLES, 1 / RATE) * scene.rng.uniform(1e-3, 0.05)
    )
    spectrum = np.fft.rfft(scene.felt[BROKEN], axis=0) * turn[:, None]
    scene.felt[BROKEN] = np.fft.irfft(spectrum, axis=0)


def _drifts(scene: Scene) -> None:
    _delayed(scene, 5e-6 * scene.time)


def _sways(scene: Scene) -> None:
    _delayed(scene, 3e-5 * np.sin(2 * np.pi * scene.time / 20))


def _jitters(scene: Scene) -> None:
    _delayed(scene, 2e-5 * scene.rng.standard_normal(N_SAMPLES))


def _has_play(scene: Scene) -> None:
    x = scene.felt[BROKEN, :, 0]
    width, at, found = 0.005 * x.std(), x[0], []
    for value in x.tolist():
        at = min(max(at, value - width), value + width)
        found.append(at)
    scene.felt[BROKEN, :, 0] = found


def _slow(scene: Scene) -> None:
    x = scene.felt[BROKEN, :, 0]
    most, at, found = 2.8 * np.diff(x).std(), x[0], []
    for value in x.tolist():
        at += min(max(value - at, -most), most)
        found.append(at)
    scene.felt[BROKEN, :, 0] = found


def _converter(scene: Scene) -> None:
    x = scene.felt[BROKEN, :, 0]
    scene.felt[BROKEN, :, 0] += 2e-3 * x.std() * np.sin(4 * np.pi * x / x.std())


def _product(scene: Scene) -> None:
    """Add a product of the motion along two axes, or a square of that along one."""
    x = scene.felt[BROKEN]
    x[:, 0] += 1e-3 * x[:, -1] * x[:, -2 if scene.n_channels > 1 else 0] / x[:, 0].std()


def _fills_gaps(scene: Scene) -> None:
    """Fill 200 gaps of 5 samples by straight lines: before noise, which they lack, too."""
    both = scene.felt[BROKEN] + scene.noise[BROKEN]
    within = np.linspace(0, 1, 7)[1:-1, None]
    for at in scene.rng.integers(10, N_SAMPLES - 10, 200):
        before, after = both[[at - 1, at + 5]]
        both[at : at + 5] = before + within * (after - before)
    scene.felt[BROKEN] = both - scene.noise[BROKEN]


def _jumps(scene: Scene) -> None:
    scene.felt[BROKEN, N_SAMPLES // 2 :] = np.roll(scene.felt[BROKEN], 1, axis=0)[N_SAMPLES // 2 :]


def _crosstalk(scene: Scene) -> None:
    scene.felt[BROKEN, :, 0] += 0.2 * scene.felt[1, :, 0]


def _leaks(scene: Scene) -> None:
    """Let a channel's noise into another sensor's channel."""
    scene.noise[1, :, 0] += 0.5 * scene.noise[0, :, 0]
    scene.power[1, 0] += 0.25


def _quiet(scene: Scene) -> None:
    scene.noise[BROKEN] *= 0.05
    scene.power[BROKEN] *= 0.05**2


def _loud(scene: Scene) -> None:
    scene.noise[BROKEN] *= 20
    scene.power[BROKEN] *= 400


def _line(scene: Scene) -> None:
    wave = 50 * scene.size * np.sin(2 * np.pi * 12.34 * scene.time)
    direction = scene.rng.standard_normal(scene.n_channels)
    for number, turn in enumerate(scene.turns):
        scene.felt[number] += wave[:, None] * (turn @ direction)


def _one_axis_still(scene: Scene) -> None:
    if scene.n_channels > 1:
        scene.motion[:, 0] = 0
        scene.felt = np.stack([scene.motion @ turn.T for turn in scene.turns])


def _stands_still(scene: Scene) -> None:
    scene.felt[BROKEN, 30_000:33_000, 0] = scene.noise[BROKEN, 30_000:33_000, 0] = 0.0


def _alone(scene: Scene) -> None:
    scene.felt[BROKEN] = scene.size * scene.coloured(0.0)


@dataclass(frozen=True)
class Kind:
    """What is broken, and the names of facts and findings that are right about it."""

    breaks: Callable[[Scene], None]
    causes: tuple[str, ...] = ()
    """Empty: nothing need be said."""
    names_sensor: bool = True


STEADY = ("ResponseChanges",)
NOISE = ("NoiseChanges",)
LINEAR = ("NotLinear",)
AT_INSTANTS = ("NoiseDependsOnMotion", *LINEAR)
SHARED = ("SharedNoise", "SharedByTwo")
KINDS: Mapping[str, Kind] = {
    "nothing": Kind(_nothing),
    "nothing, red motion": Kind(_red(-0.5)),
    "nothing, very red motion": Kind(_red(-1.5)),
    "no motion": Kind(_weak(0.0)),
    "motion of 1 % of the noise": Kind(_weak(0.01)),
    "motion of 5 % of the noise": Kind(_weak(0.05)),
    "motion of 20 % of the noise": Kind(_weak(0.2)),
    "gain of a sensor rises by 3 %": Kind(_course(_ramp(0.03)), STEADY),
    "gain of a sensor rises by 0.3 %": Kind(_course(_ramp(0.003)), STEADY),
    "gain of a sensor falls by 5 % at once": Kind(_course(_step(0.05)), STEADY),
    "gain of a channel falls by 5 % at once": Kind(_one_channel_step, STEADY),
    "gains follow one temperature, 2 % rms": Kind(
        _course(_temperature, every=True), STEADY, names_sensor=False
    ),
    "gain of a sensor varies by 1 % in 5 min": Kind(_course(_cycle), STEADY),
    "a sensor settles by 0.05°": Kind(_settles(0.05), STEADY),
    "a sensor settles by 1°": Kind(_settles(1.0), STEADY),
    "a sensor turns by 0.5° at once": Kind(_turns_at_once, STEADY),
    "a sensor compresses, tanh at 12 rms": Kind(_compresses(12), LINEAR),
    "a sensor compresses, tanh at 40 rms": Kind(_compresses(40), LINEAR),
    "a channel has a square of 2e-3 of its rms": Kind(_square(2e-3), LINEAR),
    "a channel has a square of 2e-4 of its rms": Kind(_square(2e-4), LINEAR),
    "a channel has a square of 2e-2 of its rms": Kind(_square(2e-2), LINEAR),
    "a channel has a cube of 1e-3 of its rms": Kind(_square(1e-3, cube=True), LINEAR),
    "a square of 2e-3 before a low pass": Kind(_square_before_low_pass, LINEAR),
    "a channel rectifies 2e-3": Kind(_rectifies, LINEAR),
    "a channel has a dead zone of 0.02 rms": Kind(_dead_zone, LINEAR),
    "a channel clips at 3 rms": Kind(_clips, (*LINEAR, "ChannelsClipped")),
    "counts: noise 0.15, motion 3, aligned": Kind(
        _counts(0.15, 3.0), ("RoundedAlike",), names_sensor=False
    ),
    "counts: noise 0.05, motion 3, aligned": Kind(
        _counts(0.05, 3.0), ("RoundedAlike",), names_sensor=False
    ),
    "counts: noise 0.3, motion 30, aligned": Kind(_counts(0.3, 30.0)),
    "counts: noise 0.3, motion 30, any direction": Kind(_counts(0.3, 30.0, aligned=False)),
    "noise of a sensor four times as high from the middle on": Kind(_noise_step(4), NOISE),
    "noise of a sensor 1.5 times as high from the middle on": Kind(_noise_step(1.5)),
    "noise of a sensor doubles slowly": Kind(_noise_ramp),
    "gusts below 5 Hz in the noise of all": Kind(_gusty, NOISE, names_sensor=False),
    "30 spikes in one channel": Kind(_spikes, (*NOISE, "DisturbedSegments")),
    "two channels of two sensors share half of their noise": Kind(
        _shared(1.0), SHARED, names_sensor=False
    ),
    "two channels of two sensors share a fifth of their noise": Kind(
        _shared(0.25), SHARED, names_sensor=False
    ),
    "noise that all channels of a sensor share": Kind(_shared_within),
    "a second motion, felt to another degree": Kind(
        _gradient,
        ("ModelMisfit", "TooFewDimensions", "DimensionsUnexplained", "DimensionsUndetermined"),
        names_sensor=False,
    ),
    "bursts of motion 30 times as strong": Kind(_bursts),
    "motion stops for 5 min": Kind(_stops),
    "motion fades by 26 dB": Kind(_fades),
    "a channel of reversed sign and a gain of 1.3": Kind(_gain),
    "a low pass of 5 to 30 Hz in one sensor": Kind(_low_pass),
    "a resonance at 20 Hz in one channel": Kind(_resonance),
    "a delay of 1 to 50 ms of one sensor": Kind(_delay),
    "the clock of a sensor drifts by 5 ppm": Kind(_drifts),
    "a sample is lost in the middle": Kind(
        _jumps, ("SamplesUncounted", "ClockNotUnderstood", "Delay", "StatedTimesDrift", *STEADY)
    ),
    "a fifth of a channel in one of another sensor": Kind(_crosstalk),
    "half of a channel's noise in another sensor": Kind(_leaks, SHARED, names_sensor=False),
    "a sensor 26 dB quieter": Kind(_quiet),
    "a sensor 26 dB louder": Kind(_loud),
    "a line 34 dB above the motion": Kind(_line),
    "one direction without motion": Kind(_one_axis_still),
    "a channel stands still for 30 s": Kind(_stands_still, ("ChannelsStoodStill",)),
    "a sensor that feels other motion": Kind(_alone, ("NoSharedMotion", "ModelMisfit")),
    "a high-pass corner moves from 0.4 to 0.5 Hz": Kind(
        _filter_moves(_corner(0.4), _corner(0.5)), STEADY
    ),
    "a low-pass corner moves from 19 to 20 Hz": Kind(
        _filter_moves(_corner(19, "low"), _corner(20, "low")), STEADY
    ),
    "a resonance moves from 8 to 8.2 Hz": Kind(_filter_moves(_peak(8), _peak(8.2)), STEADY),
    "gain of an octave rises by 2 % at once": Kind(_octave_gains, STEADY),
    "gain of a sensor jitters by 2 % in 4 s": Kind(_course(_jitter), STEADY),
    "instants of a sensor sway by 30 µs in 20 s": Kind(_sways, AT_INSTANTS),
    "instants of a sensor jitter by 20 µs": Kind(_jitters, AT_INSTANTS),
    "a channel has play of 0.005 rms": Kind(_has_play, AT_INSTANTS),
    "a channel is slower than 2.8 rms of its slope": Kind(_slow, (*AT_INSTANTS, *STEADY)),
    "a converter has steps of 2e-3 rms": Kind(_converter, AT_INSTANTS),
    "a channel has a product of 1e-3 of two axes": Kind(_product, AT_INSTANTS),
    "200 gaps of 50 ms are filled by lines": Kind(
        _fills_gaps, (*AT_INSTANTS, *STEADY, "DisturbedSegments", "ChannelsStoodStill")
    ),
}
PAIRS = (
    ("gain of a sensor rises by 3 %", "a channel has a square of 2e-3 of its rms"),
    ("gain of a channel falls by 5 % at once", "noise of a sensor doubles slowly"),
    (
        "a sensor compresses, tanh at 12 rms",
        "two channels of two sensors share half of their noise",
    ),
    ("a sensor settles by 0.05°", "a line 34 dB above the motion"),
    ("a channel has a square of 2e-3 of its rms", "bursts of motion 30 times as strong"),
    ("a channel has a square of 2e-3 of its rms", "a low pass of 5 to 30 Hz in one sensor"),
    ("gains follow one temperature, 2 % rms", "motion fades by 26 dB"),
    ("a channel has a square of 2e-3 of its rms", "a sensor 26 dB louder"),
)


def said(snapshot: Snapshot, settings: Settings) -> list[tuple[str, set[str]]]:
    """Return the names of facts and findings that delay the result or worse, and their sensors."""
    found: list[tuple[str, set[str]]] = []
    for fact in Result(snapshot, settings).facts:
        if fact.rank is Rank.TO_KNOW:
            continue
        sensors = {*fact.sensors, *(name.split(".")[0] for name in fact.channels)}
        if isinstance(fact, Finding):
            names = snapshot.sensor_names
            found += [
                (type(each).__name__, {names[n] for n in each.sensors}) for each in fact.findings
            ]
        else:
            found.append((type(fact).__name__, sensors))
    return found


@dataclass(frozen=True)
class Outcome:
    """What became of one recording."""

    kinds: tuple[str, ...]
    ratio: int
    n_sensors: int
    held: int
    n_levels: int
    named: bool | None
    wrong: int
    n_verdicts: int
    worst: float
    facts: tuple[str, ...]


def one(kinds: Sequence[str], ratio: int, n_sensors: int, seed: int) -> Outcome:
    """Simulate and estimate one recording."""
    number = list(KINDS).index(kinds[0])
    scene = Scene(np.random.default_rng([47, number, ratio, n_sensors, seed]), ratio, n_sensors)
    for name in kinds:
        KINDS[name].breaks(scene)
    settings = Settings()
    try:
        snapshot = estimate([recording_of_arrays(scene.samples(), RATE)], settings)
    except HuddleError as refused:
        why = (type(refused).__name__,)
        return Outcome(tuple(kinds), ratio, n_sensors, 0, 0, True, 0, 0, 0.0, why)
    edges = np.searchsorted(snapshot.frequency, EDGES)
    result = next(iter(snapshot.results.values()))
    found = Result(snapshot, settings).spectrum(result.method).levels(edges)
    low, high = found.ends()
    truth = scene.truth(snapshot.frequency, edges)
    if scene.step:
        truth = truth / scene.step**2
    known = np.isfinite(found.mean)
    inside = ~known | ((low <= truth) & (truth <= high))
    wrong_pass = known & (high < truth / LIMIT)
    wrong_fail = known & (low > truth * LIMIT)
    facts = said(snapshot, settings)
    wanted = [KINDS[name] for name in kinds if KINDS[name].causes]
    named = None
    if wanted:
        named = all(
            any(
                name in kind.causes and (not kind.names_sensor or f"s{BROKEN}" in sensors)
                for name, sensors in facts
            )
            for kind in wanted
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.abs(10 * np.log10(found.mean / truth))
    worst = float(np.max(np.where(inside, 0.0, np.nan_to_num(error, nan=99.0))))
    return Outcome(
        tuple(kinds),
        ratio,
        n_sensors,
        int(inside.sum()),
        inside.size,
        named,
        int(wrong_pass.sum() + wrong_fail.sum()),
        2 * inside.size,
        worst,
        tuple(name for name, _ in facts),
    )


def jobs(only: str, seeds: int, *, pairs: bool) -> Iterator[tuple[tuple[str, ...], int, int, int]]:
    """Yield kinds, ratio, number of sensors and seed of every recording."""
    chosen = PAIRS if pairs else tuple((name,) for name in KINDS)
    for names in chosen:
        if all(only not in name for name in names):
            continue
        for ratio, n_sensors, seed in itertools.product(RATIOS, (3, 5), range(seeds)):
            yield names, ratio, n_sensors, seed


def row(outcomes: Sequence[Outcome]) -> str:
    """Return a row of the table: coverage, named and false verdicts by ratio, and the worst."""
    cells = [" and ".join(outcomes[0].kinds)]
    for ratio in RATIOS:
        some = [each for each in outcomes if each.ratio == ratio]
        n_levels = sum(each.n_levels for each in some)
        held = sum(each.held for each in some) / max(n_levels, 1)
        named = [each.named for each in some if each.named is not None]
        wrong = sum(each.wrong for each in some) / max(sum(each.n_verdicts for each in some), 1)
        cells.append(f"{held:.2f}" if n_levels else "refused")
        cells.append(f"{sum(named)}/{len(named)}" if named else "–")
        cells.append(f"{wrong:.1%}")
    cells.append(f"{max(each.worst for each in outcomes):.1f}")
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str]) -> int:
    """Run all kinds, or those whose names hold a text."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", default="")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    head = "".join(f" {ratio} dB: coverage | named | false |" for ratio in RATIOS)
    print(f"| broken |{head} worst, dB |")
    print("|---" * (2 + 3 * len(RATIOS)) + "|")
    found: list[Outcome] = []
    for _, some in itertools.groupby(
        jobs(options.only, options.seeds, pairs=options.pairs), key=lambda job: job[0]
    ):
        outcomes = [one(*job) for job in some]
        found += outcomes
        print(row(outcomes), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps([each.__dict__ for each in found]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
