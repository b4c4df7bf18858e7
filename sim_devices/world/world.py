"""The samples of every sensor of a scenario.

The motion is computed on a master grid, fast enough for interpolation at any instant with an error
of −120 dB. Direction, gain, delay, response and position of a sensor are part of the filters of its
channels. Its clock defines the instants of its samples. Its noise is computed at these samples.

Motion and noise are stationary Gaussian series with random access, equal in every process. White
sources are generated in blocks, each by a counter-based generator whose counter is the index of the
block: block 10 million costs as much as block 0, and two processes compute the same block. A series
is the sources filtered by a matrix of finite impulse responses (overlap-save), so it is exactly
stationary. Its PSD is the target PSD at the resolution of the impulse response, half a block to
either side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar
from zlib import crc32

import numpy as np
from numpy import fft
from numpy.lib.stride_tricks import sliding_window_view

from sim_devices.world import plane_waves
from sim_devices.world.tables import (
    MAX_BLOCK,
    USABLE,
    ChangingLevel,
    PlaneWaves,
    SensorClock,
    SensorResponse,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_devices.arrays import ComplexArray, FloatArray
    from sim_devices.world.scenario import Scenario

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
        self._key = key
        self._samples: dict[int, FloatArray] = {}
        self._spectra: dict[int, ComplexArray] = {}

    def samples(self, index: int) -> FloatArray:
        """Return block `index` (any integer), shape (n_sources, block)."""
        if index not in self._samples:
            _keep(self._samples, index, _normal(self._key, index, self.n_sources, self.block))
        return self._samples[index]

    def spectrum(self, index: int) -> ComplexArray:
        """Return the transform of blocks `index` - 1 and `index`, shape (n_sources, block + 1)."""
        if index not in self._spectra:
            both = np.concatenate([self.samples(index - 1), self.samples(index)], axis=1)
            _keep(self._spectra, index, fft.rfft(both))
        return self._spectra[index]


def _normal(key: tuple[int, int], index: int, *shape: int) -> FloatArray:
    """Return block `index` (any integer) of a white series, equal in every process."""
    counter = np.array([0, 0, index % 2**64, 0], dtype=np.uint64)
    philox = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter)
    return np.random.Generator(philox).standard_normal(shape)


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


KNOT_SPACING = 10.0  # s between the knots of the wander, on the sensor's own time
KNOTS_PER_BLOCK = 4096


class SampleClock:
    """World time of each sample of a sensor.

    The rate error of the oscillator is `ppm`, plus a random walk (linear between knots), plus an
    exponential step, a ramp and a cycle. The time is its exact integral, and so it is smooth. The
    random walk is zero up to sample 0.
    """

    def __init__(self, clock: SensorClock, *, sampling_rate: float, key: tuple[int, int]) -> None:
        self._clock = clock
        self._sampling_rate = sampling_rate
        self._key = key
        self._rate = np.zeros(1)  # random walk of the rate at each knot, s/s
        self._time = np.zeros(1)  # its integral, s

    def times(self, first_sample: int, n: int) -> FloatArray:
        """Return the world time in s of samples `first_sample` to `first_sample + n`, (n,)."""
        clock = self._clock
        nominal = (first_sample + np.arange(n)) / self._sampling_rate
        times = clock.offset + nominal / (1 + clock.ppm * 1e-6)
        if clock.wander and n:
            times -= self._wander(nominal)
        if clock.step is not None:
            since = np.maximum(nominal - clock.step.time, 0.0)
            constant = clock.step.time_constant
            settling = constant * -np.expm1(-since / constant) if constant else 0.0
            times -= clock.step.ppm * 1e-6 * (since - settling)
        if clock.ramp is not None:
            since = np.maximum(nominal - clock.ramp.time, 0.0)
            within = np.minimum(since, clock.ramp.duration)
            integral = within**2 / (2 * clock.ramp.duration) + (since - within)
            times -= clock.ramp.ppm * 1e-6 * integral
        if clock.cycle is not None:
            angular = 2 * np.pi / clock.cycle.period
            times -= clock.cycle.ppm * 1e-6 * (1 - np.cos(angular * nominal)) / angular
        return np.asarray(times)

    def _wander(self, nominal: FloatArray) -> FloatArray:
        place = np.maximum(nominal / KNOT_SPACING, 0.0)
        knot = place.astype(np.int64)
        while len(self._rate) < knot[-1] + 2:
            self._extend()
        along = place - knot
        rate, following = self._rate[knot], self._rate[knot + 1]
        within = along * (rate + along * (following - rate) / 2)
        return np.asarray(self._time[knot] + KNOT_SPACING * within)

    def _extend(self) -> None:
        white = _normal(self._key, len(self._rate) // KNOTS_PER_BLOCK, KNOTS_PER_BLOCK)
        step = self._clock.wander * 1e-6 * np.sqrt(KNOT_SPACING / 3600)
        rate = self._rate[-1] + np.cumsum(step * white)
        before = np.concatenate([self._rate[-1:], rate[:-1]])
        time = self._time[-1] + np.cumsum(KNOT_SPACING * (before + rate) / 2)
        self._rate = np.concatenate([self._rate, rate])
        self._time = np.concatenate([self._time, time])


class MotionLevel:
    """Level of a motion that changes, equal for all sensors and in every process."""

    def __init__(self, level: ChangingLevel, *, key: tuple[int, int]) -> None:
        self._level = level
        self._key = key

    def amplitude(self, times: FloatArray) -> FloatArray:
        """Return the factor of the motion at world `times` in s, shape (n,)."""
        place = times / self._level.period
        first = int(np.floor(place.min(initial=0.0)))
        knots = self._knots(first, int(np.floor(place.max(initial=0.0))) + 2)
        decibel = np.interp(place, first + np.arange(len(knots)), knots)
        return np.asarray(10 ** (decibel / 20))

    def _knots(self, first: int, end: int) -> FloatArray:
        """Return the level in dB at knots `first` to `end`, excluded."""
        blocks = range(first // KNOTS_PER_BLOCK, (end - 1) // KNOTS_PER_BLOCK + 1)
        each = [_normal(self._key, block, KNOTS_PER_BLOCK) for block in blocks]
        begin = first - blocks[0] * KNOTS_PER_BLOCK
        return self._level.deviation * np.concatenate(each)[begin : begin + end - first]


GRID_OVERSAMPLING = 4  # rate of the master grid over the highest frequency of the motion
N_TAPS = 22
KAISER_BETA = 13.4
"""Beta of a window with 130 dB attenuation: 0.1102 (130 - 8.7)."""
POLYNOMIAL_DEGREE = 13
CHUNK = 4096  # instants interpolated per step: their windows fit into the cache


class Motion:
    """Motion at the channels of one sensor: a function of time, equal in every process."""

    def __init__(self, series: GaussianSeries, *, sampling_rate: float) -> None:
        self._series = series
        self._rate = sampling_rate

    def at(self, times: FloatArray) -> FloatArray:
        """Return the motion at world `times` (s, shape (n,), any order), shape (n, n_channels)."""
        out = np.empty((len(times), self._series.n_outputs))
        for start in range(0, len(times), CHUNK):
            place = times[start : start + CHUNK] * self._rate
            index = np.floor(place).astype(np.int64)
            first = int(index.min()) - N_TAPS // 2 + 1
            last = int(index.max()) + N_TAPS // 2
            grid = self._series.read(first, last + 1 - first)
            windows = sliding_window_view(grid, N_TAPS, axis=1)[:, index - index.min()]
            weights = np.vander(2 * (place - index) - 1, POLYNOMIAL_DEGREE + 1) @ _TAPS
            np.einsum("ont,nt->no", windows, weights, out=out[start : start + CHUNK])
        return out


class World:
    """Motion, clocks and noise of the sensors of a scenario, computed on demand.

    Parameters
    ----------
    scenario
    floor
        Number of the floor: the motion of each has the same spectra, and is independent.
    """

    def __init__(self, scenario: Scenario, *, floor: int = 0) -> None:
        self._scenario = scenario
        motion = scenario.motion
        n_sources = (
            plane_waves.n_sources(motion) if isinstance(motion, PlaneWaves) else len(motion.spectra)
        )
        key = scenario.seed, floor << 32
        self._sources = WhiteSources(key, n_sources, scenario.longest_block)
        level = None if isinstance(motion, PlaneWaves) else motion.level
        self._level = None if level is None else MotionLevel(level, key=(key[0], key[1] + 1))
        self._motions: dict[str, Motion] = {}
        self._noises: dict[str, GaussianSeries] = {}
        self._clocks: dict[str, SampleClock] = {}

    def samples(self, sensor: str, first_sample: int, n: int) -> FloatArray:
        """Return the sensor's readings, including noise, in m/s², shape (n, n_channels)."""
        times = self.sample_times(sensor, first_sample, n)
        felt = self.motion(sensor).at(times)
        if self._level is not None:
            felt *= self._level.amplitude(times)[:, None]
        felt += self.noise(sensor, first_sample, n)
        return felt

    def sample_times(self, sensor: str, first_sample: int, n: int) -> FloatArray:
        """Return the world time in s of the sensor's samples, shape (n,)."""
        if sensor not in self._clocks:
            model = self._scenario.sensor(sensor)
            self._clocks[sensor] = SampleClock(
                model.clock, sampling_rate=model.sampling_rate, key=self._key(sensor, "clock")
            )
        return self._clocks[sensor].times(first_sample, n)

    def motion(self, sensor: str) -> Motion:
        """Return the motion at the channels of a sensor."""
        if sensor not in self._motions:
            rate = GRID_OVERSAMPLING * self._scenario.bandwidth / USABLE
            series = GaussianSeries(
                self._sources, lambda f: self._response(sensor, f), sampling_rate=rate
            )
            self._motions[sensor] = Motion(series, sampling_rate=rate)
        return self._motions[sensor]

    def noise(self, sensor: str, first_sample: int, n: int) -> FloatArray:
        """Return the sensor's own noise in m/s², shape (n, n_channels)."""
        if sensor not in self._noises:
            spectra = self._scenario.noise_spectra(sensor)
            self._noises[sensor] = GaussianSeries(
                WhiteSources(
                    self._key(sensor, "noise"), len(spectra), self._scenario.longest_block
                ),
                lambda f: _diagonal(np.sqrt([spectrum.psd(f) for spectrum in spectra])),
                sampling_rate=self._scenario.sensors[sensor].sampling_rate,
            )
        return self._noises[sensor].read(first_sample, n).T

    def motion_csm(self, sensors: tuple[str, ...], frequency: FloatArray) -> ComplexArray:
        """Return the cross-spectral matrix for perfect clocks and no noise.

        Parameters
        ----------
        sensors
            Names, in the order of the channels.
        frequency
            In Hz, shape (n_freqs,).

        Returns
        -------
        complex128, shape (n_freqs, n_channels, n_channels)
            ``E[X_p conj(X_q)]``, one-sided, in (m/s²)²/Hz.
        """
        rows = np.concatenate([self._response(sensor, frequency) for sensor in sensors], axis=1)
        return np.asarray(rows @ rows.conj().transpose(0, 2, 1))

    def true_csm(self, sensors: tuple[str, ...], frequency: FloatArray) -> ComplexArray:
        """Return `motion_csm` plus the sensors' true noise on its diagonal."""
        csm = self.motion_csm(sensors, frequency)
        noise = [
            self._scenario.true_noise_psd(sensor, channel, frequency)
            for sensor in sensors
            for channel in range(self._scenario.n_channels(sensor))
        ]
        diagonal = np.arange(len(noise))
        csm[:, diagonal, diagonal] += np.transpose(noise)
        return csm

    def _key(self, sensor: str, use: str) -> tuple[int, int]:
        own = self._scenario.sensors[sensor].seed
        return self._scenario.seed if own is None else own, crc32(f"{use} {sensor}".encode()) + 1

    def _response(self, sensor: str, frequency: FloatArray) -> ComplexArray:
        """Return the amplitude of each source in each channel, (n_freqs, n_channels, n_sources)."""
        scenario = self._scenario
        model = scenario.sensor(sensor)
        channel = scenario.gains(sensor)[:, None] * scenario.directions(sensor)
        delayed = np.exp(-2j * np.pi * frequency * model.delay)
        common = np.asarray(_whole_to(scenario.bandwidth, frequency) * delayed, np.complex128)
        if model.response is not None:
            common = common * _poles_and_zeros(model.response, frequency)
        return np.asarray(
            common[:, None, None] * (channel @ self._ground(model.position, frequency))
        )

    def _ground(self, position: tuple[float, float, float], frequency: FloatArray) -> ComplexArray:
        """Return the amplitude of each source in each direction, (n_freqs, n_dims, n_sources)."""
        motion = self._scenario.motion
        if isinstance(motion, PlaneWaves):
            asd = np.sqrt(motion.spectrum.psd(frequency))
            return asd[:, None, None] * plane_waves.field(motion, position, frequency)
        each = _diagonal(np.sqrt([spectrum.psd(frequency) for spectrum in motion.spectra]))
        return each if motion.mixing is None else np.asarray(np.array(motion.mixing) @ each)


def _diagonal(rows: FloatArray) -> ComplexArray:
    """Return matrices (n_freqs, n, n) with rows (n, n_freqs) on their diagonals."""
    return np.asarray(rows.T[:, :, None] * np.eye(len(rows)), dtype=complex)


def _whole_to(bandwidth: float, frequency: FloatArray) -> FloatArray:
    """Return a low-pass: one up to `bandwidth`, zero from 10/9 of it on, raised cosine between."""
    beyond = (frequency / bandwidth - 1) / (1 / USABLE - 1)
    return np.asarray((1 + np.cos(np.pi * np.clip(beyond, 0, 1))) / 2)


def _poles_and_zeros(response: SensorResponse, frequency: FloatArray) -> ComplexArray:
    def raw(f: FloatArray) -> ComplexArray:
        s = 2j * np.pi * f[:, None]
        poles, zeros = (
            np.array(pairs).reshape(-1, 2) for pairs in (response.poles, response.zeros)
        )
        above = np.prod(s - (zeros[:, 0] + 1j * zeros[:, 1]), axis=1)
        return np.asarray(above / np.prod(s - (poles[:, 0] + 1j * poles[:, 1]), axis=1))

    return raw(frequency) / np.abs(raw(np.array([response.normalised_at])))


def _interpolator() -> FloatArray:
    """Return the weights of the taps as polynomials in the position between grid samples, −1 to 1.

    Shape (POLYNOMIAL_DEGREE + 1, N_TAPS), highest power first. The filter is a sinc with a Kaiser
    window, flat to a quarter of the grid rate, with 130 dB attenuation from three quarters on.
    """
    node = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    tap = np.arange(N_TAPS) - N_TAPS // 2 + 1
    away = tap - (node[:, None] + 1) / 2
    reach = np.clip(1 - (2 * away / N_TAPS) ** 2, 0, None)
    weights = np.sinc(away) * np.i0(KAISER_BETA * np.sqrt(reach)) / np.i0(KAISER_BETA)
    return np.asarray(np.polyfit(node, weights, POLYNOMIAL_DEGREE))


_TAPS = _interpolator()
