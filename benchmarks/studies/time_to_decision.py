"""Whether the predicted length of a test is the one after which it ends by itself.

``python -m benchmarks.studies.time_to_decision [TESTS] [SEED]`` prints the table of
``docs/validation/time-to-decision.md``. Three triaxial sensors that point anyhow record a motion of
any slope; noise and slope differ from channel to channel, and the limit is 0.3 to 3 dB above the
worst of them, or below it. Each test is looked at whenever it has grown by a tenth, until it is
decided surely, or for four hours. Samples are made by numpy from power laws; nothing but the
samples is shared with the estimator.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

from benchmarks.studies.leaning import BENCH
from daq.bench.model import Bench, Limit
from daq.estimation.settings import Settings
from daq.estimation.snapshot import ChannelLabel, Snapshot
from daq.results.result import Result
from estimator.decision.verdict import Prediction
from estimator.methods import self_noise
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import effective_averages, get_window

RATE, LONGEST, GROWTH = 20.0, 4 * 3600.0, 1.1
FIRST = 200.0
"""Seconds until the first look: twenty averages."""
DIMS = (3, 3, 3)
SETTINGS = Settings(methods=("three-sensor",), segment=10.0)
WELCH = WelchSettings(
    sampling_rate=RATE,
    segment_length=round(SETTINGS.segment * RATE),
    overlap=SETTINGS.overlap,
    window=SETTINGS.window,
    detrend=SETTINGS.detrend,
)
POINTS = np.geomspace(0.3, 9, 30)
CHANNELS = tuple(ChannelLabel(sensor, channel, "m/s²") for sensor in "ABC" for channel in "XYZ")


@dataclass(frozen=True, slots=True)
class Ended:
    """When a test ended, and what had been predicted at each look before."""

    seconds: float
    looks: tuple[tuple[float, Prediction | None], ...]

    def at(self, share: float) -> float | None:
        """Return the predicted length over the true one at a share of it; NaN: none predicted."""
        before = [each for each in self.looks if each[0] <= share * self.seconds]
        if not before:
            return None
        found = before[-1][1]
        return np.nan if found is None or found.seconds is None else found.seconds / self.seconds


def recorded(rng: np.random.Generator) -> tuple[np.ndarray, Bench]:
    """Return the samples of four hours of nine channels, and a bench with its limit."""
    n = round(LONGEST * RATE)
    frequency = np.maximum(np.fft.rfftfreq(n, 1 / RATE), 0.05)

    def series(psd: np.ndarray) -> np.ndarray:
        white = np.fft.rfft(rng.standard_normal(n))
        return np.fft.irfft(white * np.sqrt(psd * RATE / 2), n)

    motion = np.stack(
        [series(10 ** rng.uniform(1, 5) * frequency ** rng.uniform(-1, 1)) for _ in range(3)], 1
    )
    turned = np.vstack([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in DIMS])
    samples, highest = motion @ turned.T, 0.0
    shape = 1 + 1 / POINTS
    for channel in range(len(CHANNELS)):
        level, slope, corner = (rng.uniform(*ends) for ends in ((-4, 0), (-1.5, -0.5), (-0.5, 0.7)))

        def noise(f: np.ndarray) -> np.ndarray:
            return 10 ** (level / 10) * (1 + (f / 10**corner) ** slope)  # noqa: B023 - used at once

        samples[:, channel] += series(noise(frequency))
        highest = max(highest, float((noise(POINTS) / shape).max()))
    margin_db = rng.uniform(0.3, 3.0) * (1 if rng.random() < 0.75 else -1)
    psd = highest * 10 ** (margin_db / 10) * shape
    limit = Limit(name="limit", frequency=tuple(POINTS.tolist()), psd=tuple(psd.tolist()))
    return samples, BENCH.model_copy(update={"limits": (limit,)})


def test_of(rng: np.random.Generator) -> Ended | None:
    """Return when a test ends; None where four hours do not decide it."""
    samples, bench = recorded(rng)
    spectra = CrossSpectra(WELCH, len(CHANNELS))
    window = get_window(WELCH.window, WELCH.segment_length)
    looks: list[tuple[float, Prediction | None]] = []
    seconds = FIRST
    while seconds <= LONGEST:
        n_segments = (round(seconds * RATE) - WELCH.segment_length) // WELCH.hop + 1
        starts = np.arange(spectra.n_segments, n_segments) * WELCH.hop
        spectra.add(samples[starts[0] : starts[-1] + WELCH.segment_length], starts - starts[0])
        averages = effective_averages(window, WELCH.hop, n_segments)
        csm = spectra.csm()
        noise = self_noise(
            SETTINGS.methods[0],
            csm,
            dims=DIMS,
            n_effective=averages,
            real=WELCH.real(WELCH.frequencies),
        )
        snapshot = Snapshot(
            frequency=WELCH.frequencies,
            csm=csm,
            results={SETTINGS.methods[0]: noise},
            refused={},
            channels=CHANNELS,
            dims=DIMS,
            unit="m/s²",
            n_segments=n_segments,
            n_dropped=0,
            n_effective=averages,
            elapsed=seconds,
            start_utc_ns=0,
            sensors=(),
            clocks=(),
            drift=np.empty((0, 1 + len(DIMS))),
            closed=False,
        )
        verdict = Result(snapshot, SETTINGS, bench).verdict
        if verdict is None:
            raise ValueError("the bench has no limits")
        if verdict.is_sure:
            return Ended(seconds, tuple(looks))
        looks.append((seconds, verdict.prediction))
        seconds *= GROWTH
    return None


def main(n_tests: int, seed: int) -> None:
    """Print how far predicted lengths are from true ones."""
    found = [test_of(np.random.default_rng([seed, number])) for number in range(n_tests)]
    ended = [each for each in found if each is not None and each.looks]
    print(f"{n_tests} tests, {len(ended)} decided within four hours after the first look")
    for share in (0.25, 0.5, 0.6, 0.7, 0.8, 0.9):
        ratio = np.array([r for each in ended if (r := each.at(share)) is not None])
        within = np.mean(np.abs(np.nan_to_num(ratio, nan=np.inf) - 1) <= 0.3)
        low, middle, high = np.nanquantile(ratio, [0.1, 0.5, 0.9])
        print(
            f"at {share:.0%}: {ratio.size} tests, within 30 %: {within:.0%}, predicted over true "
            f"{middle:.2f} ({low:.2f} to {high:.2f})"
        )
    close = [
        abs(prediction.seconds / each.seconds - 1) <= 0.3
        for each in ended
        for _, prediction in each.looks
        if prediction is not None and prediction.seconds is not None and prediction.is_close
    ]
    print(f'{len(close)} predictions without "about", within 30 %: {np.mean(close):.0%}')


if __name__ == "__main__":
    main(*(int(each) for each in (*sys.argv[1:], *("100", "20261125")[len(sys.argv) - 1 :])))
