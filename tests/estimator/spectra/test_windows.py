"""Windows, and the worth of overlapping segments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from estimator.errors import EstimatorError
from estimator.spectra.windows import effective_averages, get_window


@pytest.mark.parametrize("name", ["hann", "boxcar", "blackmanharris"])
@pytest.mark.parametrize("length", [2, 7, 2000])
def test_windows_agree_with_scipy(name: str, length: int) -> None:
    np.testing.assert_allclose(
        get_window(name, length), signal.get_window(name, length), atol=1e-15
    )


def test_rectangular_is_boxcar_and_samples_pass_through() -> None:
    np.testing.assert_array_equal(get_window("rectangular", 5), np.ones(5))
    np.testing.assert_array_equal(get_window(np.arange(1.0, 4.0), 3), [1, 2, 3])
    np.testing.assert_array_equal(
        get_window(("kaiser", 8.0), 9), signal.get_window(("kaiser", 8.0), 9)
    )
    np.testing.assert_array_equal(get_window("kaiser,8", 9), get_window(("kaiser", 8.0), 9))


@pytest.mark.parametrize(
    "window",
    ["hat", "kaiser", "kaiser,x", "hann,1", np.ones(3), np.zeros(4), np.array([1, np.nan, 1, 1])],
)
def test_an_invalid_window_is_refused(window: str | np.ndarray) -> None:
    with pytest.raises(EstimatorError, match="window"):
        get_window(window, 4)


@pytest.mark.parametrize(
    ("overlap", "worth"),
    [(0.0, 1.0), (0.5, 1 / (1 + 2 / 36)), (0.75, 1 / (1 + 2 * (0.6592**2 + 1 / 36 + 0.0075**2)))],
)
def test_effective_averages_of_hann_segments_agree_with_the_literature(
    overlap: float, worth: float
) -> None:
    # Overlap correlations of the Hann window: Harris (1978), table 1: 65.9 % at 75 %,
    # 16.7 % at 50 %, and 0.75 % at 25 %.
    length, n = 4096, 10**6
    hop = round(length * (1 - overlap))
    assert effective_averages(get_window("hann", length), hop, n) / n == pytest.approx(
        worth, rel=2e-4
    )


def test_effective_averages_do_not_exceed_the_number_of_segments() -> None:
    window = get_window("hann", 100)
    assert effective_averages(window, 25, 0) == 0
    assert effective_averages(window, 25, 1) == 1
    assert effective_averages(np.ones(100), 100, 1080) == 1080
    # two overlapping by half: correlated once, by (1/6)**2
    assert effective_averages(window, 50, 2) == pytest.approx(2 / (1 + 1 / 36))
    worth = [effective_averages(window, 25, n) for n in range(1, 9)]
    assert np.all(np.diff(worth) > 0)
    assert np.all(np.array(worth) <= np.arange(1, 9))


@pytest.mark.parametrize("overlap", [0.5, 0.75])
def test_the_scatter_of_a_spectrum_is_that_of_n_effective_averages(overlap: float) -> None:
    # White noise: var(PSD) / PSD**2 = 1 / n_eff at every inner frequency.
    length, n_segments = 64, 20
    hop = round(length * (1 - overlap))
    window = get_window("hann", length)
    rng = np.random.default_rng(11)
    x = rng.standard_normal((4000, length + hop * (n_segments - 1)))
    frames = np.lib.stride_tricks.sliding_window_view(x, length, axis=1)[:, ::hop]
    psd = (np.abs(np.fft.rfft(frames * window)) ** 2).mean(axis=1)[:, 3:-3]
    scatter = psd.var(axis=0) / psd.mean(axis=0) ** 2
    # 4000 draws at 27 frequencies, every second of them independent: 1 % standard error
    assert scatter.mean() * effective_averages(window, hop, n_segments) == pytest.approx(
        1, abs=0.04
    )
