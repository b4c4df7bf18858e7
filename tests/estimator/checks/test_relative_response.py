"""Rotation, gain and delay between sensors, from models and from the real recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_sensors import Rotated
from estimator.checks.diagnose import diagnose
from estimator.checks.relative_response import RelativeResponse, relative_response
from estimator.checks.rules import orientation
from estimator.checks.shared_motion import CanonicalCoherence, matched_coherence
from estimator.errors import EstimatorError, InsufficientDataError
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import wishart

FREQUENCY = np.linspace(0.5, 20, 200)
MOTION = np.array([[2.0, 0.5, 0], [0.5, 1.0, 0.2], [0, 0.2, 0.8]])


def bench(
    sensors: list[FloatArray], *, delays: tuple[float, ...] = (0, 0, 0), snr: float = 1e4
) -> ComplexArray:
    """Sensors given by their channels' gains and directions, noise 1."""
    channels = np.concatenate(sensors)
    lag = np.repeat(np.array(delays), [len(sensor) for sensor in sensors])
    d = channels.shape[1]
    common = channels @ MOTION[:d, :d] @ channels.T * snr
    phase = np.exp(-2j * np.pi * FREQUENCY[:, None] * lag)
    csm = phase[:, :, None] * common * phase[:, None, :].conj() + np.eye(len(channels))
    return np.asarray(csm, np.complex128)


def between(
    csm: ComplexArray,
    frequency: FloatArray = FREQUENCY,
    first: int = 0,
    second: int = 1,
    **options: Any,  # noqa: ANN401 - those of relative_response
) -> RelativeResponse:
    """Return the response of one triaxial sensor to another."""
    dims = options.pop("dims", (3,) * (csm.shape[1] // 3))
    return relative_response(csm, frequency, dims=dims, first=first, second=second, **options)


def test_rotation_gains_and_delay_are_recovered() -> None:
    turned = Rotation.from_rotvec(np.deg2rad(4.1) * np.array([0.6, 0, 0.8])).as_matrix().T
    gains = np.array([1.02, 0.97, 1.0])
    csm = bench([np.eye(3), gains[:, None] * turned, np.eye(3)], delays=(0, 3e-3, -1e-3))
    found = between(csm)
    assert found.rotation_deg == pytest.approx(4.1, abs=1e-3)
    np.testing.assert_allclose(found.rotation, turned, atol=1e-6)
    np.testing.assert_allclose(found.gains, gains, rtol=1e-6)
    assert found.delay == pytest.approx(3e-3, rel=1e-6)
    assert found.nonorthogonality_deg < 1e-4
    assert found.reversed_channels == ()
    assert np.isnan(found.horizontal_deg)
    back = between(csm, first=1, second=0)
    assert back.delay == pytest.approx(-3e-3, rel=1e-6)
    np.testing.assert_allclose(back.matrix @ found.matrix, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("n_others", [1, 2])
def test_others_that_lag_do_not_cancel_in_sums_over_the_band(n_others: int) -> None:
    gains, late = np.array([1.02, 0.97, 1.0]), (0.0, 2e-3, *(0.4, -0.7)[:n_others])
    true = bench([np.eye(3), np.diag(gains), *[np.eye(3)] * n_others], delays=late)
    csm = wishart(true, 60, np.random.default_rng(5))[0]
    found = between(csm)
    assert found.rotation_deg < 0.1
    np.testing.assert_allclose(found.gains, gains, atol=1e-3)
    assert found.delay == pytest.approx(2e-3, abs=1e-5)


def test_a_known_delay_has_the_sign_the_convention_says() -> None:
    """The second sensor's record is the first's, one and a half samples later."""
    rng = np.random.default_rng(1)
    settings = WelchSettings(sampling_rate=100.0, segment_length=400)
    motion = np.fft.rfft(rng.standard_normal(40_000))
    f = np.fft.rfftfreq(40_000, 0.01)
    late = np.fft.irfft(motion * np.exp(-2j * np.pi * f * 0.015))
    now = np.fft.irfft(motion)
    samples = np.column_stack([now, late, now]) + 0.01 * rng.standard_normal((40_000, 3))
    spectra = CrossSpectra(settings, 3)
    spectra.add(samples, np.arange(0, 40_000 - 400, settings.hop, dtype=np.int64))
    found = between(spectra.csm(), settings.frequencies, dims=(1, 1, 1), band=(1, 40))
    assert found.delay == pytest.approx(0.015, rel=0.01)


@pytest.mark.parametrize("delay", [0.02, -0.13, 0.5, -1.7, 4.0])
@pytest.mark.parametrize("low", [0.5, 8.0])
def test_a_delay_of_many_periods_is_not_mistaken_for_a_short_one(delay: float, low: float) -> None:
    """At 40 samples/s these are 0.8 to 160 samples; the band's top turns 0.4 to 80 times."""
    turned = Rotation.from_rotvec([0.1, 0.3, -0.2]).as_matrix()
    csm = bench([np.eye(3), turned, np.eye(3)], delays=(0, delay, 0), snr=100)
    draw = wishart(csm, 300, np.random.default_rng(4))[0]
    found = between(draw, band=(low, 20.0))
    assert found.delay == pytest.approx(delay, abs=1e-4)
    np.testing.assert_allclose(found.matrix, turned, atol=0.02)


def test_a_delay_is_found_at_frequencies_that_are_not_evenly_spaced() -> None:
    """As where octaves have segments of their own, or frequencies are flagged."""
    csm = bench([np.eye(3)] * 3, delays=(0, 0.31, 0))
    some = np.sort(np.random.default_rng(0).choice(200, 60, replace=False))
    found = between(csm[some], FREQUENCY[some])
    assert found.delay == pytest.approx(0.31, rel=1e-6)


def test_frequencies_are_weighted_by_signal_to_noise_ratio() -> None:
    """Half the band at SNR 1e4, half at 8, as strong: as good as the good half alone."""
    good = np.arange(200) % 2 == 0
    level = np.where(good, 1.0, 1e6)[:, None, None]  # the weak half has the larger spectra
    clean = bench([np.eye(3)] * 3, snr=1e4)
    poor = bench([np.eye(3)] * 3, snr=8.0)
    csm = np.where(good[:, None, None], clean, poor) * level
    alone: list[list[float]] = []
    whole: list[list[float]] = []
    for draw in wishart(csm, 100, np.random.default_rng(6), n_draws=25):
        for found, some in ((alone, good), (whole, np.ones(200, bool))):
            response = between(draw[some], FREQUENCY[some])
            found.append([*response.gains - 1, response.delay * 100])
    spread = np.std(whole, axis=0) / np.std(alone, axis=0)
    assert spread.max() < 1.5  # all alike would make it 15 times as large


def test_horizontal_angle_follows_the_first_horizontal_channel() -> None:
    """North turned 10 degrees towards west, east 12: two degrees short of a right angle."""
    north, east = np.deg2rad([10.0, 12.0])
    second = np.array(
        [[1, 0, 0], [0, np.cos(north), -np.sin(north)], [0, np.sin(east), np.cos(east)]]
    )
    csm = bench([np.eye(3), second, np.eye(3)])
    found = between(csm, vertical=0)
    assert found.horizontal_deg == pytest.approx(10, abs=1e-3)
    assert found.rotation_deg == pytest.approx(11, abs=1e-2)
    assert found.nonorthogonality_deg == pytest.approx(2, abs=1e-3)


def test_reversed_polarity_is_named() -> None:
    second = np.diag([1.0, -1.0, 1.0]) @ Rotation.from_euler("z", 5, degrees=True).as_matrix()
    csm = bench([np.eye(3), second, np.eye(3)], delays=(0, 2e-3, 0))
    found = between(csm)
    assert found.reversed_channels == (1,)
    assert found.rotation_deg == pytest.approx(5, abs=1e-3)
    assert found.delay == pytest.approx(2e-3, rel=1e-3)


@pytest.mark.parametrize("peak", [1.0, pytest.param(100.0, marks=pytest.mark.long)])
def test_noise_causes_no_bias_and_the_error_covers(peak: float) -> None:
    """SNR 10: a plain regression would shorten the gains by a tenth.

    A peak, as of microseism, has most of the weight: no eight parts of equal weight are left.
    """
    turned = Rotation.from_euler("z", 3, degrees=True).as_matrix()
    csm = bench([np.eye(3), turned, np.eye(3)], snr=10)
    csm[5:7] += (peak - 1) * (csm[5:7] - np.eye(9))
    miss, errors = [], []
    for draw in wishart(csm, 200, np.random.default_rng(2), n_draws=60):
        found = between(draw, vertical=2)
        miss.append(found.horizontal_deg - 3)
        errors.append(found.angle_error_deg)
        np.testing.assert_allclose(found.gains, 1, atol=0.02)
    assert abs(np.mean(miss)) < 4 * np.std(miss) / np.sqrt(len(miss))
    assert np.std(miss) < 1.3 * np.sqrt(np.mean(np.square(errors)))
    assert np.sqrt(np.mean(np.square(errors))) < 3 * np.std(miss)


def test_intervals_hold_the_truth_where_few_frequencies_weigh_most() -> None:
    """The scatter of eight parts of the band is Student's: 90 % held it without."""
    still = bench([np.eye(3)] * 3, snr=0.0)
    red = 30 * (FREQUENCY / 5) ** -2.0
    csm = still + red[:, None, None] * (bench([np.eye(3)] * 3, snr=1.0) - still)
    held, angles = [], []
    for draw in wishart(csm, 40, np.random.default_rng(0), n_draws=200):
        found = between(draw, vertical=2)
        held.append(abs(found.delay) < 1.96 * found.delay_error)
        held += (np.abs(found.gains - 1) < 1.96 * found.gain_errors).tolist()
        angles.append(abs(found.horizontal_deg) < 1.96 * found.angle_error_deg)
    assert 0.925 < np.mean(held) < 0.98
    assert 0.925 < np.mean(angles) < 0.98


def test_unequal_gains_of_the_first_sensor_are_in_the_error_of_the_rotation() -> None:
    for seed in range(5):
        turned = Rotation.random(random_state=seed)
        found = between(bench([np.diag([1.1, 0.95, 1.0]), turned.as_matrix().T, np.eye(3)]))
        off = abs(found.rotation_deg - np.rad2deg(turned.magnitude()))
        assert found.reversed_channels or off < 2 * found.rotation_uncertainty_deg < 20


@pytest.mark.parametrize(("dims", "snr", "every"), [((1, 1, 1), 5.0, 8), ((3, 3, 3), 7.0, 1)])
def test_equal_sensors_in_weak_motion_are_not_said_to_differ(
    dims: tuple[int, ...], snr: float, every: int
) -> None:
    """Their differences exceed what is tolerated in 5 and 12 of 25 draws, but are not certain."""
    csm, frequency = bench([np.eye(dims[0])] * 3, snr=snr)[::every], FREQUENCY[::every]
    kinds = [
        found.name
        for draw in wishart(csm, 20, np.random.default_rng(5), n_draws=25)
        for found in orientation(between(draw, frequency, dims=dims), dims, 20.0)
    ]
    assert len(kinds) <= 1


@pytest.mark.parametrize(
    "snr", [(0.85, 9.0, 9.0), (1.3, 9.0, 9.0), (9.0, 9.0, 0.85), (9.0, 9.0, 1.3)]
)
def test_frequencies_are_not_chosen_by_their_own_noise(snr: tuple[float, ...]) -> None:
    """The coherence with a noisy sensor is 0.4 or 0.5: noise alone decides where it is higher."""
    frequency = np.linspace(0.1, 45, 450)
    csm = np.ones((450, 3, 3), np.complex128) + np.diag(1 / np.array(snr))
    gains = []
    for draw in wishart(csm, 84, np.random.default_rng(1), n_draws=30):
        with suppress(InsufficientDataError):
            found = between(draw, frequency, dims=(1, 1, 1))
            gains.append(found.gains[0])
    assert len(gains) == (0 if 0.85 in snr else 30)
    assert all(abs(gain - 1) < 0.02 for gain in gains)
    assert abs(np.mean([1.0, *gains]) - 1) < 0.01


def test_more_sensors_and_one_channel() -> None:
    gains = [1.0, 1.1, 0.9, 1.2]
    csm = bench([np.array([[gain]]) for gain in gains], delays=(0, 1e-3, 0, 0))
    found = between(csm, dims=(1,) * 4)
    assert found.gains[0] == pytest.approx(1.1, rel=1e-6)
    assert found.delay == pytest.approx(1e-3, rel=1e-6)
    assert found.rotation_deg == 0
    assert found.nonorthogonality_deg == 0


def test_coherence_of_like_channels() -> None:
    csm = bench([np.eye(2)] * 3, snr=1.0)
    p, q = 2.0, 1.0
    expected = [(p / (p + 1)) ** 2, (q / (q + 1)) ** 2]
    np.testing.assert_allclose(matched_coherence(csm, (2, 2, 2), 0, 2)[0], expected)


def test_canonical_coherence_does_not_depend_on_orientation() -> None:
    turned = Rotation.from_rotvec([1.0, 2.0, -1.5]).as_matrix()
    plain, other = bench([np.eye(3)] * 3, snr=10), bench([np.eye(3), turned, turned.T], snr=10)
    one, two = (CanonicalCoherence(csm).between(range(3), range(3, 6)) for csm in (plain, other))
    np.testing.assert_allclose(one, two, rtol=1e-9)
    snr = 10 * np.linalg.eigvalsh(MOTION)[::-1]
    np.testing.assert_allclose(one[0], (snr / (snr + 1)) ** 2, rtol=1e-9)
    assert matched_coherence(other, (3, 3, 3), 0, 1).min() < 0.3


def test_any_rotation_is_found() -> None:
    turned = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()
    csm = bench([np.eye(3), turned, turned.T])
    found = between(csm)
    assert found.rotation_deg == pytest.approx(np.rad2deg(np.linalg.norm([1, 2, 0.5])), abs=1e-3)
    np.testing.assert_allclose(found.rotation, turned, atol=1e-6)


def test_sensors_that_are_not_comparable_are_refused() -> None:
    csm = bench([np.eye(3), np.eye(3)[:2], np.eye(3)])
    with pytest.raises(InsufficientDataError, match="3 and 2 channels"):
        between(csm, dims=(3, 2, 3))
    with pytest.raises(InsufficientDataError, match="others have 2"):
        between(csm, second=2, dims=(3, 2, 3))
    quiet = np.broadcast_to(np.eye(9, dtype=np.complex128), (200, 9, 9))
    for first, second in ((0, 0), (0, 5), (-1, 0)):
        with pytest.raises(EstimatorError, match="two different ones of 0 to 2"):
            between(quiet, first=first, second=second)
    with pytest.raises(InsufficientDataError, match="coherent"):
        between(quiet)


@pytest.fixture(scope="module")
def tst(usgs_recording: Path) -> tuple[ComplexArray, FloatArray, float]:
    """Average the real recording: Hann, segments of 16384 samples at 50 % overlap.

    Of three neighbouring frequencies, which share their noise, one is used.
    """
    obspy = pytest.importorskip("obspy", reason="the real recording is miniSEED: needs obspy")
    samples = np.column_stack(
        [
            obspy.read(str(usgs_recording / f"TST{sensor}_BH{channel}.mseed"))[0].data
            for sensor in ("5_00", "5_10", "6_00")
            for channel in range(3)
        ]
    ).astype(np.float64)
    settings = WelchSettings(sampling_rate=40.0, segment_length=16384)
    starts = np.arange(0, len(samples) - 16384 + 1, settings.hop, dtype=np.int64)
    spectra = CrossSpectra(settings, 9)
    spectra.add(samples, starts)
    return spectra.csm()[::3], settings.frequencies[::3], spectra.n_effective


@pytest.mark.parametrize(
    ("first", "second", "angle"), [(0, 1, 2.242), (1, 2, 1.158), (0, 2, 3.400)]
)
@pytest.mark.parametrize("band", [None, (0.1, 1.0)], ids=["all", "microseism"])
def test_horizontal_angles_of_the_real_recording(
    tst: tuple[ComplexArray, FloatArray, float],
    first: int,
    second: int,
    angle: float,
    band: tuple[float, float] | None,
) -> None:
    """Published angles are those of BH1; BH2 turns by 0.2 to 0.3 degrees more or less."""
    csm, frequencies, _ = tst
    found = between(csm, frequencies, first, second, vertical=0, band=band)
    assert found.horizontal_deg == pytest.approx(angle, abs=0.05)
    assert found.angle_error_deg < 0.05
    np.testing.assert_allclose(found.gains, 1, atol=0.01)
    assert abs(found.delay) < 1e-3


def test_the_report_says_where_one_motion_does_not_explain_the_real_recording(
    tst: tuple[ComplexArray, FloatArray, float],
) -> None:
    csm, frequencies, n_effective = tst
    found = diagnose(
        csm,
        frequencies,
        dims=(3, 3, 3),
        n_effective=n_effective,
        neighbours=np.zeros(0),  # Hann: bins three apart are independent
        vertical=0,
    )
    failing = [band for band in found.bands if band.test.p_value < 0.01]
    passing = [band for band in found.bands if band.test.p_value >= 0.01]
    assert any(band.low < 0.2 < band.high for band in failing)
    assert any(band.low > 8 for band in passing)
    warned = [advice for advice in found.advice if isinstance(advice, ModelMisfit)]
    assert warned
    assert warned[0].band is not None
    assert warned[0].band[0] < 0.2 < warned[0].band[1]
    (rotated,) = [a for a in found.advice if isinstance(a, Rotated) and a.sensors == (0, 1)]
    assert rotated.horizontal_deg == pytest.approx(2.242, abs=0.05)


def test_frequencies_that_are_not_known_have_no_part_in_a_response() -> None:
    rng = np.random.default_rng(3)
    dims = (3, 3, 2, 3)
    sensors = [Rotation.random(random_state=k).as_matrix()[:d] * 3.0**k for k, d in enumerate(dims)]
    csm = wishart(bench(sensors, delays=(0, 1e-3, 0, -2e-3)), 200, rng)[0]
    csm[50] = np.nan  # in the middle of the band
    csm[-10:] = np.nan
    known = np.isfinite(csm).all(axis=(1, 2))
    for first, second in ((0, 1), (0, 3), (1, 3)):
        found, without = (
            between(csm[some], FREQUENCY[some], first, second, dims=dims)
            for some in (slice(None), known)
        )
        np.testing.assert_allclose(found.matrix, without.matrix, rtol=1e-9)
        np.testing.assert_allclose(found.gain_errors, without.gain_errors, rtol=1e-6)
        assert found.delay == pytest.approx(without.delay, rel=1e-9)
