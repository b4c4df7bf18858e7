"""Sensors with unequal responses: without equalisation biased as predicted, with it not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

import huddle
from benchmarks.studies.synthesis import synthesise
from daq.bench.response import Fir, Measured, PolesZeros, Response
from daq.estimation import equalisation, noise_estimates
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.result import Result
from estimator.checks.advice_on_sensors import Delay, UnequalResponses
from estimator.methods import self_noise
from estimator.self_noise.result import SelfNoise
from sim_devices.world.scenario import Scenario
from tests import known_clocks
from tests.daq.clocks.recordings import Sensor, arriving, create, write

FloatArray = NDArray[np.float64]

RATE, N = 50.0, 14_000
NOISE = 2 * 100.0**2 / RATE  # one-sided PSD of white noise of 100 counts
CORNER = 2 * np.pi * 4.0
LOW_PASS = PolesZeros(
    zeros=(),
    poles=(CORNER * (-1 + 1j) / 2**0.5, CORNER * (-1 - 1j) / 2**0.5),
    frequency=0.01,
)

OFF = Settings(segment=4.0, equalise="off")


@cache
def samples(names: str = "abc") -> dict[str, FloatArray]:
    """Triaxial sensors at an SNR of 1e4; b is a low-pass of 4 Hz."""
    rng = np.random.default_rng(3)
    motion = 1e4 * rng.standard_normal((N, 3))
    frequency = np.arange(N // 2 + 1) * RATE / N
    found = {}
    for name in names:
        turned = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        if name == "b":
            spectrum = np.fft.rfft(turned, axis=0) * LOW_PASS.at(frequency)[:, None]
            turned = np.fft.irfft(spectrum, N, axis=0)
        found[name] = turned + 100 * rng.standard_normal((N, 3))
    return found


def recorded(names: str = "abc", *, known: bool = False) -> dict[str, Sensor]:
    return {
        name: Sensor(
            counts,
            rate=RATE,
            clock="one",
            channel={"response": LOW_PASS} if known and name == "b" else None,
        )
        for name, counts in samples(names).items()
    }


def excess(snapshot: Snapshot, low: float, high: float, *, known: bool = False) -> FloatArray:
    """Return the mean noise of each sensor in a band over the true one, less 1."""
    inside = (snapshot.frequency >= low) & (snapshot.frequency < high)
    noise = snapshot.results["three-sensor"].noise_psd[inside] / NOISE
    if known:
        noise[:, 3:6] *= np.abs(LOW_PASS.at(snapshot.frequency[inside]))[:, None] ** 2
    return np.asarray(noise.reshape(-1, 3, 3).mean(axis=(0, 2)) - 1)


@pytest.fixture(scope="module")
def biased(tmp_path_factory: pytest.TempPathFactory) -> Snapshot:
    return estimate([write(tmp_path_factory.mktemp("off") / "r.h5", recorded())], OFF)


def test_what_leaks_is_predicted_and_widens_intervals(biased: Snapshot) -> None:
    edges = biased.diagnostics.edge_leakage
    assert edges is not None
    assert edges.sources == ()
    inside = (biased.frequency >= 1) & (biased.frequency < 8)
    predicted = edges.left[inside, 3:6].mean() / NOISE
    seen = excess(biased, 1, 8)
    assert seen[1] > 5  # of |H'|² SNR / (3 T²)
    assert seen[1] == pytest.approx(predicted, rel=0.2)
    # 28 frequencies of 137 averages, three channels: 2 % of scatter
    assert abs(seen[[0, 2]]).max() < 0.08
    low = biased.results["three-sensor"].low[inside, 3:6]
    assert (low < 1.2 * NOISE).all()
    (advice,) = (a for a in biased.diagnostics.advice if isinstance(a, UnequalResponses))
    assert advice.sensors == (1,)
    assert advice.share > 0.8


def test_a_lag_of_many_samples_is_named_beside_a_response_that_differs(tmp_path: Path) -> None:
    late = {
        name: np.roll(each, 20 * (name == "c"), axis=0) for name, each in samples("acd").items()
    }
    sensors = {name: Sensor(each, rate=RATE, clock="one") for name, each in late.items()}
    advice = estimate([write(tmp_path / "r.h5", sensors)], OFF).diagnostics.advice
    assert any(isinstance(each, UnequalResponses) for each in advice)
    lags = [each for each in advice if isinstance(each, Delay)]
    assert {each.sensors for each in lags} == {(0, 1), (1, 2)}
    assert {round(abs(each.delay_samples), 2) for each in lags} == {20.0}


def test_a_response_that_differs_is_not_also_a_clock_that_lags(tmp_path: Path) -> None:
    """A first-order low-pass of 40 Hz delays by 4 ms, which a late clock could do as well."""
    rng = np.random.default_rng(3)
    motion = 1e4 * rng.standard_normal((N, 3))
    late = 1 / (1 + 1j * np.arange(N // 2 + 1) * RATE / N / 40.0)
    late_motion = np.fft.irfft(np.fft.rfft(motion, axis=0) * late[:, None], N, axis=0)
    sensors = {
        name: Sensor(seen + 100 * rng.standard_normal((N, 3)), rate=RATE, clock="one")
        for name, seen in (("a", motion), ("b", late_motion), ("c", motion))
    }
    path = write(tmp_path / "r.h5", sensors)
    plain, equalised = (estimate([path], replace(OFF, equalise=each)) for each in ("off", "auto"))
    for snapshot, sources in ((plain, ()), (equalised, ("estimated",))):
        (advice,) = snapshot.diagnostics.advice
        assert isinstance(advice, UnequalResponses)
        assert 1 in advice.sensors
        edges = snapshot.diagnostics.edge_leakage
        assert edges is not None
        assert edges.sources == sources
    assert excess(plain, 2, 15)[1] > 0.1
    assert abs(excess(equalised, 2, 15)).max() < 0.05


def test_equalised_by_measured_responses_the_noise_is_the_true_one(
    biased: Snapshot, tmp_path: Path
) -> None:
    path = tmp_path / "r.h5"
    writer = create(path, recorded())
    with Estimation([path], replace(OFF, equalise="auto")) as live:
        for number, block in enumerate(arriving(recorded())):
            writer.append(block)
            if number % 800 == 799:
                writer.commit()
                live.update()
        writer.close()
        live.update()
        growing = live.snapshot()
        ended = live.finish()
    offline = estimate([path], replace(OFF, equalise="estimated"))
    edges = ended.diagnostics.edge_leakage
    assert edges is not None
    assert edges.sources == ("estimated",)
    for snapshot in (growing, ended):
        # 1 % of scatter, and 0.2 % of 25 times the noise
        assert abs(excess(snapshot, 1, 8)).max() < 0.08
        low = snapshot.results["three-sensor"].low
        assert ((low < NOISE) | ~np.isfinite(low)).mean() > 0.95
    np.testing.assert_allclose(ended.csm, offline.csm, rtol=1e-9)
    # data are as they were, not as they were filtered
    inside = (biased.frequency > 1) & (biased.frequency < 8)
    np.testing.assert_allclose(ended.data_psd[inside], biased.data_psd[inside], rtol=0.2)


def test_one_of_seven_sensors_that_differs_is_equalised(tmp_path: Path) -> None:
    """The noise of many sensors is not taken from their triads."""
    path = write(tmp_path / "r.h5", recorded("abcdefg"))
    plain, equalised = (estimate([path], replace(OFF, equalise=each)) for each in ("off", "auto"))
    for snapshot in (plain, equalised):
        edges = snapshot.diagnostics.edge_leakage
        assert edges is not None
        inside = (snapshot.frequency >= 1) & (snapshot.frequency < 8)
        noise = next(iter(snapshot.results.values())).noise_psd[inside].mean(axis=0) / NOISE
        left = edges.left[inside].mean(axis=0) / NOISE
        others = np.delete(np.arange(21), [3, 4, 5])
        assert abs(noise[others] - 1).max() < 0.1
        assert left[others].max() < 0.05
        assert (left[3:6].mean() > 5) == (edges.sources == ()) == (snapshot is plain)
    # of the last: 1 % of scatter a channel; before, |H'|² SNR / (3 T²)
    assert abs(noise[3:6] - 1).max() < 0.1


def equal_sensors() -> dict[str, Sensor]:
    rng = np.random.default_rng(5)
    one = recorded()["a"]
    return {
        name: replace(one, counts=samples()["a"] + 100 * rng.standard_normal((N, 3)))
        for name in "abc"
    }


def test_equal_sensors_are_left_alone_by_rectangular_windows(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", equal_sensors())
    plain, automatic = (
        estimate([path], replace(OFF, window="rectangular", equalise=mode))
        for mode in ("off", "auto")
    )
    np.testing.assert_array_equal(plain.csm, automatic.csm)


@pytest.mark.parametrize(
    "rates", [(50.0, 50.0, 50.0), pytest.param((100.0, 200.0, 200.0), marks=pytest.mark.long)]
)
def test_resampling_is_not_taken_for_responses_of_sensors(
    tmp_path: Path, rates: tuple[float, float, float]
) -> None:
    """From 0.45 of the lowest rate on interpolation attenuates: nothing is estimated there."""
    white = {"shape": "white", "level": 1e-14}
    sensors = {
        name: {"sampling_rate": rate, "noise": white, "clock": {"ppm": ppm}}
        for name, rate, ppm in zip("abc", rates, (0, 10, -20), strict=True)
    }
    motion = {"spectra": [{"shape": "white", "level": 1e-8}]}
    scenario = Scenario.from_dict({"motion": motion, "sensors": sensors, "seed": 4})
    path = synthesise(tmp_path / "r.h5", scenario, duration=240.0, block=1.0)
    plain, automatic = (estimate([path], replace(OFF, equalise=mode)) for mode in ("off", "auto"))
    np.testing.assert_array_equal(plain.csm, automatic.csm)
    assert not any(isinstance(each, UnequalResponses) for each in plain.diagnostics.advice)


@pytest.mark.parametrize(("correct", "n_estimates"), [(True, 1), (False, 2)])
def test_noise_by_which_no_filter_was_needed_is_not_estimated_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, correct: bool, n_estimates: int
) -> None:
    path = write(tmp_path / "r.h5", equal_sensors())
    settings = replace(OFF, correct=correct)
    again = estimate([path], settings)
    estimated: list[str] = []

    def counted(method: str, *given: Any, **options: Any) -> SelfNoise:  # noqa: ANN401
        estimated.extend([method] if options.get("known") is None else [])
        return self_noise(method, *given, **options)

    for module in (equalisation, noise_estimates):
        monkeypatch.setattr(module, "self_noise", counted)
    found = estimate([path], replace(settings, equalise="auto"))
    assert estimated == ["three-sensor"] * n_estimates
    np.testing.assert_array_equal(found.csm, again.csm)
    for field in ("noise_psd", "cov", "low", "high", "flags"):
        one, other = (getattr(e.results["three-sensor"], field) for e in (found, again))
        np.testing.assert_array_equal(one, other)


def test_equalised_by_the_bench_file_the_noise_is_the_true_one(tmp_path: Path) -> None:
    """Segments around a gap are left out as far as filters reach."""
    sensors = recorded(known=True)
    sensors["c"].gaps = ((6_990, 7_010),)
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], replace(OFF, equalise="known"))
    assert 2 <= snapshot.n_dropped <= 7  # 4 s, and filters of as much to either side at most
    edges = snapshot.diagnostics.edge_leakage
    assert edges is not None
    assert edges.sources == ("known",)
    assert abs(excess(snapshot, 1, 8, known=True)).max() < 0.08
    stability = snapshot.diagnostics.diagnosis.stability if snapshot.diagnostics.diagnosis else None
    assert stability is not None
    assert stability.inflation < 1.5  # the filters are taken out of single segments, too


def test_a_measured_response_counts_as_far_as_it_was_measured(tmp_path: Path) -> None:
    measured = np.geomspace(0.01, 12.0, 60)
    values = LOW_PASS.at(measured)
    as_list = Response(
        (
            Measured(
                1.0, tuple(measured), tuple(np.abs(values)), tuple(np.unwrap(np.angle(values)))
            ),
            Fir(0.5, (1.0, 1.0), "none", RATE, 0.5 / RATE),  # 0 at half the sampling rate
        ),
        0.01,
    )
    sensors = recorded()
    for name in "abc":
        own = as_list if name == "b" else Response(as_list.stages[1:], 0.01)
        sensors[name] = replace(sensors[name], channel={"response": own})
    write(tmp_path / "a.h5", sensors)
    snapshot = estimate([tmp_path / "a.h5"], replace(OFF, equalise="known"))
    noise = snapshot.results["three-sensor"].noise_psd
    high = (snapshot.frequency > 12.5) & (snapshot.frequency < 20)
    assert np.isnan(noise[high][:, 3:6]).all()
    inside = (snapshot.frequency > 1) & (snapshot.frequency < 6)
    boxcar = np.abs(np.cos(np.pi * snapshot.frequency / RATE)) ** 2
    flat = noise[inside][:, :3] * boxcar[inside, None] / NOISE
    assert abs(np.mean(flat) - 1) < 0.15  # of which the errors are 0.05; without filters 100


@pytest.mark.long
def test_equal_sensors_are_not_spoilt_where_nothing_moves(tmp_path: Path) -> None:
    """Three flat sensors of other rates; no motion above 39 Hz, where noise was doubled."""
    scene = known_clocks.Scene(rates=(100.0, 250.0, 200.0), reach=0.35, seconds=300.0)
    known_clocks.record(tmp_path / "r.h5", scene)
    snapshot = estimate([tmp_path / "r.h5"], Settings())
    still = (snapshot.frequency > 40.0) & (snapshot.frequency < 44.0)
    noise = snapshot.results["three-sensor"].noise_psd[still].mean(axis=0)
    # 40 frequencies of 55 averages: 3 % of scatter
    np.testing.assert_allclose(noise, known_clocks.NOISE, rtol=0.1)
    edges = snapshot.diagnostics.edge_leakage
    assert edges is not None
    assert not edges.sources


def test_rectangular_windows_do_not_make_equal_sensors_differ(tmp_path: Path) -> None:
    """The scatter of |H'|² was taken for leakage of 85 % of the noise: the slope is two jumps."""
    rng = np.random.default_rng(6)
    motion = 1e4 * rng.standard_normal((60_000, 3))
    sensors = {
        name: Sensor(
            motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
            + 100 * rng.standard_normal(motion.shape),
            rate=200.0,
            clock="one",
        )
        for name in "abc"
    }
    settings = Settings(segment=10.0, window="rectangular", overlap=0.0)
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], settings)
    assert not any(isinstance(each, UnequalResponses) for each in snapshot.diagnostics.advice)
    edges = snapshot.diagnostics.edge_leakage
    assert edges is not None
    inside = (snapshot.frequency > 4) & (snapshot.frequency < 88)
    assert edges.most[inside].mean() < 0.05 * 2 * 100.0**2 / 200.0


def test_noise_at_lines_that_have_leaked_is_at_most_what_is_found() -> None:
    """Red motion, rectangular windows, a low pass in A: three times its noise, known to 20 %."""
    rng = np.random.default_rng(20)
    motion = lfilter(*butter(2, 0.6, fs=100.0), rng.standard_normal((26_000, 3)), axis=0)
    samples = {}
    for name in "ABC":
        felt = 5 * 10**2.5 * motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        felt = lfilter(*butter(1, 30.0, fs=100.0), felt, axis=0) if name == "A" else felt
        samples[name] = felt[2000:] + rng.standard_normal((24_000, 3))
    snapshot = huddle.self_noise(
        samples, fs=100.0, segment="10s", window="rectangular", overlap=0.0
    ).snapshot
    for column, mean in enumerate(Result(snapshot, Settings()).means("three-sensor", (4.0, 14.0))):
        assert mean.high[0] > 0.02
        assert (mean.mean[0] > 0.04) == (mean.low[0] < 0) == (column < 3)
