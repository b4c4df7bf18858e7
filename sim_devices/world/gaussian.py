"""Stationary Gaussian series with random access, equal in every process.

White sources are generated in blocks, each by a counter-based generator whose counter is the index
of the block: block 10 million costs as much as block 0, and two processes compute the same block. A
series is the sources filtered by a matrix of finite impulse responses (overlap-save), so it is
exactly stationary. Its PSD is the target PSD at the resolution of the impulse response, half a
block to either side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy import fft

from sim_devices.world.tables import MAX_BLOCK

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_devices.arrays import ComplexArray, FloatArray

_Kept = TypeVar("_Kept")

LARGEST_SPECTRUM = 2**19  # n_sources × n_samples: limits the memory of a field of many waves


class WhiteSources:
    """Independent white series of unit variance.

    Parameters
    ----------
    key
        Two numbers that identify the sources: a seed, and its use.
    n_sources
        Number of sources.
    longest_block
        Samples of a block, a power of two; fewer where there are many sources.
    """

    def __init__(
        self, key: tuple[int, int], n_sources: int, longest_block: int = MAX_BLOCK
    ) -> None:
        self.n_sources = n_sources
        self.block = min(longest_block, 2 ** ((LARGEST_SPECTRUM // n_sources).bit_length() - 1))
        self._key = np.array(key, dtype=np.uint64)
        self._samples: dict[int, FloatArray] = {}
        self._spectra: dict[int, ComplexArray] = {}

    def samples(self, index: int) -> FloatArray:
        """Return block `index` (any integer), shape (n_sources, block)."""
        if index not in self._samples:
            counter = np.array([0, 0, index % 2**64, 0], dtype=np.uint64)
            random = np.random.Generator(np.random.Philox(key=self._key, counter=counter))
            _keep(self._samples, index, random.standard_normal((self.n_sources, self.block)))
        return self._samples[index]

    def spectrum(self, index: int) -> ComplexArray:
        """Return the transform of blocks `index` - 1 and `index`, shape (n_sources, block + 1)."""
        if index not in self._spectra:
            both = np.concatenate([self.samples(index - 1), self.samples(index)], axis=1)
            _keep(self._spectra, index, fft.rfft(both))
        return self._spectra[index]


class GaussianSeries:
    """White sources filtered by a matrix of responses.

    Parameters
    ----------
    sources
        Shared by all coherent series.
    response
        Maps frequency (Hz, shape (n_freqs,)) to the complex amplitude per root of one-sided PSD,
        shape (n_freqs, n_outputs, n_sources): the cross-spectral matrix of the outputs is
        ``response @ response^H``.
    sampling_rate
        In Hz.
    """

    def __init__(
        self,
        sources: WhiteSources,
        response: Callable[[FloatArray], ComplexArray],
        *,
        sampling_rate: float,
    ) -> None:
        self._sources = sources
        block = sources.block
        frequency = np.asarray(fft.rfftfreq(2 * block, 1 / sampling_rate), np.float64)
        amplitude = np.sqrt(sampling_rate / 2) * response(frequency)  # white unit variance: 2 / fs
        self._used = [np.flatnonzero(row) for row in np.any(amplitude, axis=0)]
        self._filters: list[ComplexArray] = []
        for output, used in enumerate(self._used):
            impulse = fft.irfft(amplitude[:, output, used].T, 2 * block)
            impulse = np.roll(impulse, block // 2, axis=-1)  # lag −block/2 comes first
            impulse[:, block:] = 0
            impulse[:, :block] *= _faded(block)
            self._filters.append(fft.rfft(impulse))
        self._blocks: dict[int, FloatArray] = {}

    @property
    def n_outputs(self) -> int:
        """Number of output series."""
        return len(self._filters)

    def read(self, first: int, n: int) -> FloatArray:
        """Return samples `first` to `first + n` (any integers), shape (n_outputs, n)."""
        block = self._sources.block
        first += block // 2  # the filters delay by half a block
        out = np.empty((self.n_outputs, n))
        done = 0
        while done < n:
            index, at = divmod(first + done, block)
            part = self._block(index)[:, at : at + n - done]
            out[:, done : done + part.shape[1]] = part
            done += part.shape[1]
        return out

    def _block(self, index: int) -> FloatArray:
        if index not in self._blocks:
            white = self._sources.spectrum(index)
            shaped = np.empty((self.n_outputs, white.shape[1]), dtype=complex)
            for row, (filters, used) in enumerate(zip(self._filters, self._used, strict=True)):
                np.einsum("sf,sf->f", filters, white[used], out=shaped[row])
            both = fft.irfft(shaped, 2 * self._sources.block)
            _keep(self._blocks, index, both[:, self._sources.block :])
        return self._blocks[index]


def _faded(length: int) -> FloatArray:
    """Return a Tukey window: one in its middle half, cosine tapers at both ends."""
    outward = np.abs(np.arange(length) - length / 2) / (length / 2)
    return np.asarray((1 + np.cos(2 * np.pi * np.maximum(outward - 0.5, 0))) / 2)


def _keep(cache: dict[int, _Kept], index: int, value: _Kept) -> None:
    """Keep the last two blocks: reads advance in time, and may span two blocks."""
    cache[index] = value
    while len(cache) > 2:
        del cache[next(iter(cache))]
