"""The common motion: one function of time, with the spectra that were asked for."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy import signal

from sim_devices.arrays import ComplexArray, FloatArray
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import GaussianSeries, Motion, WhiteSources, World
from tests.waiting import python

RATE = 200.0


def white(level: float) -> dict[str, Any]:
    return {"shape": "white", "level": level}


def scenario(sensors: dict[str, dict[str, Any]], **motion: Any) -> Scenario:  # noqa: ANN401  # a table
    motion = motion or {"spectra": [white(1.0)] * 3}
    table = {"seed": 11, "motion": motion, "sensors": sensors, "longest_block": 4096}
    return Scenario.from_dict(table, sampling_rate=RATE)


def csm(*channels: FloatArray) -> tuple[FloatArray, ComplexArray, int]:
    """Cross-spectral matrix ``E[X_p conj(X_q)]`` of non-overlapping Hann segments."""
    stacked = np.stack(channels)
    n_segment = 2000
    n_segments: int = stacked.shape[1] // n_segment
    window = signal.windows.hann(n_segment, sym=False)
    cut = stacked[:, : n_segments * n_segment].reshape(len(stacked), n_segments, n_segment)
    spectra = np.fft.rfft(cut * window)
    scale = 2 / (RATE * np.sum(window**2) * n_segments)
    matrix: ComplexArray = scale * np.einsum("psf,qsf->fpq", spectra, spectra.conj())
    frequency = np.arange(n_segment // 2 + 1, dtype=np.float64) * (RATE / n_segment)
    return frequency, matrix, n_segments


def test_motion_and_noise_have_the_requested_psd_within_statistical_error() -> None:
    spectra = [
        {"shape": "mixed", "level": 1.0},
        {"shape": "pink", "level": 5.0},
        {"shape": "sum", "terms": [white(1), {"shape": "resonance", "level": 50, "frequency": 8,
                                              "damping": 0.02}]},
    ]  # fmt: skip
    still = {"spectra": [white(0.0)] * 3}
    moved, noisy = (
        Scenario.from_dict({"seed": 11, "motion": motion, "sensors": sensors}, sampling_rate=RATE)
        for motion, sensors in (
            ({"spectra": spectra}, {"A": {}}),
            (still, {"A": {"noise": spectra}}),
        )
    )
    for model in (moved, noisy):
        frequency, matrix, n = csm(*World(model).samples("A", 0, 200_000).T)
        for low, high in ((0.3, 1.0), (1.0, 7.0), (7.0, 9.0), (9.0, 60.0), (60.0, 89.0)):
            band = (frequency >= low) & (frequency < high)
            for channel, spectrum in enumerate(noisy.noise_spectra("A")):
                fine = np.linspace(frequency[1] / -2, frequency[1] / 2, 11)
                psd = spectrum.psd(np.abs(frequency[band][:, None] + fine)).mean(axis=1)
                ratio = np.mean(matrix[band, channel, channel].real / psd)
                # neighbouring Hann bins share 2/3 of their noise: 1.94 bins count as one
                assert ratio == pytest.approx(1.0, abs=4 * np.sqrt(1.94 / (n * band.sum())) + 0.004)


def test_the_motion_ends_below_nyquist_and_noise_does_not() -> None:
    model = scenario({"A": {}, "N": {"noise": white(1.0), "gain": 0.0}})
    frequency, moved, _ = csm(World(model).samples("A", 0, 100_000)[:, 0])
    _, noise, n = csm(World(model).samples("N", 0, 100_000)[:, 0])
    # the last hertz holds no more than what interpolation and the cosine's end leave
    assert np.all(moved[frequency > 99.9, 0, 0].real < 1e-3)
    near = noise[(frequency > 90) & (frequency < 99.8), 0, 0].real
    assert near.mean() == pytest.approx(1.0, abs=4 * np.sqrt(1.94 / (n * near.size)))


def test_cross_psd_follows_the_mixing_matrix() -> None:
    mixing = [[1.0, 0.0], [0.6, 0.8], [-0.5, 2.0]]
    model = scenario({"A": {}}, spectra=[white(1.0), white(2.0)], mixing=mixing)
    frequency, matrix, n = csm(*World(model).samples("A", 0, 100_000).T)
    band = (frequency > 1) & (frequency < 85)
    wanted = np.array(mixing) @ np.diag([1.0, 2.0]) @ np.array(mixing).T
    error = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)) * 1.94 / (n * band.sum()))
    assert np.all(np.abs(matrix[band].mean(axis=0) - wanted) < 5 * error)


def test_sensors_measure_one_motion_at_any_rate_and_clock() -> None:
    sensors = {
        "A": {},
        "B": {"sampling_rate": 333.0, "clock": {"offset": 0.123, "ppm": 40.0, "wander": 1.0}},
    }
    world = World(scenario(sensors))
    times = np.random.default_rng(0).uniform(-300.0, 700.0, 500)
    assert np.array_equal(world.motion("A").at(times), world.motion("B").at(times))
    at_b = world.sample_times("B", 1_000_000, 300)
    assert np.array_equal(world.samples("B", 1_000_000, 300), world.motion("A").at(at_b))


def test_any_block_can_be_read_in_any_pieces() -> None:
    noisy = {"A": {"noise": white(1.0), "clock": {"ppm": -20.0, "wander": 0.3}}}
    whole = World(scenario(noisy)).samples("A", 60_000, 20_000)
    other = World(scenario(noisy))
    pieces = [other.samples("A", first, 500) for first in range(60_000, 80_000, 500)]
    assert np.array_equal(np.concatenate(pieces), whole)
    assert np.array_equal(World(scenario(noisy)).samples("A", 71_234, 100), whole[11_234:11_334])


def test_another_process_makes_the_same_samples() -> None:
    model = scenario({"A": {"noise": {"shape": "pink", "level": 1.0}, "rotation": [5, 4, 3]}})
    code = (
        "import json, sys; from sim_devices.world.scenario import Scenario;"
        "from sim_devices.world.world import World;"
        "s = World(Scenario.from_dict(json.load(sys.stdin)));"
        "print(json.dumps(s.samples('A', 10**9, 50).tolist()))"
    )
    said = python(code, input=json.dumps(model.to_dict()))
    assert np.array_equal(json.loads(said.stdout), World(model).samples("A", 10**9, 50))


def test_interpolation_is_120_db_down_to_045_of_the_sampling_rate() -> None:
    """A band of noise on a grid ten times finer, thinned out, must be found again."""
    grid_rate = 4 * 100.0
    sources = WhiteSources((1, 2), 1)

    def band(frequency: FloatArray) -> ComplexArray:
        return np.asarray((frequency <= 95.0)[:, None, None], dtype=complex)

    coarse = GaussianSeries(sources, band, sampling_rate=grid_rate)
    block = sources.block
    grid = coarse.read(0, 2 * block)[0] * signal.windows.tukey(2 * block, 0.5, sym=False)
    fine = signal.resample(grid, 8 * 2 * block)  # exact for what is periodic
    motion = Motion(_Given(grid), sampling_rate=grid_rate)
    places = np.arange(8 * 1000, 8 * 100_000, 7)
    error = motion.at(places / (8 * grid_rate))[:, 0] - fine[places]
    assert 20 * np.log10(np.std(error) / np.std(fine[places])) < -120.0


class _Given(GaussianSeries):
    """A series that is already there."""

    def __init__(self, samples: FloatArray) -> None:
        self._given = samples

    @property
    def n_outputs(self) -> int:
        return 1

    def read(self, first: int, n: int) -> FloatArray:
        return self._given[None, first : first + n]


def test_delay_gain_and_rotation_are_applied() -> None:
    delay, angle = 0.0137, 25.0
    sensors = {"A": {}, "B": {"delay": delay, "gain": [2.0, 1.0, 0.5], "rotation": angle}}
    world = World(scenario(sensors))
    times = np.linspace(1000.0, 1010.0, 700)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    rows = np.array([[2 * c, 2 * s, 0], [-s, c, 0], [0, 0, 0.5]])
    felt, expected = world.motion("B").at(times), world.motion("A").at(times - delay) @ rows.T
    assert np.std(felt - expected) < 1e-6 * np.std(expected)


def test_a_response_filters_the_motion() -> None:
    corner = 2 * np.pi * 20.0
    low_pass = {"poles": [[-corner, 0.0]], "normalised_at": 0.001}
    model = scenario({"A": {}, "B": {"response": low_pass}})
    frequency, matrix, _ = csm(
        World(model).samples("A", 0, 100_000)[:, 0], World(model).samples("B", 0, 100_000)[:, 0]
    )
    band = (frequency > 0.5) & (frequency < 80)
    found = matrix[band, 1, 0] / matrix[band, 0, 0]
    assert np.max(np.abs(found - 1 / (1 + 1j * frequency[band] / 20.0))) < 0.01


def test_noise_is_independent_between_sensors_and_channels() -> None:
    own = {"noise": white(1.0), "gain": 0.0}
    model = scenario({"A": own, "B": own, "C": {**own, "seed": 5}, "D": {**own, "seed": 6}})
    channels = np.concatenate([World(model).samples(n, 0, 50_000).T for n in model.names])
    correlation = np.corrcoef(channels)
    off = correlation[~np.eye(len(correlation), dtype=bool)]
    assert np.max(np.abs(off)) < 5 / np.sqrt(50_000)


def test_the_samples_have_the_true_cross_spectral_matrix() -> None:
    sensors: dict[str, dict[str, Any]] = {
        "A": {"noise": white(0.5)},
        "B": {"rotation": [40, 20, 0], "delay": 0.004, "noise": white(2.0), "gain": 1.5},
    }
    model = scenario(sensors, spectra=[white(1.0), white(2.0), white(0.5)])
    channels = np.concatenate([World(model).samples(name, 0, 200_000) for name in "AB"], axis=1)
    frequency, matrix, n = csm(*channels.T)
    band = np.flatnonzero((frequency > 1) & (frequency < 88))[::2]
    true = World(model).true_csm(("A", "B"), frequency[band])
    power = np.sqrt(np.einsum("fp,fq->fpq", *[np.einsum("fpp->fp", true.real)] * 2))
    away = np.abs(matrix[band] - true) / power * np.sqrt(n)
    assert np.sqrt(np.mean(away**2)) == pytest.approx(1.0, abs=0.05)
    assert np.abs(((matrix[band] - true) / power).mean()) < 5 / np.sqrt(n * band.size)


def test_the_level_of_the_motion_changes_for_all_sensors_alike() -> None:
    level = {"deviation": 6.0, "period": 2.0}
    steady = World(scenario({"A": {}, "B": {}}))
    changing = World(scenario({"A": {}, "B": {}}, spectra=[white(1.0)] * 3, level=level))
    n = 60_000
    course = changing.samples("A", -100, n)[:, 0] / steady.samples("A", -100, n)[:, 0]
    assert np.array_equal(changing.samples("B", 30_000, 50), changing.samples("A", 30_000, 50))
    decibel = 20 * np.log10(np.abs(course))
    knots = decibel[100::400]  # a knot every two seconds, from time 0 on
    assert abs(knots.mean()) < 4 * 6 / np.sqrt(len(knots))
    assert abs(knots.std() / 6 - 1) < 4 / np.sqrt(2 * len(knots))
    between = decibel[300::400][: len(knots) - 1]
    assert np.allclose(between, (knots[:-1] + knots[1:])[: len(between)] / 2, atol=1e-6)
