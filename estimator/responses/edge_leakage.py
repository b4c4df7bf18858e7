"""Leakage at the edges of segments by unequal transfer functions, and measured responses.

Theory of operation
-------------------
Let a channel have the response D to the motion m. Its windowed spectrum is to first order
``D M + D' M'``, with D' the slope of D per Hz and M' the transform of m under the slope of the
window. M' is independent of M, and its PSD is `slope_factor` times that of M: 1 / (3 T²) for a Hann
window of length T. The part of ``D' M'`` that is equal in all channels is common motion; the rest
is noise of the channels that differ.

The responses follow from the averages. A constant real combination of the channels of sensor j
predicts channel c up to one complex factor, ``D_cj = S_cz / S_yz``, where y is the prediction by j,
and z that by a third sensor. No channel's noise biases it. Of several third sensors the weighted
mean is taken, with weights ``|S_yz|² / S_zz``: their predictions may have any sign and phase. Some
third sensors do: their noise counts little beside that of c and y, whose product all j and k have.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimator.blocks import BLOCK_BYTES, blocks
from estimator.likelihood.dimension import bands
from estimator.records import dataclass
from estimator.self_noise.coherency import check_dims, own_channels
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MIN_COHERENCE = 0.3
"""Minimum coherence between a channel and its prediction at a used frequency."""
_LEAST_OWN = 0.1  # of the power of a line, below which all has leaked from others
_MOST_LEAKED = 0.5  # of the power of a line, below which its response is not seen
_FEIGNED = 0.46  # leakage that the error of responses feigns, over its power; it scatters twice so
_TWO_FREQUENCIES = 1.67  # 2 (1 - 1/6): variance of a difference two bins apart under Hann
_CORRELATED = 2.0  # variance of a sum over that of independent frequencies
_MAX_FREQUENCIES = 128  # maximum number of frequencies for the directions
_MAX_THIRDS = 9  # third sensors: all that predict would cost the cube of their number
_RIDGE = 1e-9  # fraction of the mean power: keeps matrices regular with a dead direction


def slope_factor(window: FloatArray, sampling_rate: float) -> float:
    """Return the PSD of motion under the slope of a window over that of the motion, in Hz².

    ``sum (dw/dt)² / (4 pi² sum w²)``, including the jumps at both ends.

    Parameters
    ----------
    window : float64, shape (length,)
    sampling_rate : float
        Hz.
    """
    steps = np.diff(window, prepend=0.0, append=0.0) * sampling_rate
    return float(steps @ steps / (4 * np.pi**2 * (window @ window)))


def scatter_of_slopes(window: FloatArray, sampling_rate: float) -> float:
    """Return the leakage that the noise of one average feigns, as a share of the noise.

    Both predictions of a channel have its own noise in common, so the product of their slopes has a
    mean of ``slope_factor 2 (1 - ρ²) / (2 / T)²`` over the number of averages, with the correlation
    ρ of spectra two bins apart. It is 0.16 for a Hann window, and 25 for a rectangular one of 1000
    samples, whose slope is two jumps.

    Parameters
    ----------
    window : float64, shape (length,)
    sampling_rate : float
        Hz.
    """
    power = window**2
    turn = np.exp(4j * np.pi * np.arange(len(window)) / len(window))
    rho = abs(power @ turn) / power.sum()
    width = 2 * sampling_rate / len(window)
    return float(slope_factor(window, sampling_rate) * 2 * (1 - rho**2) / width**2)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelResponses:
    """Responses of every channel relative to each other sensor.

    Attributes
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    ratio : complex128, shape (n_freqs, n_channels, n_sensors)
        D: response of the channel over that of the sensor's channels in its direction, up to a
        constant factor. NaN for the channel's own sensor and for sensors that cannot predict it.
    coherence : float64, shape (n_freqs, n_channels, n_sensors)
        Magnitude squared coherence of the channel and its prediction.
    """

    frequency: FloatArray
    ratio: ComplexArray
    coherence: FloatArray

    def slopes(self) -> ComplexArray:
        """Return ``D' / D`` per Hz, by central differences, with the shape of `ratio`.

        ``D'`` of the first known frequency is that of the next.
        """
        f, ratio = self.frequency, self.ratio
        slopes = np.full_like(ratio, np.nan)
        slopes[1:-1] = (ratio[2:] - ratio[:-2]) / (f[2:] - f[:-2])[:, None, None]
        slopes[:-1] = np.where(np.isnan(slopes[:-1]), slopes[1:], slopes[:-1])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(slopes / ratio)

    def leakage(
        self, motion_psd: FloatArray, factor: float, *, n_effective: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the leakage into the noise of every channel, and its standard deviation.

        Parameters
        ----------
        motion_psd : float64, shape (n_freqs, n_channels)
            PSD of the motion in each channel.
        factor : float
            `slope_factor` of the window.
        n_effective : float

        Returns
        -------
        leakage, deviation : float64, shape (n_freqs, n_channels)
            Excess PSD of estimates by triads of sensors; 0 if unknown.

        Notes
        -----
        ``factor Re[(D_cj'/D_cj) conj(D_ck'/D_ck)] P_c``, averaged over the pairs of sensors j, k:
        the product of the errors of the two predictions of channel c in a triad. Their common noise
        is in it: `scatter_of_slopes`; the variance of ``D'/D`` is that of a ratio of
        averages, ``(1 / g - 1) / n`` at coherence g, at two frequencies.
        """
        pairs, deviation = np.empty((2, *self.ratio.shape[:2]))
        step = max(1, BLOCK_BYTES // (16 * self.ratio.shape[0] * self.ratio.shape[2]))
        for low in range(0, self.ratio.shape[1], step):
            some = slice(low, low + step)
            part = ChannelResponses(self.frequency, self.ratio[:, some], self.coherence[:, some])
            pairs[:, some], deviation[:, some] = part._of_pairs(n_effective)
        power = np.where(np.isfinite(motion_psd), np.maximum(motion_psd, 0.0), 0.0) * factor
        return np.asarray(power * pairs), np.asarray(power * deviation)

    def leakage_from_afar(
        self,
        motion_psd: FloatArray,
        window: FloatArray,
        sampling_rate: float,
        *,
        n_effective: float,
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return `leakage` under a window that jumps at its ends, and its standard deviation.

        And where most of a line is leakage. Motion then leaks from all frequencies, and slopes do
        not tell by how much responses differ there. Between the lines of the spectrum responses are
        interpolated.

        Parameters
        ----------
        motion_psd : float64, shape (n_freqs, n_channels)
        window : float64, shape (length,)
            `frequency` are lines of its spectrum.
        sampling_rate : float
            Hz.
        n_effective : float

        Returns
        -------
        leakage, deviation : float64, shape (n_freqs, n_channels)
            Without what the noise of the averages feigns.
        hidden : bool, shape (n_freqs, n_channels)
            Lines of which most has leaked from others: their own response is not seen.

        Notes
        -----
        With K the power of the window's transform, P the PSD of the motion in channel c and
        ``g_j = 1 / D_cj``, the averages are ``S_jk = K * (P g_j conj(g_k))``, of c with g = 1. The
        three-sensor formula leaves ``Re[S_cc - S_ck S_jc / S_jk]``.
        """
        length = len(window)
        lags = np.fft.irfft(np.abs(np.fft.rfft(window, 2 * length)) ** 2, 2 * length)
        lines = np.rint(self.frequency * length / sampling_rate).astype(int)
        halves = np.arange(length + 1) / 2

        def averaged(density: ComplexArray) -> ComplexArray:
            flat = density.reshape(-1, len(lines))
            between = np.array([np.interp(halves, lines, each) for each in flat])
            course = np.fft.irfft(between, 2 * length) * lags / lags[0]
            return np.asarray(np.fft.rfft(course)[:, 2 * lines].reshape(density.shape))

        leakage, feigned = np.zeros((2, *motion_psd.shape))
        hidden = np.zeros(motion_psd.shape, np.bool_)
        for channel, found in enumerate(np.nan_to_num(motion_psd).T):
            sensors = np.flatnonzero((self.coherence[:, channel] > MIN_COHERENCE).any(axis=0))
            if len(sensors) < 2:
                continue
            with np.errstate(invalid="ignore", divide="ignore"):
                g = 1 / self.ratio[:, channel, sensors].T
            known = self.coherence[:, channel, sensors].T
            usable = np.isfinite(g).all(axis=0) & (known > MIN_COHERENCE).all(axis=0) & (found > 0)
            power, g = np.where(usable, found, 0.0), np.where(usable, g, 0.0)
            error = np.sqrt((1 / np.where(usable, known, 1.0) - 1) / n_effective)
            # responses and power without what has leaked to a line from others
            own, crossed = (2 * each - averaged(each) for each in (power, power * g.conj()))
            there = own.real > _LEAST_OWN * power
            hidden[:, channel] = usable & (own.real < _MOST_LEAKED * power)
            own = np.where(there, own.real, 0.0)
            g = np.where(there, crossed.conj() / np.where(there, own, 1.0), 0.0)
            error *= np.where(there, power / np.where(there, own, 1.0), 1.0)
            whole, by = averaged(own), averaged(own * g.conj())
            pairs = [(j, (j + 1) % len(g)) for j in range(len(g) if len(g) > 2 else 1)]
            for j, k in pairs:
                between = averaged(own * g[j] * g[k].conj())
                with np.errstate(invalid="ignore", divide="ignore"):
                    left = (whole - by[k] * by[j].conj() / between).real
                leakage[:, channel] += np.nan_to_num(left) / len(pairs)
                feigned[:, channel] += _FEIGNED * power * error[j] * error[k] / len(pairs)
        return leakage - feigned, 2 * feigned, hidden

    def _of_pairs(self, n_effective: float) -> tuple[FloatArray, FloatArray]:
        """Return the mean of products of slopes over pairs of sensors, and its deviation."""
        slopes, f = self.slopes(), self.frequency
        variance = np.full(slopes.shape, np.inf)
        width = (f[2:] - f[:-2])[:, None, None]
        with np.errstate(divide="ignore"):
            own = (1 / self.coherence - 1) / max(n_effective, 1.0)
        own[self.coherence < MIN_COHERENCE] = np.inf
        variance[1:-1] = _TWO_FREQUENCIES * (own[2:] + own[:-2]) / 2 / width**2
        first = np.isnan(self.ratio[:-3])  # its slope is that of the next
        variance[1:-2] = np.where(first, variance[2:-1], variance[1:-2])
        known = np.isfinite(slopes) & np.isfinite(variance)
        slopes, variance = np.where(known, slopes, 0.0), np.where(known, variance, 0.0)
        n_known = known.sum(axis=2)
        count = np.maximum(n_known * (n_known - 1) // 2, 1)
        # sums over pairs: the square of the sum, less the squares
        total = (np.abs(slopes.sum(axis=2)) ** 2 - (np.abs(slopes) ** 2).sum(axis=2)) / 2
        deviation = (np.sqrt(variance).sum(axis=2) ** 2 - variance.sum(axis=2)) / 2
        deviation = np.maximum(deviation, 0.0)
        return np.asarray(total / count), np.asarray(deviation / count)


def band_shares(
    leakage: FloatArray, deviation: FloatArray, noise_psd: FloatArray, frequency: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return leakage over noise in third-octave bands, at each frequency of the bands.

    Parameters
    ----------
    leakage, deviation, noise_psd : float64, shape (n_freqs, n_channels)
        As from `ChannelResponses.leakage`.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.

    Returns
    -------
    share, deviation : float64, shape (n_freqs, n_channels)
        0 if the noise is unknown.
    """
    number = bands(frequency)
    known = np.isfinite(leakage) & np.isfinite(noise_psd)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    noise = np.add.reduceat(np.where(known, noise_psd, 0.0), starts)
    total = np.add.reduceat(np.where(known, leakage, 0.0), starts)
    squares = np.add.reduceat(np.where(known, deviation**2, 0.0), starts)
    scale = np.where(noise > 0, 1 / np.where(noise > 0, noise, 1.0), 0.0)
    return (total * scale)[number], (np.sqrt(_CORRELATED * squares) * scale)[number]


def channel_responses(
    csm: ComplexArray, frequency: FloatArray, *, dims: tuple[int, ...]
) -> ChannelResponses:
    """Return the responses of every channel relative to each other sensor.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Channels of each sensor.

    Returns
    -------
    ChannelResponses
    """
    check_dims(dims)
    n_freqs, n_channels = csm.shape[:2]
    n_sensors = len(dims)
    usable = np.isfinite(csm).all(axis=(1, 2)) & (frequency > 0)
    csm = np.where(usable[:, None, None], csm, 0.0)
    own = [np.array(own_channels(dims, sensor)) for sensor in range(n_sensors)]
    ratio = np.full((n_freqs, n_channels, n_sensors), np.nan, dtype=np.complex128)
    coherence = np.zeros((n_freqs, n_channels, n_sensors))
    combined = _directions(csm, dims, own)
    thirds = np.flatnonzero(combined.any(axis=(0, 2)))
    thirds = thirds[:: -(-len(thirds) // _MAX_THIRDS) or 1]
    around = combined.any(axis=2)
    around &= (around.sum(axis=1) > 1)[:, None]
    at, d = np.arange(len(thirds)), max(dims)
    by = combined.swapaxes(0, 1)
    by_two = by[:, None, :, :, None] * by[thirds, :, None]
    by_own = (by[:, :, :, None] * by[:, :, None]).reshape(n_sensors, n_channels, d * d)
    for some in blocks(n_freqs, n_channels):
        padded, place = _padded(csm[some], dims)
        shape = n_sensors, len(thirds), d * d, len(padded)
        towards = np.ascontiguousarray(padded[:, :, :, thirds].transpose(1, 3, 2, 4, 0))
        within = np.einsum("fjdje->jdef", padded).real.reshape(n_sensors, d * d, -1)
        # by sensor, the third, channel and frequency: few terms each, unlike whole matrices
        flat = by_two.reshape(*shape[:2], n_channels, d * d)
        among = (flat @ towards.reshape(shape).view(np.float64)).view(np.complex128)
        among[thirds, at] = 0.0  # the third is another
        rows = padded.reshape(len(padded), -1, n_sensors, d)[:, place]
        crossed = (rows * combined).sum(axis=3).transpose(2, 1, 0)
        power = np.maximum(np.einsum("fcc->cf", csm[some]).real, 0.0)
        own_power = by_own @ within
        with np.errstate(invalid="ignore", divide="ignore"):
            inverse = np.where(own_power > 0, 1 / own_power, 0.0)[thirds]
            sizes = np.einsum("jtcf,tcf->jcf", among.real**2 + among.imag**2, inverse)
            mean = np.einsum("jtcf,tcf->jcf", among.conj(), crossed[thirds] * inverse) / sizes
            found = np.abs(crossed) ** 2 / (power * own_power)
        known = usable[some, None, None] & around & (sizes != 0).transpose(2, 1, 0)
        ratio[some] = np.where(known, mean.transpose(2, 1, 0), np.nan)
        found = np.where(np.isfinite(found), np.clip(found, 0.0, 1.0), 0.0)
        coherence[some] = np.where(around, found.transpose(2, 1, 0), 0.0)
    return ChannelResponses(frequency, ratio, coherence)


def _padded(csm: ComplexArray, dims: tuple[int, ...]) -> tuple[ComplexArray, IntArray]:
    """Return matrices, (n_freqs, n_sensors, d, n_sensors, d), in which all sensors have d channels.

    And the places of the channels: those of smaller sensors are followed by some without power.
    """
    n_sensors, d = len(dims), max(dims)
    place = np.concatenate([j * d + np.arange(n) for j, n in enumerate(dims)])
    if min(dims) < d:
        padded = np.zeros((len(csm), n_sensors * d, n_sensors * d), np.complex128)
        padded[:, place[:, None], place] = csm
        csm = padded
    return csm.reshape(len(csm), n_sensors, d, n_sensors, d), place


def _directions(csm: ComplexArray, dims: tuple[int, ...], own: list[np.ndarray]) -> FloatArray:
    """Return the real combinations of a sensor's channels that predict a channel, up to a factor.

    By each sensor, of as many channels as the largest has: zero for the others. Shape (n_channels,
    n_sensors, max(dims)).

    This is the main direction of the rows ``S_ck S_jk^-1`` of the relative response over all
    frequencies, weighted by signal-to-noise ratio; complex factors do not change it.
    """
    power = np.einsum("fpp->fp", csm).real
    alive = (power > 0).all(axis=1)
    some = np.flatnonzero(alive)
    some = some[:: -(-len(some) // _MAX_FREQUENCIES) or 1]
    sensor = np.repeat(np.arange(len(dims)), dims)
    moments = [np.zeros((len(sensor), d, d)) for d in dims]
    seen = np.zeros((len(sensor), len(dims)), np.bool_)
    for block in blocks(len(some), len(sensor)):
        for j, (moment, weighted) in enumerate(_moments(csm[some[block]], dims, own)):
            moments[j] += moment
            seen[:, j] |= weighted
    found = np.zeros((len(sensor), len(dims), max(dims)))
    for j, moment in enumerate(moments):
        enough = (sensor != j) & (len(sensor) - np.array(dims)[sensor] - dims[j] >= dims[j])
        some = np.flatnonzero(enough & seen[:, j])
        found[some, j, : dims[j]] = np.linalg.eigh(moment[some])[1][:, :, -1]
    return found


def _moments(
    csm: ComplexArray, dims: tuple[int, ...], own: list[np.ndarray]
) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Yield second moments of the rows ``S_ck S_jk^-1`` for each sensor j, and where any counts.

    Shapes (n_channels, d, d) and (n_channels,); summed over the frequencies.
    """
    scale = np.sqrt(np.einsum("fpp->fp", csm).real)
    part = csm / (scale[:, :, None] * scale[:, None, :])
    sensor = np.repeat(np.arange(len(dims)), dims)
    starts = np.cumsum([0, *dims[:-1]])
    alike = sensor[:, None] == sensor
    # S S*, less what the channels' own sensors contribute, by row
    whole = part @ part
    products = whole - np.where(alike, part, 0.0) @ part
    for j, of_j in enumerate(own):
        towards, within = part[:, of_j], part[:, of_j[:, None], of_j]
        shares = towards[:, :, None] * towards[:, None].conj()  # by channel, last
        normal = whole[:, of_j[:, None], of_j] - within @ within
        normal = normal[..., None] - np.add.reduceat(shares, starts, axis=3)
        normal = np.moveaxis(normal, 3, 1)  # S_jk S_jk*, without each sensor i
        ridge = _RIDGE * np.trace(normal, axis1=2, axis2=3).real / dims[j] + 1e-300
        normal += ridge[..., None, None] * np.eye(dims[j])
        cross = products[:, :, of_j] - part[:, :, of_j] @ within  # S_ck S_jk*
        normal[:, j] = np.eye(dims[j])
        # in units of the channels' own amplitudes
        rows = (cross[:, :, None] @ np.linalg.inv(normal)[:, sensor])[:, :, 0]
        predicted = ((rows @ within) * rows.conj()).sum(axis=2).real
        with np.errstate(invalid="ignore", divide="ignore"):
            crossed = (rows * towards.swapaxes(1, 2)).sum(axis=2)
            g = np.clip(np.abs(crossed) ** 2 / predicted, 0.0, 1 - 1e-9)
        g = np.where(np.isfinite(g) & (g > MIN_COHERENCE), g, 0.0)
        rows = rows * scale[:, :, None] / scale[:, None, of_j]
        size = (rows.real**2 + rows.imag**2).sum(axis=2)
        weight = g / (1 - g) / np.where(size > 0, size, np.inf)
        moment = np.einsum("fc,fcj,fck->cjk", weight, rows, rows.conj()).real
        yield moment, weight.any(axis=0)
