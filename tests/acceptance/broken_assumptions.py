"""`python -m tests.acceptance.broken_assumptions [NAME…]`: one broken assumption at a time.

Recordings of 15 min at 100 Hz, of three to five sensors of one or three channels in any direction,
with motion 20 to 40 dB above the noise. What is simulated is numpy's, and shares no code with the
estimate. Prints for each kind, of three sensors and of more, how many levels of six bands there
are, how many have an interval that does not hold the noise that the channel had, and how many of
these are off by more than 0.3 dB. Two cores, four minutes.
"""

from __future__ import annotations

import itertools
import sys
from multiprocessing import Pool
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from scipy import signal

from daq.errors import HuddleError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import levels

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    FloatArray: TypeAlias = np.ndarray

RATE, N_SAMPLES = 100.0, 90_000
EDGES = np.array([0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0])
WITHIN = 0.3
"""dB of the truth that a level may be off, whatever its interval says."""
N_RECORDINGS, PROCESSES = 16, 2


class Scene:
    """What is recorded, in units of the noise of a channel, before anything is broken.

    Attributes
    ----------
    motion : float64, shape (n_samples, n_directions)
        At the middle of the bench.
    felt : float64, shape (n_sensors, n_samples, n_channels)
    noise : float64, shape (n_sensors, n_samples, n_channels)
        Of each channel: the truth.
    """

    def __init__(self, rng: np.random.Generator, *, snr: float | None = None) -> None:
        self.rng = rng
        self.n_sensors = int(rng.integers(3, 6))
        self.n_channels = int(rng.choice([3, 3, 3, 1]))
        self.size = np.sqrt(10 ** rng.uniform(2, 4) if snr is None else snr)
        self.motion = self.size * self.coloured(float(rng.choice([0.0, 0.0, -0.5])))
        self.turns = [
            np.linalg.qr(rng.standard_normal((self.n_channels,) * 2))[0]
            for _ in range(self.n_sensors)
        ]
        self.felt = np.stack([self.motion @ turn.T for turn in self.turns])
        self.noise = rng.standard_normal(self.felt.shape)

    def coloured(self, slope: float) -> FloatArray:
        """Return white noise times a power of frequency, of one standard deviation at 1 Hz."""
        white = self.rng.standard_normal((N_SAMPLES, self.n_channels))
        if not slope:
            return white
        frequency = np.maximum(np.fft.rfftfreq(N_SAMPLES, 1 / RATE), 0.05)
        return np.fft.irfft(np.fft.rfft(white, axis=0) * frequency[:, None] ** slope, axis=0)


def _changes(scene: Scene) -> None:
    scene.noise[0, N_SAMPLES // 2 :] *= 4


def _spikes(scene: Scene) -> None:
    scene.noise[0, scene.rng.integers(0, N_SAMPLES, 30), 0] += 200


def _shared(scene: Scene) -> None:
    scene.noise[:2, :, 0] += 0.7 * scene.rng.standard_normal(N_SAMPLES)


def _shared_within(scene: Scene) -> None:
    scene.noise[0] += scene.rng.standard_normal((N_SAMPLES, 1))


def _gradient(scene: Scene) -> None:
    further = 0.02 * scene.size * scene.coloured(0.5)
    for number, turn in enumerate(scene.turns):
        scene.felt[number] += scene.rng.standard_normal() * further @ turn.T


def _bursts(scene: Scene) -> None:
    for first in scene.rng.integers(0, N_SAMPLES - 2000, 12):
        scene.felt[:, first : first + int(scene.rng.integers(100, 2000))] *= 30


def _gain(scene: Scene) -> None:
    scene.felt[1, :, 0] *= -1.3


def _low_pass(scene: Scene) -> None:
    taps = signal.butter(1, scene.rng.uniform(5, 30), fs=RATE)
    scene.felt[1] = signal.lfilter(*taps, scene.felt[1], axis=0)


def _resonance(scene: Scene) -> None:
    scene.felt[1, :, 0] += 3 * signal.lfilter(*signal.iirpeak(20, 15, fs=RATE), scene.felt[1, :, 0])


def _delay(scene: Scene) -> None:
    turn = np.exp(
        -2j * np.pi * np.fft.rfftfreq(N_SAMPLES, 1 / RATE) * scene.rng.uniform(1e-3, 0.05)
    )
    scene.felt[1] = np.fft.irfft(np.fft.rfft(scene.felt[1], axis=0) * turn[:, None], axis=0)


def _crosstalk(scene: Scene) -> None:
    scene.felt[1, :, 0] += 0.2 * scene.felt[0, :, 0]


def _curved(scene: Scene) -> None:
    scene.felt[0, :, 0] += 1e-3 / scene.size * scene.felt[0, :, 0] ** 2


def _quiet(scene: Scene) -> None:
    scene.noise[0] *= 0.05


def _loud(scene: Scene) -> None:
    scene.noise[0] *= 20


def _line(scene: Scene) -> None:
    wave = 50 * scene.size * np.sin(2 * np.pi * 12.34 * np.arange(N_SAMPLES) / RATE)
    direction = scene.rng.standard_normal(scene.n_channels)
    for number, turn in enumerate(scene.turns):
        scene.felt[number] += wave[:, None] * (turn @ direction)


def _nothing(scene: Scene) -> None:
    pass


KINDS: Mapping[str, tuple[Callable[[Scene], None], float | None]] = {
    "nothing": (_nothing, None),
    "no motion": (_nothing, 0.0),
    "motion of 1 % of the noise": (_nothing, 0.01),
    "motion of 5 % of the noise": (_nothing, 0.05),
    "motion of 20 % of the noise": (_nothing, 0.2),
    "motion 60 dB above the noise": (_nothing, 1e6),
    "noise of one sensor four times as high from the middle on": (_changes, None),
    "30 spikes in one channel": (_spikes, None),
    "noise that two channels of two sensors share": (_shared, None),
    "noise that all channels of a sensor share": (_shared_within, None),
    "a second motion that each sensor feels to another degree": (_gradient, None),
    "bursts of motion 30 times as strong": (_bursts, None),
    "a channel of reversed sign and a gain of 1.3": (_gain, None),
    "a low pass of 5 to 30 Hz in one sensor": (_low_pass, None),
    "a resonance at 20 Hz in one channel": (_resonance, None),
    "a delay of 1 to 50 ms of one sensor": (_delay, None),
    "a fifth of a channel in one of another sensor": (_crosstalk, None),
    "a channel with a square term of 1e-3 at the rms": (_curved, None),
    "a sensor 26 dB quieter": (_quiet, None),
    "a sensor 26 dB louder": (_loud, None),
    "a line 34 dB above the motion": (_line, None),
}


def one(job: tuple[str, int]) -> tuple[str, int, FloatArray, FloatArray]:
    """Return kind, number of sensors, and of each level its error in dB, and whether it is held."""
    name, seed = job
    breaks, snr = KINDS[name]
    scene = Scene(np.random.default_rng(seed), snr=snr)
    breaks(scene)
    samples = {f"s{n}": each for n, each in enumerate(scene.felt + scene.noise)}
    settings = Settings()
    try:
        snapshot = estimate([recording_of_arrays(samples, RATE)], settings)
    except HuddleError:
        return name, scene.n_sensors, np.empty((6, 0)), np.empty((6, 0), np.bool_)
    edges = np.searchsorted(snapshot.frequency, EDGES)
    (result,) = snapshot.results.values()
    found = levels(result, snapshot, settings, edges)
    low, high = found.ends()
    noise = scene.noise.transpose(1, 0, 2).reshape(N_SAMPLES, -1)
    psd = signal.welch(noise, fs=RATE, nperseg=1000, axis=0)[1]
    truth = np.stack([psd[a:b].mean(axis=0) for a, b in itertools.pairwise(edges)])
    with np.errstate(invalid="ignore", divide="ignore"):
        error = 10 * np.log10(found.mean / truth)
    return name, scene.n_sensors, error, ~np.isfinite(low) | ((low <= truth) & (high >= truth))


def main(names: list[str]) -> int:
    """Run all kinds, or those whose names begin like one of these."""
    jobs = [
        (name, 1000 * number + seed)
        for number, name in enumerate(KINDS)
        for seed in range(N_RECORDINGS)
        if not names or any(name.startswith(each) for each in names)
    ]
    found: dict[str, list[tuple[int, FloatArray, FloatArray]]] = {}
    with Pool(PROCESSES) as pool:
        for name, n_sensors, error, held in pool.imap(one, jobs):
            print(".", end="", file=sys.stderr, flush=True)
            found.setdefault(name, []).append((n_sensors, error, held))
    print(
        "| broken | three sensors: levels | outside | by > 0.3 dB"
        " | more: levels | outside | by > 0.3 dB |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, parts in found.items():
        row = [name]
        for three in (True, False):
            some = [(e, h) for n, e, h in parts if (n == 3) == three]
            error = np.concatenate([e.ravel() for e, _ in some] or [np.empty(0)])
            held = np.concatenate([h.ravel() for _, h in some] or [np.empty(0, np.bool_)])
            off = ~held & ~(np.abs(error) <= WITHIN)
            row += [str(held.size), str(int((~held).sum())), str(int(off.sum()))]
        print(f"| {' | '.join(row)} |")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
