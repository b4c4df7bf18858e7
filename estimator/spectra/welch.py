"""Cross-spectral matrices by Welch's method, in one pass over the samples.

Convention, here and everywhere in this package: ``csm[f, p, q] = E[X_p conj(X_q)]``, one-sided,
in unit**2/Hz. (``scipy.signal.csd(x, y)`` is its transpose.)

Segments are processed in groups that fit into the cache. Spectra of single segments are kept at a
few frequencies: they show changes with time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.records import dataclass
from estimator.spectra.parts import Part, PartEnds, packed, unpacked
from estimator.spectra.windows import effective_averages, get_window
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

SEGMENTS_PER_BLOCK = 32
BLOCK_VALUES = 2**20  # maximum number of values per group: 8 MB
TAPERED_VALUES = 2**17  # maximum number of values that are transformed at a time: 1 MB
FREQUENCIES_PER_BLOCK = 512
PRODUCT_VALUES = 2**19  # maximum number of values of products of channels at a time: 4 MB
KEPT_VALUES = 10**7  # maximum number of values of products that are kept: 80 MB
TOGETHER = 16  # segments of many channels whose products are added together
BENT = 0.01
"""Share of its noise that the trend may take from a bin: 0.04 dB."""


@dataclass(frozen=True, slots=True)
class WelchSettings:
    """Settings of Welch's method.

    Attributes
    ----------
    sampling_rate : float
        In Hz.
    segment_length : int
        Samples per segment.
    overlap : float
        Overlap between consecutive segments as a fraction of their length, from 0 to below 1.
    window : str or tuple
        As for `estimator.spectra.windows.get_window`.
    detrend : {"none", "constant", "linear"}
        Trend that is removed from every segment of every channel before the window.
    """

    sampling_rate: float
    segment_length: int
    overlap: float = 0.5
    window: str | tuple[str | float, ...] = "hann"
    detrend: Literal["none", "constant", "linear"] = "constant"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sampling_rate) and self.sampling_rate > 0):
            raise EstimatorError(f"sampling rate {self.sampling_rate}: expected Hz above 0")
        if self.segment_length < 2 or np.asarray(self.segment_length).dtype.kind not in "iu":
            raise EstimatorError(
                f"segment length {self.segment_length}: expected an integer of 2 samples or more"
            )
        if not 0 <= self.overlap < 1:
            raise EstimatorError(f"overlap {self.overlap}: expected a fraction from 0 to below 1")
        if self.detrend not in {"none", "constant", "linear"}:
            raise EstimatorError(
                f"detrend {self.detrend!r}: expected 'none', 'constant' or 'linear'"
            )
        get_window(self.window, self.segment_length)

    @property
    def hop(self) -> int:
        """Number of samples between the starts of consecutive segments."""
        return max(1, self.segment_length - round(self.overlap * self.segment_length))

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies in Hz, shape (n_freqs,), from 0 to half the sampling rate."""
        return np.arange(self.segment_length // 2 + 1) * self.sampling_rate / self.segment_length

    @property
    def lowest(self) -> float:
        """Lowest frequency in Hz at which the trend takes no more than `BENT` of white noise.

        Below, spectra are too low: under a Hann window the first bin is, by a sixth without a mean,
        and by 28 % without a line. A correction would be exact for white noise only.
        """
        lines = trends(self.detrend, self.segment_length)
        window = get_window(self.window, self.segment_length)
        size = np.sum(lines**2, axis=1, keepdims=True) * (window @ window)
        taken = np.sum(np.abs(np.fft.rfft(lines * window, axis=1)) ** 2 / size, axis=0)
        return float(self.frequencies[np.max(np.flatnonzero(taken > BENT) + 1, initial=0)])

    def real(self, frequencies: FloatArray) -> BoolArray:
        """Return whether spectra are real-valued: at 0 Hz and half the sampling rate."""
        highest = np.isclose(frequencies, self.sampling_rate / 2, rtol=1e-9, atol=0)
        return np.asarray((frequencies == 0) | highest)


class CrossSpectra:
    """Sum of the segments' spectral matrices; its size does not depend on their number.

    Parameters
    ----------
    settings : WelchSettings
    n_channels : int
    segments : SegmentSpectra, optional
        Receives the spectra of the single segments.
    ends : PartEnds, optional
        Receives the sums at the ends of parts of time, which `end_part` tells.
    """

    def __init__(
        self,
        settings: WelchSettings,
        n_channels: int,
        *,
        segments: SegmentSpectra | None = None,
        ends: PartEnds | None = None,
    ) -> None:
        if n_channels < 1:
            raise EstimatorError(f"{n_channels} channels; expected at least one")
        self.settings = settings
        self.n_channels = n_channels
        self.segments = segments
        self.ends = ends
        self.n_segments = 0
        length = settings.segment_length
        self._window = get_window(settings.window, length)
        n_freqs = settings.segment_length // 2 + 1
        self._shape = n_freqs, n_channels
        self._products = _Products(*self._shape)
        self._work = Work()
        self._block = max(1, min(SEGMENTS_PER_BLOCK, BLOCK_VALUES // (n_channels * length)))
        self._taper = np.empty((0, n_channels))
        self._tapers = bool(np.any(self._window != 1))
        # Trends are fitted to the samples and subtracted from their spectra, where they fill few
        # bins.
        lines = trends(settings.detrend, length)
        self._fit = lines / np.sum(lines**2, axis=1, keepdims=True)
        spectra = np.fft.rfft(lines * self._window, axis=1).T
        self._trend_bins = slice(0, _last_bin(spectra))
        self._trend_spectra = spectra[self._trend_bins]

    def add(self, samples: FloatArray, starts: IntArray, *, places: IntArray | None = None) -> None:
        """Add the segments of `samples` that begin at `starts`.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
            In physical units. Samples outside all segments have no effect.
        starts : int64, shape (n_segments,)
            Row of `samples` at which each segment begins.
        places : int64, shape (n_segments,), optional
            As of `SegmentSpectra.add`.

        Raises
        ------
        EstimatorError
            If a segment is not within `samples`, or the number of channels differs.
        """
        samples = np.asarray(samples, dtype=np.float64)
        starts = np.asarray(starts, dtype=np.int64)
        self.check(samples, starts)
        for spectra in self._transformed(samples, starts, self._work):
            own, places = (None, None) if places is None else np.split(places, [len(spectra)])
            self._add(spectra, own)

    def add_spectra(
        self,
        spectra: ComplexArray,
        products: FloatArray | None = None,
        *,
        places: IntArray | None = None,
    ) -> None:
        """Add segments by their spectra.

        Parameters
        ----------
        spectra : complex128, shape (n_segments, n_freqs, n_channels), contiguous
            Transforms of windowed samples without trend, in physical units.
        products : float64, shape (n_freqs, 2 * n_channels, 2 * n_channels), optional
            What `products` returned of the same spectra.
        places : int64, shape (n_segments,), optional
            As of `add`.

        Raises
        ------
        EstimatorError
            If their shape is another.
        """
        if spectra.ndim != 3 or spectra.shape[1:] != self._shape:
            n_freqs, n_channels = self._shape
            raise EstimatorError(
                f"spectra of shape {spectra.shape}, expected (n_segments, {n_freqs}, {n_channels})"
            )
        if len(spectra):
            self._add(spectra, places, products)

    def _add(
        self, spectra: ComplexArray, places: IntArray | None, products: FloatArray | None = None
    ) -> None:
        self._products.add(spectra, products)
        if self.segments is not None:
            self.segments.add(spectra[:, self.segments.bins], places)
        self.n_segments += len(spectra)

    def products(self, spectra: ComplexArray, out: FloatArray | None = None) -> FloatArray | None:
        """Return the sum of products of segments for `add_spectra`, in `out` if given.

        Threads may call it. None where `add_spectra` does not use it: of one segment, and where
        sums are large.
        """
        return self._products.gram(spectra, out)

    def add_products(
        self, products: FloatArray, single: NDArray[np.complex64], *, places: IntArray
    ) -> None:
        """Add segments as `add_spectra` does, by what `products` returned of them.

        `single` are their spectra at the bins of `segments`, which must be kept.
        """
        self._products.add_gram(products)
        if self.segments is not None:
            self.segments.add(single, places)
        self.n_segments += len(single)

    def check(self, samples: FloatArray, starts: IntArray) -> None:
        """Raise the errors of `add` without adding segments."""
        if samples.ndim != 2 or samples.shape[1] != self.n_channels:
            raise EstimatorError(
                f"samples of shape {samples.shape}, expected (n_samples, {self.n_channels})"
            )
        last = len(samples) - self.settings.segment_length
        if starts.ndim != 1:
            raise EstimatorError(f"starts of shape {starts.shape}, expected one row per segment")
        if starts.size and (starts.min() < 0 or starts.max() > last):
            raise EstimatorError(
                f"segments begin at rows {starts.min()} to {starts.max()}, expected 0 to {last}"
            )

    def transforms(
        self, samples: FloatArray, starts: IntArray, work: Work | None = None
    ) -> ComplexArray:
        """Return the spectra of segments as `add_spectra` takes them; threads may call it.

        `samples` and `starts` are those of `add`; what is returned is in the memory of `work`.
        """
        work = Work() if work is None else work
        found = work.spectra(len(starts), *self._shape)
        for _ in self._transformed(samples, starts, work, found):
            pass
        return found

    def _transformed(
        self,
        samples: FloatArray,
        starts: IntArray,
        work: Work,
        found: ComplexArray | None = None,
    ) -> Iterator[ComplexArray]:
        """Yield the spectra of some segments at a time: parts of `found`, or the same memory."""
        length, n_channels = self.settings.segment_length, self.n_channels
        block = self._block if found is None else TAPERED_VALUES // (n_channels * length)
        block = max(1, min(block, len(starts)))
        by_channel = samples.strides[0] == samples.itemsize  # channel after channel in memory
        if not (by_channel or len(self._taper)):
            # One value per sample and channel: contiguous products are several times faster.
            self._taper = np.repeat(self._window[:, None], n_channels, axis=1)
        taper = self._window[:, None] if by_channel else self._taper
        frames = work.frames(block, length, n_channels, by_channel=by_channel)
        at_work = work.spectra(block, *self._shape) if found is None else found
        trend = np.empty((block, len(self._fit), n_channels))
        for first in range(0, len(starts), block):
            rows = starts[first : first + block]
            n = len(rows)
            segments = _segments(samples, rows, length)
            np.matmul(self._fit, segments, out=trend[:n])
            if self._tapers:
                segments = np.multiply(segments, taper, out=frames[:n])
            spectra = at_work[:n] if found is None else at_work[first : first + n]
            np.fft.rfft(segments, axis=1, out=spectra)
            spectra[:, self._trend_bins] -= self._trend_spectra @ trend[:n]
            yield spectra

    @property
    def products_shape(self) -> tuple[int, ...]:
        """Shape of what `products` returns; empty where sums are large."""
        return self._products.gram_shape if self._products.is_small else ()

    @property
    def n_effective(self) -> float:
        """Number of independent averages equivalent to these segments, if contiguous."""
        return effective_averages(self._window, self.settings.hop, self.n_segments)

    def end_part(self, place: int) -> None:
        """End a part of time before this place of the segments."""
        if self.ends is not None:
            self.ends.end(place, self.n_segments, self._products.packed())

    def parts(self, place: int) -> tuple[Part, ...]:
        """Return the averages in parts of time, up to this place; none where none are kept.

        Times are those of places in the recording, of which each begins a hop after the one before.
        """
        if self.ends is None or not self.n_segments:
            return ()
        hop, rate = self.settings.hop, self.settings.sampling_rate
        found = []
        place_before, count_before, before = 0, 0, None
        for end, count, after in self.ends.ends(place, self.n_segments, self._products.packed()):
            if own := count - count_before:
                averages = effective_averages(self._window, hop, own)
                last = end * hop + self.settings.segment_length - hop
                scale = self._density(own)[self.ends.bins]
                found.append(
                    Part(
                        before,
                        after,
                        scale,
                        averages,
                        place_before * hop / rate,
                        last / rate,
                        n_segments=own,
                    )
                )
            place_before, count_before, before = end, count, after
        return tuple(found)

    def _density(self, n_segments: int) -> FloatArray:
        """Return the factor from a sum to a one-sided density, shape (n_freqs,)."""
        energy = self.settings.sampling_rate * float(self._window @ self._window)
        density = np.full(self._shape[0], 2 / (energy * n_segments))
        density[0] /= 2
        if self.settings.segment_length % 2 == 0:
            density[-1] /= 2
        return density

    def csm(self) -> ComplexArray:
        """Return the cross-spectral matrix.

        Returns
        -------
        complex128, shape (n_freqs, n_channels, n_channels)
            One-sided, in unit**2/Hz.

        Raises
        ------
        InsufficientDataError
            If no segment has been added.
        """
        if self.n_segments == 0:
            raise InsufficientDataError("no segment yet; expected at least one")
        density = self._density(self.n_segments)
        self._work = Work()
        csm = self._products.total()
        csm *= density[:, None, None]
        return csm

    def merge(self, other: CrossSpectra) -> None:
        """Add the segments of another accumulator with the same settings to this one."""
        if other.settings != self.settings or other.n_channels != self.n_channels:
            raise EstimatorError(
                f"spectra of {other.n_channels} channels with {other.settings} cannot be added to "
                f"{self.n_channels} channels with {self.settings}"
            )
        self._products.merge(other._products)
        self.n_segments += other.n_segments

    def __add__(self, other: CrossSpectra) -> CrossSpectra:
        total = CrossSpectra(self.settings, self.n_channels)
        total.merge(self)
        total.merge(other)
        return total


class Work:
    """Tapered segments and spectra: memory that is not taken afresh for each group or piece."""

    def __init__(self) -> None:
        self._frames, self._spectra = np.empty(0), np.empty(0, dtype=np.complex128)

    def frames(
        self, n_segments: int, length: int, n_channels: int, *, by_channel: bool
    ) -> FloatArray:
        """Return an array (n_segments, length, n_channels), whose memory may be by channel."""
        size = n_segments * length * n_channels
        if len(self._frames) < size:
            self._frames = np.empty(size)
        inner = (n_channels, length) if by_channel else (length, n_channels)
        shaped = self._frames[:size].reshape(n_segments, *inner)
        return shaped.swapaxes(1, 2) if by_channel else shaped

    def spectra(self, n_segments: int, n_freqs: int, n_channels: int) -> ComplexArray:
        """Return an array (n_segments, n_freqs, n_channels)."""
        size = n_segments * n_freqs * n_channels
        if len(self._spectra) < size:
            self._spectra = np.empty(size, dtype=np.complex128)
        return self._spectra[:size].reshape(n_segments, n_freqs, n_channels)


class _Products:
    """Sum of ``X conj(X).T`` over segments.

    Real and imaginary parts are 2 n_channels real numbers: their Gram matrix is symmetric, so that
    BLAS does half the work. It takes twice the memory of the sum of complex numbers, so it is kept
    only where it is small. A larger sum is written once for `TOGETHER` segments, which takes longer
    than their products. Of the sum, which is Hermitian, the real part of the lower triangle is kept
    with the imaginary part of the upper one.
    """

    def __init__(self, n_freqs: int, n_channels: int) -> None:
        n_parts = 2 * n_channels
        self._total = np.zeros((n_freqs, n_channels, n_channels))
        self._gram = np.empty(0)
        self._has_gram = False
        self._waiting: list[ComplexArray] = []
        self.gram_shape = n_freqs, n_parts, n_parts
        self.is_small = math.prod(self.gram_shape) <= KEPT_VALUES
        step = max(1, min(FREQUENCIES_PER_BLOCK, PRODUCT_VALUES // n_parts**2))
        self._pieces = [slice(low, low + step) for low in range(0, n_freqs, step)]

    def gram(self, spectra: ComplexArray, out: FloatArray | None = None) -> FloatArray | None:
        """Return the products of segments as a small sum keeps them; None where it does not."""
        if not self.is_small or len(spectra) < 2:
            return None
        parts = spectra.view(np.float64)
        found = np.empty(self.gram_shape) if out is None else out
        for some in self._pieces:
            own = parts[:, some]
            np.matmul(own.transpose(1, 2, 0), own.swapaxes(0, 1), out=found[some])
        return found

    def add(self, spectra: ComplexArray, gram: FloatArray | None = None) -> None:
        """Add segments by their spectra, contiguous, or by what `gram` returned of them."""
        gram = self.gram(spectra) if gram is None else gram
        if gram is not None:
            self.add_gram(gram)
        elif self.is_small:  # of one segment: cheaper than of real and imaginary parts
            for some in self._pieces:
                found = spectra[0, some]
                self._total[some] += packed(found[:, :, None] * found[:, None, :].conj())
        else:
            self._waiting.append(spectra.copy())
            if sum(map(len, self._waiting)) >= TOGETHER:
                self._add_waiting()

    def add_gram(self, gram: FloatArray) -> None:
        """Add segments by what `gram` returned of them."""
        if self._has_gram:
            self._gram += gram
        elif len(self._gram):
            self._gram[:] = gram
        else:
            self._gram = gram.copy()
        self._has_gram = True

    def _add_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for some in self._pieces if waiting else ():
            found = np.concatenate([each[:, some] for each in waiting])
            self._total[some] += packed(
                np.matmul(found.transpose(1, 2, 0), found.conj().swapaxes(0, 1))
            )

    def _settle(self) -> None:
        """Add what waits, and what is kept in another form."""
        for some in self._pieces if self._has_gram else ():
            _add_gram(self._total[some], self._gram[some])
        self._has_gram = False
        self._add_waiting()

    def packed(self) -> FloatArray:
        """Return the sum as it is kept; later segments change it."""
        self._settle()
        return self._total

    def total(self) -> ComplexArray:
        """Return the sum in an array of its own, (n_freqs, n_channels, n_channels)."""
        self._settle()
        self._gram = np.empty(0)  # whoever asks for the sum is rarely about to add more
        found = np.empty(self._total.shape, dtype=np.complex128)
        for some in self._pieces:
            found[some] = unpacked(self._total[some])
        return found

    def merge(self, other: _Products) -> None:
        """Add another sum."""
        self._settle()
        other._settle()
        self._total += other._total


def _add_gram(total: FloatArray, gram: FloatArray) -> None:
    """Add products of complex numbers, given those of their real and imaginary parts."""
    one, other, sign = _of_gram(total.shape[1])
    flat = gram.reshape(len(gram), -1)
    own = np.take(flat, other, axis=1)
    own *= sign
    own += np.take(flat, one, axis=1)
    total += own.reshape(total.shape)


@cache
def _of_gram(n: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Return which two products each element of a packed sum has, and the sign of the second."""
    i, j = 2 * np.indices((n, n))
    upper = i < j
    one = (i + upper) * 2 * n + j
    other = (i + ~upper) * 2 * n + j + 1
    return one.ravel(), other.ravel(), np.where(upper, -1.0, 1.0).ravel()


def _segments(samples: FloatArray, rows: IntArray, length: int) -> FloatArray:
    """Return the segments at `rows`, (n, length, n_channels), without copy if evenly spaced."""
    windows = np.lib.stride_tricks.sliding_window_view(samples, length, axis=0).swapaxes(1, 2)
    steps = np.diff(rows)
    if len(steps) == 0 or (steps[0] > 0 and np.all(steps == steps[0])):
        return windows[rows[0] : rows[-1] + 1 : steps[0] if len(steps) else 1]
    return windows[rows]


def trends(detrend: str, length: int) -> FloatArray:
    """Return the orthogonal trends that `detrend` removes, shape (n_trends, length)."""
    line = np.arange(length) - (length - 1) / 2
    return np.stack([np.ones(length), line])[: {"none": 0, "constant": 1, "linear": 2}[detrend]]


def _last_bin(spectra: ComplexArray) -> int:
    """Return the bin from which spectra (n_freqs, n_trends) are only rounding."""
    size = np.abs(spectra)
    above = np.any(size > len(size) * np.finfo(np.float64).eps * size.max(axis=0), axis=1)
    return int(np.max(np.nonzero(above), initial=-1)) + 1


def scale(csm: ComplexArray, response: ComplexArray) -> ComplexArray:
    """Divide by the response of every channel, to convert to physical units.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
    response : complex128, shape (n_freqs, n_channels)
        Response of each channel to one unit, at each frequency.

    Returns
    -------
    complex128, shape (n_freqs, n_channels, n_channels)
        ``csm[f, p, q] / (h[f, p] conj(h[f, q]))``; NaN if a response is zero, such as at 0 Hz.

    Raises
    ------
    EstimatorError
        If `response` is not one number per frequency and channel.
    """
    response = np.asarray(response, dtype=np.complex128)
    if response.shape != csm.shape[:2]:
        raise EstimatorError(f"response of shape {response.shape}, expected {csm.shape[:2]}")
    known = np.isfinite(response) & (response != 0)
    inverse = np.where(known, 1 / np.where(known, response, 1), np.nan)
    found = csm * inverse[:, :, None]
    found *= inverse[:, None, :].conj()
    return found


KEPT_FREQUENCIES = 48
MAX_SEGMENTS, MAX_VALUES = 4096, 1 << 21
"""Maximum numbers of kept segments and values; beyond, one of two segments is kept, then one of
four, and so on."""
_SCRAMBLES = 2654435769  # the golden ratio of 2**32


def kept_rows(n: int, every: int) -> IntArray:
    """Return which of n rows are kept where one of `every` is, a power of two.

    They are unevenly spaced: what changes with a period is met at all its phases. Of those kept of
    two, one of two is kept of four.
    """
    rows = np.arange(-(-n // every))
    for _ in range(every.bit_length() - 1):
        rows = 2 * rows + (rows * _SCRAMBLES >> 16 & 1)
    return rows[rows < n]


def kept_bins(n_freqs: int) -> IntArray:
    """Return the kept bins, with a constant ratio where they are distinct.

    Parameters
    ----------
    n_freqs : int
        Number of frequencies of a spectrum, from 0 to half the sampling rate.

    Returns
    -------
    int64, shape (n_kept,)
        Without the two lowest bins and the highest tenth.
    """
    highest = int(0.9 * (n_freqs - 1))
    if highest <= 2:
        return np.empty(0, np.int64)
    kept = np.round(np.geomspace(2, highest, KEPT_FREQUENCIES)).astype(np.int64)
    return np.array(sorted(set(kept.tolist())), dtype=np.int64)


class SegmentSpectra:
    """Spectra of single segments at `bins`.

    Parameters
    ----------
    bins : int64, shape (n_kept,)
    n_channels : int

    Attributes
    ----------
    every : int
        One of so many segments is kept (`kept_rows`).
    most : int
        Maximum number of kept segments.
    places : int64, shape (n_segments,)
        Numbers in time of those kept.
    """

    def __init__(self, bins: IntArray, n_channels: int) -> None:
        self.bins = bins
        self.every = 1
        self.most = max(1, min(MAX_SEGMENTS, MAX_VALUES // max(1, len(bins) * n_channels)))
        self._n_channels = n_channels
        self._n_seen = 0
        self._kept = np.empty((0, len(bins), n_channels), np.complex64)
        self._n_kept = 0
        self.places: IntArray = np.empty(0, np.int64)

    def add(
        self, spectra: ComplexArray | NDArray[np.complex64], places: IntArray | None = None
    ) -> None:
        """Add the spectra of segments, in order of time.

        Parameters
        ----------
        spectra : complex, shape (n_segments, n_kept, n_channels)
        places : int64, shape (n_segments,), optional
            Their numbers in time; default: how many were added before.
        """
        first = self._n_seen
        places = first + np.arange(len(spectra)) if places is None else places
        self._n_seen += len(spectra)
        while len(kept := kept_rows(self._n_seen, self.every)) > self.most:
            self.thin(2 * self.every)
        kept = kept[self._n_kept :] - first
        end = self._n_kept + len(kept)
        if end > len(self._kept):
            # One array that grows: small ones would lie between others that are freed.
            n_rows = max(end, min(2 * len(self._kept), self.most))
            room = np.empty((n_rows, *self._kept.shape[1:]), np.complex64)
            room[: self._n_kept] = self.values()
            self._kept = room
        self._kept[self._n_kept : end] = spectra[kept]
        self.places = np.concatenate([self.places, places[kept]])
        self._n_kept = end

    def __len__(self) -> int:
        """Return the number of kept segments."""
        return self._n_kept

    def thin(self, every: int) -> None:
        """Keep one of `every` segments from now on, a multiple of the current value."""
        if every != self.every:
            some = kept_rows(self._n_kept, every // self.every)
            self._kept, self.places = self.values()[some], self.places[some]
            self._n_kept = len(self._kept)
            self.every = every

    def values(self) -> NDArray[np.complex64]:
        """Return the kept spectra, (n_segments, n_kept, n_channels), not scaled to a density.

        Later segments do not change them.
        """
        return self._kept[: self._n_kept]
