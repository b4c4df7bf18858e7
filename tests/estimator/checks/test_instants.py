"""Noise that depends on the motion is found, by the right name and size, and other noise is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from estimator.checks.instants import Dependence
from estimator.checks.linearity import MOST_SEGMENTS, SquaresAndCubes
from estimator.spectra.welch import WelchSettings

RATE = 100.0
WELCH = WelchSettings(RATE, 1000)
N_SAMPLES = WELCH.segment_length * MOST_SEGMENTS
TIME = np.arange(N_SAMPLES) / RATE


def later(x: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Return what is sampled later, by a course: linear between sixteenths of a sample."""
    fine = signal.resample_poly(x, 16, 1, axis=0)
    at = np.clip((np.arange(N_SAMPLES) - seconds * RATE) * 16, 0, len(fine) - 2)
    place = at.astype(int)
    part = (at - place)[:, None]
    return np.asarray((1 - part) * fine[place] + part * fine[place + 1])


def with_play(x: np.ndarray, width: float) -> np.ndarray:
    """Return what follows a course with play."""
    found, at = np.empty_like(x), x[0]
    for n, value in enumerate(x.tolist()):
        at = min(max(at, value - width), value + width)
        found[n] = at
    return found


def bench(rng: np.random.Generator, ratio: float, n_sensors: int, d: int) -> list[np.ndarray]:
    motion = 10 ** (ratio / 20) * rng.standard_normal((N_SAMPLES, d))
    return [motion @ np.linalg.qr(rng.standard_normal((d, d)))[0].T for _ in range(n_sensors)]


def dependences(
    rng: np.random.Generator, sensors: list[np.ndarray], past: tuple[float, ...] = (0.0,)
) -> list[Dependence]:
    samples = np.hstack([each + rng.standard_normal(each.shape) for each in sensors])
    tested = SquaresAndCubes(WELCH, 47.0)
    for segment in samples.reshape(-1, WELCH.segment_length, samples.shape[1]):
        tested.add(segment, np.repeat(past, samples.shape[1] // len(past)))
    return tested.dependences(np.repeat(np.arange(len(sensors)), sensors[0].shape[1]))


@pytest.mark.parametrize(("n_sensors", "d"), [(3, 3), (5, 3), (3, 1)])
@pytest.mark.parametrize("hertz", [0.05, 1.3, 5.0])
def test_instants_that_sway_have_their_size(n_sensors: int, d: int, hertz: float) -> None:
    rng = np.random.default_rng([1, n_sensors, d])
    sensors = bench(rng, 45.0, n_sensors, d)
    sensors[1] = later(sensors[1], 3e-5 * np.sin(2 * np.pi * hertz * TIME))
    found = dependences(rng, sensors)
    assert {each.channel // d for each in found} == {1}
    assert found[0].form == "instants"
    assert found[0].size == pytest.approx(3e-5 / np.sqrt(2), rel=0.5)


@pytest.mark.parametrize(("ratio", "size"), [(45.0, 0.005), (18.0, 0.2)])
def test_a_gain_that_jitters_within_segments_has_its_size(ratio: float, size: float) -> None:
    rng = np.random.default_rng(2)
    sensors = bench(rng, ratio, 3, 3)
    sensors[2] *= 1 + size * np.sin(2 * np.pi * 1.3 * TIME)[:, None]
    found = dependences(rng, sensors)
    assert {each.channel // 3 for each in found} == {2}
    assert found[0].form == "gain"
    assert found[0].size == pytest.approx(size / np.sqrt(2), rel=0.4)


def test_noise_that_lasts_a_little_longer_than_the_motion_is_loud_is_found() -> None:
    """Noise 2.5 times as high for .1 s, where a channel moves by more than 2 rms."""
    rng = np.random.default_rng(8)
    sensors = bench(rng, 40.0, 3, 3)
    x = sensors[0][:, 0]
    rattles = np.convolve(np.abs(x) > 2 * x.std(), np.ones(10), "same") > 0
    sensors[0] += 2.3 * rattles[:, None] * rng.standard_normal((N_SAMPLES, 3))
    assert {each.channel // 3 for each in dependences(rng, sensors)} == {0}


@pytest.mark.parametrize("past", [0.0, 0.003, -0.004])
def test_a_converter_bends_what_it_samples_by_its_own_clock(past: float) -> None:
    """Segments have samples at other instants, between which the curve is not seen."""

    def shifted(x: np.ndarray, seconds: float) -> np.ndarray:
        frequency = np.fft.rfftfreq(N_SAMPLES, 1 / RATE)[:, None]
        turn = np.exp(2j * np.pi * frequency * seconds)
        return np.fft.irfft(turn * np.fft.rfft(x, axis=0), N_SAMPLES, axis=0)

    rng = np.random.default_rng(7)
    sensors = bench(rng, 60.0, 3, 3)
    own = shifted(sensors[1], -past)
    own += 2e-3 * own.std() * np.sin(4 * np.pi * own / own.std())
    sensors[1] = shifted(own, past)
    found = dependences(rng, sensors, past=(0.0, past, 0.0))
    assert {(each.channel // 3, each.form) for each in found} == {(1, "curve")}
    assert not past or not dependences(rng, sensors)


def test_a_product_of_two_axes_is_in_its_channel() -> None:
    rng = np.random.default_rng(6)
    sensors = bench(rng, 45.0, 3, 3)
    x = sensors[1]
    x[:, 0] += 2e-3 * x[:, 1] * x[:, 2] / x[:, 1].std()
    found = dependences(rng, sensors)
    assert {(each.channel, each.form) for each in found} == {(3, "product")}
    added = 4e-6 * np.var(x[:, 2]) * 2 / RATE
    assert 1 < np.median(found[0].explained) / added < 4  # of the power below half the rate


@pytest.mark.parametrize(
    ("kind", "ratio", "size"),
    [
        ("play", 60.0, 0.005),
        ("play", 38.0, 0.005),
        ("play", 20.0, 0.1),
        ("steps of a converter", 60.0, 2e-3),
    ],
)
def test_what_bends_otherwise_is_a_curve(kind: str, ratio: float, size: float) -> None:
    """Of play of a tenth of the noise, the sign of the last step tells: no curve of the motion."""
    rng = np.random.default_rng(3)
    sensors = bench(rng, ratio, 3, 3)
    x = sensors[0][:, 1].copy()
    sensors[0][:, 1] = with_play(x, size * x.std())
    if kind == "steps of a converter":
        sensors[0][:, 1] = x + size * x.std() * np.sin(4 * np.pi * x / x.std())
    found = dependences(rng, sensors)
    assert {(each.channel, each.form) for each in found} == {(1, "curve")}
    assert not found[0].size
    assert np.median(found[0].explained) > 4 * 2 / RATE  # all of the noise may be of the motion


@pytest.mark.parametrize(("ratio", "corner"), [(40.0, 0.3), (60.0, 0.3), (60.0, 1.0)])
@pytest.mark.parametrize("times", [1, 2])
def test_the_square_of_an_integral_is_found_in_30_segments(
    ratio: float, corner: float, times: int
) -> None:
    """A displacement, or a velocity, is of few frequencies: it has few independent values."""
    rng = np.random.default_rng(9)
    sensors = bench(rng, ratio, 3, 3)
    far = x = sensors[0][:, 1]
    for _ in range(times):
        integral = signal.butter(2, corner, "high", fs=RATE, output="sos")
        far = signal.sosfilt(integral, np.cumsum(far))
    square = 2e-3 * x.std() * far**2 / far.var()
    sensors[0][:, 1] = x + square
    found = dependences(rng, [each[: 30 * WELCH.segment_length] for each in sensors])
    assert {each.channel for each in found} == {1}
    frequency, added = signal.welch(square, RATE, nperseg=WELCH.segment_length)
    here = (frequency > 2 * corner) & (frequency < 3 * corner)
    curve = next(each for each in found if each.form == "curve")
    assert curve.explained[here].sum() > added[here].sum()


def test_a_gain_that_is_another_one_after_large_motion_is_found() -> None:
    """A digitizer whose range is larger for .5 s: it is seldom the small one."""
    rng = np.random.default_rng(10)
    sensors = bench(rng, 60.0, 3, 3)
    x = sensors[1][:, 0]
    large = np.convolve(np.abs(x) > 1.8 * x.std(), np.ones(50))[: len(x)] > 0
    sensors[1][:, 0] = x * np.where(large, 1.005, 1.0)
    found = dependences(rng, sensors)
    assert {(each.channel, each.form) for each in found} == {(3, "gain")}


@pytest.mark.parametrize("most", [1.0, 1.5])
def test_a_channel_that_is_too_slow_for_most_of_its_motion_is_found(most: float) -> None:
    """What it does not follow is a fifth of its power: no noise that is loud by itself."""
    rng = np.random.default_rng(16)
    sensors = bench(rng, 40.0, 3, 3)
    x = sensors[1][:, 0]
    step, at, found = most * np.diff(x).std(), x[0], []
    for value in x.tolist():
        at += min(max(value - at, -step), step)
        found.append(at)
    sensors[1][:, 0] = found
    assert {each.channel for each in dependences(rng, sensors)} == {3}


@pytest.mark.parametrize(("kind", "slope"), [("play", -1.5), ("dead zone", -1.0)])
def test_play_or_a_dead_zone_beside_red_motion_is_found(kind: str, slope: float) -> None:
    """Noise of play is above the motion at most frequencies, and far below all of the motion.

    A dead zone is at 0, which the mean of a segment moves.
    """
    rng = np.random.default_rng(17)
    frequency = np.maximum(np.fft.rfftfreq(N_SAMPLES, 1 / RATE), 0.05)[:, None]
    sensors = [
        np.fft.irfft(np.fft.rfft(each, axis=0) * (frequency / 5) ** slope, axis=0)
        for each in bench(rng, 50.0, 3, 3)
    ]
    x, size = sensors[1][:, 0].copy(), 0.05 * float(sensors[1][:, 0].std())
    sensors[1][:, 0] = with_play(x, size) if kind == "play" else x - np.clip(x, -size, size)
    assert {each.channel for each in dependences(rng, sensors)} == {3}


def test_means_of_segments_move_a_dead_zone_in_lower_bands() -> None:
    """What moves more slowly than a segment moves the motion through the dead zone."""
    rng = np.random.default_rng(1)
    below = np.fft.rfftfreq(N_SAMPLES, 1 / RATE)[:, None] < 3.0
    sensors = [
        np.fft.irfft(np.fft.rfft(each, axis=0) * below, axis=0) for each in bench(rng, 50.0, 3, 3)
    ]
    slow = 2 * np.sin(2 * np.pi * TIME / 97)[:, None]
    sensors = [each + slow * each.std() for each in sensors]
    x = sensors[1][:, 0]
    x -= np.clip(x, -0.05 * x.std(), 0.05 * x.std())
    lowest = min(dependences(rng, sensors), key=lambda each: each.band[1])
    assert (lowest.channel, lowest.form) == (3, "curve")
    assert lowest.band[1] < 3.0


def test_short_gaps_that_are_filled_are_spikes_or_noise_where_motion_is_slow() -> None:
    rng = np.random.default_rng(4)
    sensors = bench(rng, 40.0, 3, 3)
    within = np.linspace(0, 1, 7)[1:-1, None]
    for at in rng.integers(10, N_SAMPLES - 10, 107):
        before, after = sensors[0][[at - 1, at + 5]]
        sensors[0][at : at + 5] = before + within * (after - before)
    found = dependences(rng, sensors)
    assert {each.channel // 3 for each in found} == {0}
    assert {each.form for each in found} <= {"filled", "spikes"}


def test_single_samples_that_are_late_are_spikes() -> None:
    rng = np.random.default_rng(7)
    sensors = bench(rng, 45.0, 3, 3)
    late = rng.integers(1, N_SAMPLES, 100)
    sensors[2][late] = sensors[2][late - 1]
    found = dependences(rng, sensors)
    assert {(each.channel // 3, each.form) for each in found} == {(2, "spikes")}


KINDS = ["steady", "gusts", "bursts", "noise in gusts", "heavy tails", "lag", "low pass", "step"]


@pytest.mark.parametrize("kind", KINDS)
def test_other_noise_depends_on_nothing(kind: str) -> None:
    for seed in range(4):
        rng = np.random.default_rng([5, seed])
        sensors = bench(rng, 20 + 10 * seed, 3 + seed % 2, 3)
        course = np.exp(0.7 * np.interp(TIME, TIME[::200], rng.standard_normal(N_SAMPLES // 200)))
        if kind in {"gusts", "noise in gusts"}:
            sensors = [each * course[:, None] for each in sensors]
        if kind == "noise in gusts":
            sensors = [each + rng.standard_normal(each.shape) * course[:, None] for each in sensors]
        if kind == "bursts":
            for at in rng.integers(0, N_SAMPLES - 2000, 8):
                for each in sensors:
                    each[at : at + 1000] *= 20
        if kind == "heavy tails":
            sensors = [each + rng.standard_normal(each.shape) ** 3 for each in sensors]
        if kind == "lag":
            sensors[0] = np.roll(sensors[0], 1, axis=0)
        if kind == "low pass":
            sensors[0] = signal.lfilter(*signal.butter(1, 0.4), sensors[0], axis=0)
        if kind == "step":
            sensors[0][N_SAMPLES // 2 :] *= 0.95
        assert not dependences(rng, sensors)
