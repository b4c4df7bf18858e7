"""Filters that equalise channels with different responses, before windowing.

Theory of operation
-------------------
Each channel has a symmetric span of taps around zero delay: ``y[n] = sum_k taps[M + k] x[n - k]``.
The taps are the inverse transform of the target response, truncated where only noise or negligible
values remain. `Equaliser.response` is the actual response of the taps, not the target: spectra are
divided by it, so that the truncation causes no bias.
"""

from __future__ import annotations

import numpy as np

from estimator.errors import EstimatorError
from estimator.median import median
from estimator.records import dataclass
from estimator.types import ComplexArray, FloatArray

MAX_AMPLIFICATION = 100.0
"""Maximum amplification over the median amplification: limits the amplification of noise."""
USABLE = 0.9
"""Fraction of half the sampling rate above which phases are not equalised."""
_FLAT = 0.8  # fraction of the half length from which taps fade
_BLOCKS = 24  # number of blocks on either side, for the search of the last relevant one
_ABOVE_NOISE = 3.0
_ROUNDING = 1e-14  # fraction of the largest tap's energy below which taps are negligible
_FAR = 0.3  # share of the taps, at both ends, that have faded
_FFT_LENGTHS = 4  # minimum length of transforms, over the number of taps
_ON_GRID = 1e-6
_FREQUENCIES_AT_ONCE = 256


@dataclass(frozen=True, slots=True, eq=False)
class Equaliser:
    """Filters of all channels.

    Attributes
    ----------
    sampling_rate : float
        Hz.
    taps : float64, shape (n_channels, 2 * reach + 1)
        From the earliest output to the latest; a single 1 in the middle for unfiltered channels.
    """

    sampling_rate: float
    taps: FloatArray

    @property
    def reach(self) -> int:
        """Number of samples needed before and after each output."""
        return int(self.taps.shape[1]) // 2

    @property
    def filtered(self) -> tuple[int, ...]:
        """The filtered channels."""
        plain = np.zeros(self.taps.shape[1])
        plain[self.reach] = 1.0
        return tuple(np.flatnonzero((self.taps != plain).any(axis=1)).tolist())

    def apply(self, samples: FloatArray) -> FloatArray:
        """Return the filtered samples, without `reach` samples at either end.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
            All finite.

        Returns
        -------
        float64, shape (n_samples - 2 * reach, n_channels)
        """
        reach, n_taps = self.reach, self.taps.shape[1]
        if samples.ndim != 2 or samples.shape[1] != len(self.taps) or len(samples) < n_taps:
            raise EstimatorError(
                f"samples of shape {samples.shape}, expected {n_taps} or more of"
                f" {len(self.taps)} channels"
            )
        n_out = len(samples) - 2 * reach
        out = samples[reach : reach + n_out].copy()
        columns = list(self.filtered)
        if not columns:
            return out
        length = 1 << int(np.ceil(np.log2(_FFT_LENGTHS * n_taps)))
        length = min(length, 1 << int(np.ceil(np.log2(len(samples)))))
        length = max(length, 1 << int(np.ceil(np.log2(2 * n_taps))))
        step = length - n_taps + 1
        responses = np.fft.rfft(self.taps[columns], length, axis=1)
        inputs = np.ascontiguousarray(samples[:, columns].T)
        for first in range(0, n_out, step):
            piece = np.fft.rfft(inputs[:, first : first + length], length, axis=1)
            piece *= responses
            count = min(step, n_out - first)
            rows = np.fft.irfft(piece, length, axis=1)[:, n_taps - 1 : n_taps - 1 + count]
            out[first : first + count, columns] = rows.T
        return out

    def response(self, frequency: FloatArray) -> ComplexArray:
        """Return the actual response of the filters, shape (n_freqs, n_channels)."""
        response = np.ones((len(frequency), len(self.taps)), dtype=np.complex128)
        columns = list(self.filtered)
        if not columns or not len(frequency):
            return response
        step = float(np.diff(frequency).min()) if len(frequency) > 1 else 0.0
        n = round(self.sampling_rate / step) if step > 0 else 0
        place = frequency * n / self.sampling_rate
        lags = np.arange(-self.reach, self.reach + 1)
        if n and np.abs(place - np.rint(place)).max() < _ON_GRID:  # delays are periodic in n
            folded = np.zeros((n, len(columns)))
            np.add.at(folded, lags % n, self.taps[columns].T)
            at = np.rint(place).astype(np.int64)
            response[:, columns] = np.fft.fft(folded, axis=0)[at % n]
            return response
        for first in range(0, len(frequency), _FREQUENCIES_AT_ONCE):
            some = slice(first, first + _FREQUENCIES_AT_ONCE)
            turn = np.exp(-2j * np.pi * np.outer(frequency[some] / self.sampling_rate, lags))
            response[some, columns] = turn @ self.taps[columns].T
        return response

    def then(self, other: Equaliser) -> Equaliser:
        """Return the cascade of both filters."""
        reach = self.reach + other.reach
        taps = np.zeros((len(self.taps), 2 * reach + 1))
        for channel, (own, added) in enumerate(zip(self.taps, other.taps, strict=True)):
            taps[channel] = np.convolve(own, added)
        return Equaliser(self.sampling_rate, taps)


def design(wanted: ComplexArray, sampling_rate: float, *, longest: int) -> Equaliser:
    """Return filters for target responses.

    Parameters
    ----------
    wanted : complex128, shape (n_freqs, n_channels)
        Evenly spaced from 0 Hz to half the sampling rate; exactly 1 at all frequencies for
        unfiltered channels.
    sampling_rate : float
        Hz.
    longest : int
        Maximum reach of the filters to either side, in samples.
    """
    n = 2 * (len(wanted) - 1)
    longest = min(longest, n // 2 - 1)
    plain = (wanted == 1).all(axis=0)
    full = np.fft.irfft(wanted, n, axis=0)
    taps = np.concatenate([full[-longest:], full[: longest + 1]]).T
    reach = min(max((_needed(each) for each in taps[~plain]), default=0), longest)
    taps = taps[:, longest - reach : longest + reach + 1] * _fade(reach)
    taps[plain] = 0.0
    taps[plain, reach] = 1.0
    return Equaliser(sampling_rate, taps)


def with_short_tails(wanted: ComplexArray) -> ComplexArray:
    """Return responses of shorter filters, changed at 0 Hz and near half the sampling rate.

    Averages have little information at 0 Hz: an error of that value is a constant in all taps, and
    appears where the others have faded. Near half the rate, phases are brought to 0 or π, as for
    real samples; a jump would ring in all taps.
    """
    n = 2 * (len(wanted) - 1)
    found = wanted.copy()
    first = int(USABLE * (len(wanted) - 1))
    phase = np.unwrap(np.angle(wanted[first:]), axis=0)
    real = np.pi * np.round(phase[:1] / np.pi)
    turn = np.cos(np.pi / 2 * np.linspace(0.0, 1.0, len(phase)))[:, None] ** 2
    found[first:] = np.abs(wanted[first:]) * np.exp(1j * (real + (phase - real) * turn))
    found[-1] = found[-1].real
    found[0] = wanted[0].real
    full = np.fft.irfft(found, n, axis=0)
    far = np.abs(np.fft.fftfreq(n)) > _FAR
    found[0] -= n * full[far].mean(axis=0)
    return found


def tail_leakage(
    wanted: ComplexArray, sampling_rate: float, *, snr: FloatArray, factor: float
) -> FloatArray:
    """Return the leakage by the outer half of the taps, shape (n_channels,).

    A response that needs long filters is not equalised by short ones. The result is the mean over
    frequencies of ``ln(1 + leakage / noise)``, by the slopes of these taps alone.

    Parameters
    ----------
    wanted : complex128, shape (n_freqs, n_channels)
        As for `design`.
    sampling_rate : float
        Hz.
    snr : float64, shape (n_freqs, n_channels)
        PSD of the motion over PSD of the noise in each channel.
    factor : float
        From `estimator.responses.edge_leakage.slope_factor`, Hz².
    """
    n = 2 * (len(wanted) - 1)
    full = np.fft.irfft(wanted, n, axis=0)
    lag = np.fft.fftfreq(n, 1 / n)
    full[np.abs(lag) <= n / 4] = 0.0
    slope = np.fft.rfft(full * (2 * np.pi * lag / sampling_rate)[:, None], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = factor * np.abs(slope / wanted) ** 2 * snr
    share = np.where(np.isfinite(share), share, 0.0)[2:-2]
    return np.asarray(np.log1p(share).mean(axis=0))


def _needed(taps: FloatArray) -> int:
    """Return the number of taps to either side that exceed the noise of the outermost taps."""
    reach = len(taps) // 2
    if reach < _BLOCKS:
        return reach
    energy = taps[reach:] ** 2
    energy[1:] += taps[:reach][::-1] ** 2
    edges = np.linspace(1, reach + 1, _BLOCKS + 1).astype(np.int64)
    mean = np.add.reduceat(energy, edges[:-1]) / np.diff(edges)
    floor = max(float(median(mean[-_BLOCKS // 3 :])), _ROUNDING * float(energy.max()))
    above = np.flatnonzero(mean > _ABOVE_NOISE * floor)
    last = int(edges[above[-1] + 1]) if len(above) else 1
    return min(reach, int(last / _FLAT) + 1)


def _fade(reach: int) -> FloatArray:
    """Return weights of taps: 1 up to a fraction of the reach, then decreasing to zero."""
    lag = np.abs(np.arange(-reach, reach + 1)) / (reach + 1)
    turn = np.clip((lag - _FLAT) / (1 - _FLAT), 0.0, 1.0)
    return np.asarray(np.cos(np.pi / 2 * turn) ** 2)


def bounded(response: ComplexArray) -> ComplexArray:
    """Return a response in units of its median size, no larger than `MAX_AMPLIFICATION`."""
    size = np.abs(response)
    scale = float(median(size.ravel())) or 1.0
    limit = np.minimum(1.0, MAX_AMPLIFICATION * scale / np.maximum(size, 1e-300))
    return np.asarray(response / scale * limit)


def smoothed(values: ComplexArray, weight: FloatArray, *, stiffness: float) -> ComplexArray:
    """Return smoothed values: values of small weight are smoothed most.

    Minimises ``sum w |s - v|² + stiffness sum |third difference of s|²`` (Whittaker 1923).

    Parameters
    ----------
    values : complex128, shape (n,)
        May be not finite only for zero weights.
    weight : float64, shape (n,)
        Inverse variances.
    stiffness : float
    """
    from scipy.linalg import solveh_banded  # noqa: PLC0415 - only where something is equalised

    n = len(values)
    penalty = np.zeros((4, n))
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    for row in range(4):
        for column in range(row, 4):
            penalty[3 - (column - row), column : column + n - 3] += third[row] * third[column]
    banded = stiffness * penalty
    banded[3] += weight
    right = weight * np.where(weight > 0, values, 0.0)
    found = solveh_banded(banded, np.column_stack([right.real, right.imag]))
    return np.asarray(found[:, 0] + 1j * found[:, 1])
