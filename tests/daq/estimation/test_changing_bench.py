"""A bench that changes: what changes is named, sized and dated, and intervals allow for it."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

import huddle
from daq.estimation.estimation import Estimation
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import data_means
from daq.results.calibration import calibrate
from daq.results.result import Result
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import DisturbedSegments, NoiseChanges, ResponseChanges
from tests.acceptance.broken_assumptions import one

RATE = 20.0
N = round(1200 * RATE)
NOISE = 2 / RATE  # PSD of white noise of variance 1


def recorded(kind: str, seed: int, ratio: float = 1e4, n: int = N) -> dict[str, np.ndarray]:
    """White motion of this ratio to white noise; something changes in sensor B."""
    rng = np.random.default_rng([seed, 4747])
    time = np.arange(n) / n
    motion = np.sqrt(ratio) * rng.standard_normal((n, 3))
    if kind == "stops":
        motion[n // 2 :] = 0
    if kind == "red":
        motion = 1e-2 * np.cumsum(np.cumsum(motion - motion.mean(axis=0), axis=0), axis=0)
    if "weak" in kind:  # one of three directions is as loud as the noise
        motion[:, 2] /= np.sqrt(ratio)
    if "bursts" in kind:  # of 6 s
        motion *= (np.arange(n) / RATE % (300 if "few" in kind else 30) < 6)[:, None]
    later = time >= 0.4
    samples = {}
    for name in "ABC":
        turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        felt = motion @ turn.T
        if name == "B" and "late" in kind:
            turns = np.exp(-2j * np.pi * 0.01 * np.fft.rfftfreq(n, 1 / RATE))
            felt = np.fft.irfft(np.fft.rfft(felt, axis=0) * turns[:, None], n, axis=0)
        if name == "B" and "step" in kind:
            felt[later, 0] *= 0.95
        elif name == "B" and kind == "ramp":
            felt *= (1 + 0.03 * (time - 0.5))[:, None]
        elif name == "B" and kind == "settles":
            felt[later] = felt[later] @ Rotation.from_rotvec([0, 0, np.radians(0.05)]).as_matrix()
        elif name == "B" and kind == "jitter":  # in steps of 4 s
            felt *= 1 + 0.02 * rng.standard_normal((n // 80, 1)).repeat(80, axis=0)
        elif name == "B" and "halves" in kind:  # a part of time is 20 segments, of 2.5 s each
            felt[np.arange(n) // round(25 * RATE) % 2 == 1, 0] *= 1.05
        elif kind == "temperature":
            felt *= 1 + 0.02 * rng.standard_normal(3) * (np.sin(np.pi * time) - 0.5)[:, None]
        samples[name] = felt + rng.standard_normal((n, 3))
    return samples


@functools.cache  # several tests look at one bench
def estimated(
    kind: str, seed: int, *, ratio: float = 1e4, n: int = N, option: str = ""
) -> Snapshot:
    samples = recorded(kind, seed, ratio, n)
    return huddle.self_noise(
        samples, fs=RATE, segment="5s", octaves=option == "octaves", reject=option == "reject"
    ).snapshot


def held(snapshot: Snapshot, columns: slice = slice(None)) -> float:
    """Return the share of intervals of single frequencies that hold the expected noise."""
    noise = snapshot.results["three-sensor"]
    low, high = noise.low[5:45, columns], noise.high[5:45, columns]
    return float(np.mean((low <= NOISE) & (high >= NOISE)))


def changes(snapshot: Snapshot) -> list[ResponseChanges]:
    return [each for each in snapshot.diagnostics.advice if isinstance(each, ResponseChanges)]


@pytest.mark.parametrize("at", [0.02, 0.985])
def test_a_step_near_an_end_of_the_recording_has_a_least_size(at: float) -> None:
    """Within the first or the last part of time, its place and so its size are not known."""
    samples = recorded("", 1, 1e6)
    samples["B"][round(at * N) :] *= 1.05
    snapshot = huddle.self_noise(samples, fs=RATE, segment="5s").snapshot
    (change,) = changes(snapshot)
    assert 0 < change.size < 0.04
    assert change.size_error == np.inf
    assert "rose by at least" in change.words(snapshot.names).line
    assert "standard error" not in str(change.words(snapshot.names))


@pytest.mark.parametrize(
    ("kind", "size", "words"),
    [
        ("step", -0.05, ("The gain of B.1 fell by", " at 4")),
        ("ramp", 0.03, ("The gain of B rose by 3 %", "from 0 s to")),
        ("settles", np.radians(0.05), ("Sensor B turned by 0.0", " at 4")),
    ],
)
def test_a_response_that_changes_is_named_sized_and_dated(
    kind: str, size: float, words: tuple[str, ...]
) -> None:
    snapshot = estimated(kind, 1, ratio=1e6)
    (change,) = changes(snapshot)
    text = change.words(replace(snapshot.names, start_utc_ns=0)).line
    for each in words:
        assert each in text
    assert change.size == pytest.approx(size, rel=0.02)
    assert change.size == pytest.approx(size, abs=3 * change.size_error)
    if kind != "ramp":
        assert change.begin == change.end == pytest.approx(480, abs=50 / 16)  # of a part
    assert not any(isinstance(each, NoiseChanges) for each in snapshot.diagnostics.advice)
    assert held(snapshot, slice(3, 6)) > 0.93  # of which the estimate is far off


@pytest.mark.parametrize(("kind", "most"), [("step", 1.0), ("ramp", 2.5), ("settles", 1.0)])
def test_levels_within_parts_are_those_of_a_steady_bench(kind: str, most: float) -> None:
    """Over all parts, motion 60 dB above the noise leaves up to 28 dB in it."""
    snapshot = estimated(kind, 1, ratio=1e6)
    found = Result(snapshot, Settings()).spectrum("three-sensor").levels(np.array([5, 15, 30, 45]))
    assert np.abs(10 * np.log10(found.mean / NOISE)).max() < most
    assert held(snapshot) > 0.93
    assert snapshot.n_effective < 420  # of 455: every part has spent three


@pytest.mark.parametrize("octaves", [False, True])
def test_a_tap_as_loud_as_the_motion_names_the_sensor_and_opens_its_interval(
    *, octaves: bool
) -> None:
    """It is taken for motion: the model failed, and "move them closer" was all that was said."""
    samples = recorded("steady", 3)
    begin = int(0.6 * N)
    samples["B"][begin : begin + 20] += 300 * np.random.default_rng(9).standard_normal((20, 3))
    snapshot = huddle.self_noise(samples, fs=RATE, segment="5s", octaves=octaves).snapshot
    (found,) = [e for e in snapshot.diagnostics.advice if isinstance(e, DisturbedSegments)]
    assert snapshot.channels[found.channel].sensor == "B"
    assert begin / RATE - 5 < found.times[0] < begin / RATE + 1
    assert not np.isfinite(found.excess)
    assert "noise too high; use --reject" in found.words(snapshot.names).line
    result = Result(snapshot, Settings())
    for mean in result.means(result.method, (1.0, 9.0))[3:6]:
        assert mean.low[0] <= NOISE <= mean.high[0]


def test_many_taps_of_one_sensor_open_its_interval() -> None:
    """12 in 20 min beside motion of 20 dB, in more than a twentieth of the segments."""
    rng = np.random.default_rng(81)
    motion = 10 * rng.standard_normal((N, 3))
    samples = {
        name: motion @ Rotation.random(random_state=n).as_matrix().T + rng.standard_normal((N, 3))
        for n, name in enumerate("ABC")
    }
    for at in np.linspace(800, N - 800, 12).astype(int):
        samples["A"][at : at + 4] += 150 * rng.standard_normal((4, 3))
    snapshot = huddle.self_noise(samples, fs=RATE, segment="10s").snapshot
    assert snapshot.diagnostics.diagnosis is not None
    assert snapshot.diagnostics.diagnosis.stability is not None
    assert len(snapshot.diagnostics.diagnosis.stability.disturbed) > 0.05 * snapshot.n_segments
    result = Result(snapshot, Settings())
    for mean in result.means(result.method, (1.0, 9.0))[:3]:
        assert mean.low[0] <= 2 / RATE <= mean.high[0]


def test_a_tap_that_looks_like_a_gain_in_a_short_test_opens_the_interval() -> None:
    """Of 23 segments beside motion of 6 dB: up to 21 times too high, known to 12 %."""
    rng = np.random.default_rng(80)
    motion = 2 * rng.standard_normal((6000, 3))
    samples = {
        f"s{n}": motion @ Rotation.random(random_state=n).as_matrix().T
        + rng.standard_normal((6000, 3))
        for n in range(4)
    }
    samples["s0"][4800:4810] += 80 * rng.standard_normal((10, 3))
    snapshot = huddle.self_noise(samples, fs=50.0, segment="10s").snapshot
    result = Result(snapshot, Settings())
    for mean in result.means(result.method, (1.0, 20.0))[:3]:
        assert mean.low[0] <= 2 / 50.0 <= mean.high[0]


def test_noise_is_at_most_what_is_found_until_the_model_can_be_tested() -> None:
    """Eight sensors feel a second motion to other degrees: 13 dB too high, known to 4 %."""
    rng = np.random.default_rng(47)
    first, second = rng.standard_normal((1200, 3)), rng.standard_normal((1200, 1))
    felt = rng.uniform(-1, 1, (8, 3))
    samples = {
        f"s{n}": 100 * first @ Rotation.random(random_state=n).as_matrix().T
        + 10 * second * felt[n]
        + rng.standard_normal((1200, 3))
        for n in range(8)
    }
    snapshot = huddle.self_noise(samples, fs=RATE, segment="5s").snapshot
    assert snapshot.n_effective < len(snapshot.channels)
    result = Result(snapshot, Settings())
    for mean in result.means("three-sensor", (1.0, 9.0)):
        assert mean.low[0] <= NOISE < mean.mean[0] < mean.high[0]
    assert any("record longer" in fact.words.line for fact in result.facts)


def test_noise_is_at_most_what_is_found_until_steadiness_can_be_tested() -> None:
    """Eleven averages of nine channels, of which a gain steps by 5 %: 7 times, known to 5 %."""
    snapshot = estimated("step", 6, n=round(33 * RATE))
    result = Result(snapshot, Settings())
    assert snapshot.diagnostics.untested is None
    for mean in result.means("three-sensor", (1.0, 9.0)):
        assert mean.low[0] <= NOISE <= mean.high[0]
    assert "The test of steadiness needs more averages: record longer" in str(
        [fact.words.line for fact in result.facts]
    )


def test_a_burst_of_the_motion_disturbs_no_quiet_sensor() -> None:
    rng = np.random.default_rng(4)
    motion = rng.standard_normal(N)
    motion[N // 2 : N // 2 + 400] *= 100
    noise = {"A": 30.0, "B": 1.0, "C": 30.0}
    samples = {name: motion + e * rng.standard_normal(N) for name, e in noise.items()}
    snapshot = huddle.self_noise(samples, fs=RATE, segment="5s").snapshot
    assert not any(isinstance(e, DisturbedSegments) for e in snapshot.diagnostics.advice)


@pytest.mark.parametrize("octaves", [False, True])
def test_of_few_averages_a_change_is_named_and_opens_the_interval(*, octaves: bool) -> None:
    """Of twelve channels, 39 averages are none within parts of as many averages as channels."""
    rng = np.random.default_rng(12)
    n = round(200 * RATE)
    motion = np.sqrt(1e4) * rng.standard_normal((n, 3))
    samples = {name: motion + rng.standard_normal((n, 3)) for name in "ABCD"}
    samples["B"] += 0.05 * motion * (np.arange(n) > 0.4 * n)[:, None]
    snapshot = huddle.self_noise(samples, fs=RATE, segment="5s", octaves=octaves).snapshot
    (change,) = [e for e in snapshot.diagnostics.advice if isinstance(e, ResponseChanges)]
    assert change.sensors == (1,)
    assert change.size == pytest.approx(0.05, rel=0.1)
    result = Result(snapshot, Settings())
    for mean in result.means(result.method, (1.0, 9.0)):
        assert mean.low[0] <= NOISE <= mean.high[0]


@pytest.mark.parametrize(("step", "rate"), [(3.0, 100.0), (10.0, 100.0), (10.0, 20.0)])
def test_of_few_averages_beside_weak_motion_a_large_step_is_no_noise(
    step: float, rate: float
) -> None:
    """What a step leaves of the motion looks like noise: it was 14 dB too high within .1 dB."""
    rng = np.random.default_rng(3)
    n = round(150 * rate)
    motion = 10 * rng.standard_normal((n, 3))
    samples = {name: motion + rng.standard_normal((n, 3)) for name in "ABC"}
    samples["A"][n // 2 :] *= step
    snapshot = huddle.self_noise(samples, fs=rate, segment="10s").snapshot
    (change,) = changes(snapshot)
    assert change.sensors == (0,)
    if change.band is not None and rate < 100.0:  # the interval is open in all bands
        assert change.band[0] < 0.1 * rate < 0.4 * rate < change.band[1]
    result = Result(snapshot, Settings())
    for mean in result.means(result.method, (1.0, 0.4 * rate))[:3]:
        assert mean.low[0] <= (1 + step**2) / rate <= mean.high[0]
    assert not any("no bias" in fact.words.explanation for fact in result.facts)


@pytest.mark.parametrize(
    ("kind", "channel", "least", "ratio", "option"),
    [
        pytest.param("jitter", None, 0.01, 1e4, "", marks=pytest.mark.long),
        ("jitter", None, 0.01, 1e6, ""),  # of segments of 5 s, weighted by the window
        ("halves", 3, 0.02, 1e4, ""),
        ("halves, weak", 3, 0.02, 1e4, ""),
        ("halves", 3, 0.02, 1e4, "octaves"),
        ("halves", 3, 0.02, 1e4, "reject"),
    ],
)
def test_a_gain_that_changes_within_parts_bounds_its_noise(
    kind: str, channel: int | None, least: float, ratio: float, option: str
) -> None:
    """Parts of time do not show it: noise of B was 7 and 26 dB too high in silence."""
    snapshot = estimated(kind, 1, ratio=ratio, option=option)
    (change,) = changes(snapshot)
    assert change.sensors == (1,)
    assert change.channel == channel
    assert least < change.size < least + 0.01
    assert held(snapshot) > 0.93
    if kind == "halves" and option != "octaves":  # parts that show nothing are not used
        assert snapshot.n_effective > 440


def test_a_change_excuses_no_sensitivity_that_it_does_not_explain() -> None:
    """Half as much again is no mean of what rises by a fifth; its step alone says no more."""
    rng = np.random.default_rng(5)
    motion = 30 * rng.standard_normal((30_000, 3))
    rises = (1 + 0.2 * (np.arange(30_000) > 15_000))[:, None]
    for sensitivity in (1.0, 1.5):
        samples = {name: motion + rng.standard_normal(motion.shape) for name in "ABC"}
        samples["B"] = sensitivity * rises * motion + rng.standard_normal(motion.shape)
        snapshot = huddle.self_noise(samples, fs=100.0, segment="10s").snapshot
        facts = Result(snapshot, Settings()).facts
        is_said = any("reads 1." in fact.words.line for fact in facts)
        assert is_said == (sensitivity > 1)


@pytest.mark.parametrize("gain", [0.0, pytest.param(0.05, marks=pytest.mark.long)])
def test_of_several_changes_of_a_sensor_the_largest_is_named(gain: float) -> None:
    """With octaves, .99 % at 2 to 4 Hz were named, or the gain that changes each 25 s."""
    samples = recorded("", 1, n=2 * N)
    late, parts = np.arange(2 * N) > N, np.arange(2 * N) // round(25 * RATE)
    samples["B"][:, 0] *= 1 + gain * (parts % 2)
    sections = butter(1, 0.05, "high", fs=RATE, output="sos")
    samples["B"][:, 1] = np.where(late, sosfilt(sections, samples["B"][:, 1]), samples["B"][:, 1])
    snapshot = huddle.self_noise(samples, fs=RATE, octaves=True).snapshot
    (change,) = changes(snapshot)
    assert change.sensors == (1,)
    assert change.size > 0.2
    assert change.band is not None
    assert change.band[1] < 1.0


def test_an_estimate_that_still_grows_holds_what_a_step_adds() -> None:
    """Averages are those of all segments until it is finished: noise of B is anything below."""
    recording = recording_of_arrays(recorded("step", 5), RATE)
    with Estimation([recording], Settings(segment=5.0)) as live:
        while live.update():
            pass
        snapshot = live.snapshot()
    assert held(snapshot) > 0.93
    assert np.mean(snapshot.results["three-sensor"].low[5:45, 3] <= 0) > 0.93


@pytest.mark.long
@pytest.mark.parametrize("option", ["octaves", "reject"])
def test_changes_are_found_with_every_option(option: str) -> None:
    snapshot = estimated("step", 4, ratio=1e6, option=option)
    (change,) = changes(snapshot)
    assert change.channel == 3
    assert change.size == pytest.approx(-0.05, rel=0.1)
    noise = snapshot.results["three-sensor"]
    inside = (snapshot.frequency > 1) & (snapshot.frequency < 9)
    known = np.isfinite(noise.noise_psd) & inside[:, None]
    assert known.sum() > 250
    assert np.isfinite(data_means(snapshot, (1.0, 9.0))).all()  # also with few frequencies of parts
    assert np.mean(((noise.low <= NOISE) & (noise.high >= NOISE))[known]) > 0.93


@pytest.mark.long
def test_gains_that_follow_one_temperature_bound_bands_without_a_noise_that_is_known() -> None:
    outcome = one(("gains follow one temperature, 2 % rms",), 60, 3, 1)
    assert outcome.held > 0.93 * outcome.n_levels


def test_gains_that_follow_one_temperature_are_found() -> None:
    """Motion in which all sensors differ hides the noise of one: it seems to be zero."""
    snapshot = estimated("temperature", 2)
    assert changes(snapshot)
    assert held(snapshot) > 0.93


@pytest.mark.parametrize(
    ("kind", "ratio"), [("steady", 1e4), ("steady", 1e12), ("stops", 1e4), ("red", 1e4)]
)
def test_a_steady_bench_raises_no_alarm(kind: str, ratio: float) -> None:
    """Ten tests of responses at 0.2 %, and of noise in all bands at 0.1 %."""
    for seed in range(2):
        snapshot = estimated(kind, seed, ratio=ratio, n=N // 2)
        kinds = ResponseChanges | NoiseChanges
        assert not [each for each in snapshot.diagnostics.advice if isinstance(each, kinds)]
        assert all(clock.is_understood for clock in snapshot.clocks)


def test_leakage_at_the_edges_of_bursts_is_no_change_and_no_disturbance() -> None:
    """A delay of 10 ms by windows of 5 s adds 5 times the noise: as a gain, in each segment."""
    for seed in range(2):
        assert not changes(estimated("late bursts", seed, ratio=1e5))
        kinds = {
            each.name for each in estimated("late few bursts", seed, ratio=1e5).diagnostics.advice
        }
        assert not kinds & {"response-changes", "disturbed-segments"}
        (change,) = changes(estimated("late bursts step", seed, ratio=1e5))
        assert change.sensors == (1,)
        assert change.size == pytest.approx(-0.05, rel=0.1)


def test_bursts_of_motion_among_weaker_motion_than_noise_are_no_change() -> None:
    """The noise of the fit is wrong by its scatter: outside of bursts that looks like a gain."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        motion = 0.2 * rng.standard_normal((N, 1))
        motion[N // 3 : N // 3 + 1000] *= 100
        samples = {
            name: motion + own * rng.standard_normal((N, 1))
            for name, own in zip("ABC", (1.0, 0.5, 2.0), strict=True)
        }
        assert not changes(huddle.self_noise(samples, fs=RATE, segment="5s").snapshot)


def test_steady_noise_of_more_than_4096_segments_scatters_as_all_of_them() -> None:
    rng = np.random.default_rng(3)
    n = round(5200 * 0.5 * RATE)
    motion = 30 * rng.standard_normal((n, 1))
    samples = {name: motion + rng.standard_normal((n, 1)) for name in "ABC"}
    found = huddle.self_noise(samples, fs=RATE, segment="1s").snapshot
    assert found.n_segments > 4096
    diagnosis = found.diagnostics.diagnosis
    assert diagnosis is not None
    assert diagnosis.stability is not None
    assert diagnosis.stability.n_segments == found.n_segments
    scatter = diagnosis.stability.parts
    known = np.isfinite(scatter.statistic)
    degrees = (scatter.n_parts - 1) * int(known.sum())
    mean = float(scatter.statistic[known].sum()) / degrees
    assert mean == pytest.approx(1, abs=5 * np.sqrt(2 / degrees))
    assert diagnosis.stability.inflation == 1


def test_a_gain_that_drifts_is_in_the_uncertainty_of_the_calibration() -> None:
    """A ramp of 3 % has the standard deviation 3 % / sqrt(12)."""
    snapshot = estimated("ramp", 1, ratio=1e6)
    found = calibrate(Result(snapshot, Settings()), None, reference="A")
    by_sensor = {
        budget.sensor: {each.source: each.relative for each in budget.components}
        for budget in found.budgets
        if budget.quantity == "sensitivity"
    }
    assert by_sensor["B"]["drift"] == pytest.approx(0.03 / np.sqrt(12), rel=0.05)
    assert "drift" not in by_sensor["C"]
    found = calibrate(Result(snapshot, Settings()), None, reference="B")
    assert all("drift" in {e.source for e in each.components} for each in found.budgets[:3])


@pytest.mark.parametrize(("segment", "is_tested"), [("50s", False), ("0.5s", True)])
def test_too_few_averages_to_test_for_changes_are_a_fact(segment: str, *, is_tested: bool) -> None:
    rng = np.random.default_rng(8)
    motion = 30 * rng.standard_normal((3000, 1))
    samples = {name: motion + rng.standard_normal((3000, 1)) for name in "ABC"}
    found = huddle.self_noise(samples, fs=RATE, segment=segment)
    names = [each.name for each in found.result.facts]
    assert ("steadiness-not-tested" not in names) == is_tested


def test_noise_that_changes_between_bands_that_fail_is_named() -> None:
    """Other axes below 1.2 and above 5 Hz; the noise of A.X alone steps between them."""
    samples, n = recorded("", 3, ratio=100, n=N), N
    rng = np.random.default_rng(3)

    def band(low: float, high: float, n_channels: int) -> np.ndarray:
        some = butter(6, (low, high), "bandpass", fs=RATE, output="sos")
        return np.asarray(sosfilt(some, rng.standard_normal((n, n_channels)), axis=0))

    others = band(0.3, 1.2, 3) + band(5.0, 9.0, 3)
    for name in samples:
        samples[name] += others @ rng.standard_normal((3, 3))
    samples["A"][:, 0] += 1.3 * band(1.6, 4.0, 1)[:, 0] * (np.arange(n) > n / 2)
    advice = huddle.self_noise(samples, fs=RATE).snapshot.diagnostics.advice
    assert {e.band for e in advice if isinstance(e, ModelMisfit)} == {(0.0, 1.5), (4.1, 10.0)}
    (change,) = [each for each in advice if isinstance(each, NoiseChanges)]
    assert change.channel == 0
    assert change.band is not None
    assert 1.5 < change.band[0] < change.band[1] < 4.1
