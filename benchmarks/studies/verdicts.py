"""How often a verdict is wrong: simulated huddle tests whose noise is known, beside a limit.

Each test is a series of samples of three triaxial sensors that point anyhow: white motion, white
noise, the same in all channels and up to 3 dB below or above the limit. It lasts 20 s to 10 min.
One that is not decided goes on for as long as was predicted, and is judged again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.bench.channel import Channel
from daq.bench.model import Bench, Limit, Sensor
from daq.estimation.settings import Settings
from daq.estimation.snapshot import ChannelLabel, Snapshot
from daq.results.decision.verdict import TestVerdict
from daq.results.result import Result
from estimator.decision.verdict import Verdict
from estimator.errors import InsufficientDataError
from estimator.methods import self_noise
from estimator.self_noise.result import SelfNoise
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import effective_averages, get_window
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study

RATE, SEGMENT = 20.0, 2.0
METHOD = "three-sensor"
DIMS = (3, 3, 3)
N_CHANNELS = sum(DIMS)
N_TESTS = 200
SHORTEST, LONGEST = 20.0, 600.0
FARTHEST_DB = 3.0
"""Of the noise from the limit."""
MAX_AGAIN = 4 * 3600.0
"""Seconds to which a test is prolonged at most."""
SNRS = (1.0, 1e6)
WRONG = 0.025
"""Share of tests that may pass, and of those that may fail, and should not."""
HELD = 0.85
"""Share of the tests that the predicted length is to decide at a single look, at least."""
AT_ONCE = 20000
SEED = 20261122


@dataclass(frozen=True, slots=True)
class Outcome:
    """One simulated test.

    Attributes
    ----------
    above_db : float
        True noise above the limit; negative below it.
    seconds : float
    first : Verdict
    predicted : float or None
        Seconds in all, where that was predicted.
    second : Verdict or None
        After as long as was predicted; None where the test was not prolonged.
    """

    above_db: float
    seconds: float
    first: Verdict
    predicted: float | None = None
    second: Verdict | None = None

    def is_wrong(self, verdict: Verdict | None) -> bool:
        """Whether a verdict of this test is not that of its true noise."""
        if verdict is Verdict.PASS:
            return self.above_db > 0
        return verdict is Verdict.FAIL and self.above_db < 0


class SimulatedTest:
    """A huddle test that can go on: what is averaged so far, and what comes next.

    Parameters
    ----------
    rng : Generator
    snr : float
        Motion over noise in every channel.
    method : str
    """

    def __init__(self, rng: np.random.Generator, *, snr: float, method: str = METHOD) -> None:
        self._rng, self._snr = rng, snr
        self.settings = Settings(methods=(method,), segment=SEGMENT)
        self._welch = WelchSettings(
            sampling_rate=RATE,
            segment_length=round(SEGMENT * RATE),
            overlap=self.settings.overlap,
            window=self.settings.window,
            detrend=self.settings.detrend,
        )
        turned = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in DIMS]
        self._directions = np.vstack(turned)
        self._spectra = CrossSpectra(self._welch, N_CHANNELS)
        self._pending = np.empty((0, N_CHANNELS))
        self._n_samples = 0

    def record_until(self, seconds: float) -> None:
        """Simulate samples up to a time since the start."""
        while (left := round(seconds * RATE) - self._n_samples) > 0:
            n = min(left, AT_ONCE)
            motion = np.sqrt(self._snr) * self._rng.standard_normal((n, 3))
            noise = self._rng.standard_normal((n, N_CHANNELS))
            # A variance of half the rate is a one-sided density of 1.
            new = np.sqrt(RATE / 2) * (motion @ self._directions.T + noise)
            self._n_samples += n
            samples = np.concatenate([self._pending, new])
            length, hop = self._welch.segment_length, self._welch.hop
            n_segments = max(0, (len(samples) - length) // hop + 1)
            self._spectra.add(samples, np.arange(n_segments) * hop)
            self._pending = samples[n_segments * hop :]

    def verdict(self, limit_psd: float) -> TestVerdict:
        """Return the verdict so far."""
        found = Result(self._snapshot(), self.settings, _bench(limit_psd)).verdict
        if found is None:
            raise ValueError("the bench has no limits")
        return found

    def _snapshot(self) -> Snapshot:
        n_segments, method = self._spectra.n_segments, self.settings.methods[0]
        window = get_window(self._welch.window, self._welch.segment_length)
        averages = effective_averages(window, self._welch.hop, n_segments)
        csm = self._spectra.csm()
        results: dict[str, SelfNoise] = {}
        refused: dict[str, str] = {}
        try:
            results[method] = self_noise(
                method,
                csm,
                dims=DIMS,
                n_effective=averages,
                real=self._welch.real(self._welch.frequencies),
            )
        except InsufficientDataError as error:
            refused[method] = str(error)
        return Snapshot(
            frequency=self._welch.frequencies,
            csm=csm,
            results=results,
            refused=refused,
            channels=tuple(ChannelLabel(s, c, "m/s²") for s in "ABC" for c in "XYZ"),
            dims=DIMS,
            unit="m/s²",
            n_segments=n_segments,
            n_dropped=0,
            n_effective=averages,
            elapsed=self._n_samples / RATE,
            start_utc_ns=0,
            sensors=(),
            clocks=(),
            drift=np.empty((0, 1 + len(DIMS))),
            closed=True,
        )


def _bench(limit_psd: float) -> Bench:
    channels = tuple(Channel(name=name, sensitivity=1.0) for name in "XYZ")
    return Bench(
        name="verdicts",
        sampling_rate=RATE,
        sensors=tuple(
            Sensor(name=name, driver="text", port=name, sampling_rate=RATE, channels=channels)
            for name in "ABC"
        ),
        limits=(Limit(name="limit", frequency=(0.5, 9.0), psd=(limit_psd, limit_psd)),),
    )


def outcomes(
    n_tests: int,
    *,
    seed: int = SEED,
    method: str = METHOD,
    progress: ProgressCallback | None = None,
) -> list[Outcome]:
    """Simulate tests, and prolong those that are not decided."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(n_tests):
        if progress is not None:
            progress("verdicts: simulated tests", number / n_tests)
        above_db = rng.uniform(-FARTHEST_DB, FARTHEST_DB)
        seconds = float(np.exp(rng.uniform(np.log(SHORTEST), np.log(LONGEST))))
        snr = float(np.exp(rng.uniform(*np.log(SNRS))))
        test, limit = SimulatedTest(rng, snr=snr, method=method), 10 ** (-above_db / 10)
        test.record_until(seconds)
        verdict = test.verdict(limit)
        predicted = None if verdict.prediction is None else verdict.prediction.seconds
        second = None
        if predicted is not None and predicted <= MAX_AGAIN:
            test.record_until(predicted)
            second = test.verdict(limit).verdict
        found.append(Outcome(above_db, seconds, verdict.verdict, predicted, second))
    return found


def verdicts(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Count verdicts that are wrong, and predictions that hold.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `N_TESTS` to simulate.
    """
    found = outcomes(max(20, round(N_TESTS * length)), progress=progress)
    wrong = tuple(
        Series(
            f"wrong {verdict.value}",
            METHOD,
            "share",
            tuple(_wrong(found, verdict, low) for low in range(int(FARTHEST_DB))),
        )
        for verdict in (Verdict.PASS, Verdict.FAIL)
    )
    prolonged = [each for each in found if each.second is not None]
    held = sum(each.second is not Verdict.NOT_DECIDED for each in prolonged)
    share = held / max(1, len(prolonged))
    error = np.sqrt(HELD * (1 - HELD) / max(1, len(prolonged)))
    kept = Series(
        "predicted time decides",
        METHOD,
        "share",
        (Point(FARTHEST_DB / 2, share, 1.0, float(error), allowed=1 - HELD),),
    )
    x_label = "distance of the true noise from the limit (dB)"
    return Study(
        "verdicts",
        f"Verdicts on {len(found)} simulated tests of 20 s to 10 min",
        (
            Panel("(a) wrong verdicts", x_label, "share of all tests (1)", wrong),
            Panel("(b) not decided at first", x_label, "share of these (1)", (kept,)),
        ),
    )


def _wrong(found: Sequence[Outcome], verdict: Verdict, low: float) -> Point:
    """Return the share of all tests that ended in a verdict wrongly, at `low` to 1 dB more."""
    here = [each for each in found if low <= abs(each.above_db) < low + 1]
    n_wrong = sum(
        each.is_wrong(judged)
        for each in here
        for judged in {each.first, each.second}
        if judged is verdict
    )
    error = float(np.sqrt(WRONG * (1 - WRONG) / len(found)))
    return Point(low + 0.5, n_wrong / len(found), 0.0, error, allowed=WRONG)
