"""The cross-spectral matrix against closed forms, scipy, and itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.spectra import welch
from estimator.spectra.welch import CrossSpectra, WelchSettings, Work, scale
from tests.traced_memory import peak_of

RATE = 50.0


def accumulated(samples: np.ndarray, settings: WelchSettings) -> CrossSpectra:
    result = CrossSpectra(settings, samples.shape[1])
    last = len(samples) - settings.segment_length
    result.add(samples, np.arange(0, last + 1, settings.hop))
    return result


def noise(n_samples: int, n_channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n_samples, n_channels))


@pytest.mark.parametrize("detrend", ["none", "constant", "linear"])
@pytest.mark.parametrize("window", ["hann", "rectangular", ("kaiser", 5.0)])
@pytest.mark.parametrize("length", [100, 81])
def test_the_matrix_is_the_transpose_of_scipy_csd(
    detrend: str, window: str | tuple[str, float], length: int
) -> None:
    samples = noise(5000, 3) + [3.0, -1.0, 0.1] + np.linspace(0, 5, 5000)[:, None]
    settings = WelchSettings(RATE, length, 0.5, window, detrend)  # type: ignore[arg-type]  # from the parameters
    csm = accumulated(samples, settings).csm()
    for p, q in ((0, 0), (0, 1), (2, 0)):
        frequencies, expected = signal.csd(  # type: ignore[call-overload]  # stubs lack "linear"
            samples[:, q],
            samples[:, p],
            RATE,
            "boxcar" if window == "rectangular" else window,
            length,
            length - settings.hop,
            detrend=False if detrend == "none" else detrend,
        )
        np.testing.assert_allclose(csm[:, p, q], expected, atol=1e-12 * abs(expected).max())
    np.testing.assert_allclose(settings.frequencies, frequencies)


@pytest.mark.parametrize("window", ["hann", "rectangular"])
def test_the_order_of_samples_in_memory_does_not_matter(window: str) -> None:
    samples, settings = noise(5000, 3), WelchSettings(RATE, 100, window=window)
    by_sample, by_channel = np.ascontiguousarray(samples), np.asfortranarray(samples)
    expected = accumulated(by_sample, settings).csm()
    found = CrossSpectra(settings, 3)
    starts = np.arange(0, 4901, settings.hop)
    for first in (0, 40, 60):  # as many segments, then fewer, then more than before
        last = {0: 40, 40: 60, 60: 99}[first]
        found.add(by_sample if first == 40 else by_channel, starts[first:last])
    size = np.abs(expected).max()
    np.testing.assert_allclose(found.csm(), expected, rtol=0, atol=1e-13 * size)


def test_a_delay_has_the_sign_of_the_convention() -> None:
    # csm[f, 0, 1] = E[X_0 conj(X_1)]; channel 1 comes m samples later: phase +2 pi f m / fs.
    m, length = 3, 256
    motion = noise(40_000, 1)[:, 0]
    samples = np.column_stack([motion[m:], motion[:-m]])
    settings = WelchSettings(RATE, length)
    csm = accumulated(samples, settings).csm()
    expected = np.exp(2j * np.pi * settings.frequencies * m / RATE)
    ratio = csm[1:-1, 0, 1] / np.abs(csm[1:-1, 0, 1])
    # the segments share all but m of their samples, so that the phase scatters little
    np.testing.assert_allclose(ratio, expected[1:-1], atol=0.05)


def test_white_noise_has_its_variance_as_area_and_a_sine_its_power() -> None:
    samples = noise(200_000, 2)
    settings = WelchSettings(RATE, 500)
    csm = accumulated(samples, settings).csm()
    power = csm[:, 0, 0].real.sum() * RATE / 500
    assert power == pytest.approx(samples[:, 0].var(), rel=0.01)
    t = np.arange(10_000) / RATE
    sine = 3 * np.sin(2 * np.pi * 5 * t)[:, None]
    csm = accumulated(sine, settings).csm()
    assert csm[:, 0, 0].real.sum() * RATE / 500 == pytest.approx(4.5, rel=1e-9)


def test_the_matrix_is_hermitian_and_positive() -> None:
    csm = accumulated(noise(4000, 5), WelchSettings(RATE, 128)).csm()
    np.testing.assert_array_equal(csm, csm.conj().swapaxes(1, 2))
    assert np.linalg.eigvalsh(csm).min() > -1e-15


def test_the_result_does_not_depend_on_the_division_of_samples() -> None:
    samples = noise(20_000, 4)
    settings = WelchSettings(RATE, 100)
    whole = accumulated(samples, settings)
    pieces = CrossSpectra(settings, 4)
    rng = np.random.default_rng(1)
    starts = np.arange(0, len(samples) - 99, settings.hop)
    cuts = np.sort(rng.integers(0, len(starts), 12))
    for some in np.split(starts, np.append(cuts, np.arange(len(starts) - 5, len(starts)))):
        if len(some):
            pieces.add(samples[some[0] : some[-1] + 100], some - some[0])
    assert pieces.n_segments == whole.n_segments
    assert pieces.n_effective == whole.n_effective
    np.testing.assert_allclose(pieces.csm(), whole.csm(), rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("window", ["hann", "rectangular"])
def test_segments_may_be_transformed_before_they_are_added(window: str) -> None:
    samples, settings = np.asfortranarray(noise(5000, 3)), WelchSettings(RATE, 100, window=window)
    found, starts, work = CrossSpectra(settings, 3), np.arange(0, 4901, settings.hop), Work()
    for some in (starts[:0], starts[:70], starts[70:71], starts[71:]):
        spectra = found.transforms(samples, some, work)
        found.add_spectra(spectra, found.products(spectra))
    np.testing.assert_allclose(found.csm(), accumulated(samples, settings).csm(), rtol=1e-12)


@pytest.mark.parametrize("window", ["hann", "rectangular"])
def test_segments_may_be_anywhere_in_any_order(window: str) -> None:
    samples = noise(5000, 3)
    settings = WelchSettings(RATE, 100, window=window)
    even, anywhere = CrossSpectra(settings, 3), CrossSpectra(settings, 3)
    starts = np.arange(7, 4900, 70)
    even.add(samples, starts)
    anywhere.add(samples, np.random.default_rng(2).permutation(starts))
    np.testing.assert_allclose(anywhere.csm(), even.csm(), rtol=1e-11, atol=1e-15)


def test_accumulators_add() -> None:
    samples = noise(6000, 3)
    settings = WelchSettings(RATE, 100, window=("kaiser", 5.0))
    whole = CrossSpectra(settings, 3)
    parts = [CrossSpectra(settings, 3) for _ in range(2)]
    starts = np.arange(0, 5900, 50)
    whole.add(samples, starts)
    parts[0].add(samples, starts[:40])
    parts[1].add(samples, starts[40:])
    total = parts[0] + parts[1]
    assert total.n_segments == whole.n_segments
    np.testing.assert_allclose(total.csm(), whole.csm(), rtol=1e-11, atol=1e-15)
    parts[0].merge(parts[1])
    np.testing.assert_array_equal(parts[0].csm(), total.csm())


def test_accumulators_of_other_settings_are_refused() -> None:
    settings = WelchSettings(RATE, 100)
    good = CrossSpectra(settings, 3)
    with pytest.raises(EstimatorError, match="cannot be added"):
        good.merge(CrossSpectra(settings, 4))
    with pytest.raises(EstimatorError, match="cannot be added"):
        good.merge(CrossSpectra(WelchSettings(RATE, 102), 3))
    with pytest.raises(InsufficientDataError, match="no segment"):
        good.csm()


@pytest.mark.parametrize(
    ("samples", "starts"),
    [
        (np.zeros((300, 2)), np.array([0])),
        (np.zeros((300, 3)), np.array([-1])),
        (np.zeros((300, 3)), np.array([0, 201])),
        (np.zeros(300), np.array([0])),
    ],
)
def test_segments_outside_the_samples_are_refused(samples: np.ndarray, starts: np.ndarray) -> None:
    good = CrossSpectra(WelchSettings(RATE, 100), 3)
    with pytest.raises(EstimatorError, match="expected"):
        good.add(samples, starts)
    assert good.n_segments == 0


@pytest.mark.parametrize(
    "settings",
    [
        {"sampling_rate": 0.0},
        {"sampling_rate": np.nan},
        {"segment_length": 1},
        {"segment_length": 100.5},
        {"overlap": 1.0},
        {"overlap": -0.1},
        {"window": "hat"},
        {"detrend": "quadratic"},
    ],
)
def test_invalid_settings_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(EstimatorError):
        WelchSettings(**{"sampling_rate": RATE, "segment_length": 100, **settings})  # type: ignore[arg-type]  # from the parameters


def test_memory_does_not_grow_with_the_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(welch, "BLOCK_VALUES", 2**14)

    def peak(n_samples: int) -> int:
        samples = noise(n_samples, 3)
        starts = np.arange(0, n_samples - 199, 100)
        total = CrossSpectra(WelchSettings(RATE, 200), 3)
        return peak_of(lambda: total.add(samples, starts)) - 16 * len(starts)

    peak(10_000)  # imports and first allocations
    assert peak(800_000) < 1.5 * peak(40_000)


def test_scale_divides_by_both_responses_and_marks_zeros() -> None:
    csm = accumulated(noise(4000, 2), WelchSettings(RATE, 64)).csm()
    rng = np.random.default_rng(2)
    gain = rng.standard_normal((33, 2)) + 1j * rng.standard_normal((33, 2))
    digitised = csm * gain[:, :, None] * gain.conj()[:, None, :]
    np.testing.assert_allclose(scale(digitised, gain), csm, rtol=1e-12)
    gain[0, 1] = 0
    scaled = scale(digitised, gain)
    assert np.isnan(scaled[0, :, 1]).all()
    assert np.isfinite(scaled[0, 0, 0])
    assert np.isfinite(scaled[1:]).all()
    with pytest.raises(EstimatorError, match="shape"):
        scale(csm, gain[1:])


def test_products_of_many_channels_are_added_some_segments_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples, settings = noise(3000, 3), WelchSettings(RATE, 100)
    expected = accumulated(samples, settings)
    monkeypatch.setattr(welch, "KEPT_VALUES", 0)  # as if there were very many channels
    starts = np.arange(0, 2901, settings.hop)
    total, other = (CrossSpectra(settings, 3) for _ in range(2))
    for some in np.array_split(starts[:50], 9):
        total.add(samples, some)
    other.add(samples, starts[50:])
    np.testing.assert_allclose(
        total.csm() * 50, accumulated(samples[:2550], settings).csm() * 50, rtol=1e-12
    )
    total.merge(other)
    assert total.n_segments == expected.n_segments
    np.testing.assert_allclose(total.csm(), expected.csm(), rtol=1e-12)
