"""Whether what others do not predict of a channel depends on its motion at the same instant.

Own noise knows nothing of the motion. What a hysteresis, the steps of a converter or a limited
speed leave has a mean that is a curve of the motion, or of its steps. What instants of samples that
vary leave is ``tau(t) x'(t)``, what a gain that varies leaves is ``g(t) x(t)``, however fast or
seldom: their mean is 0, but their square follows that of the slope or of the motion, instant by
instant, where averages of segments show noise.

Residuals are those of spectra of segments, with unit power at all frequencies up to an end. These
tests compare segments with each other, so that no distribution of the noise is assumed. Evidence
is in standard deviations of a normal variable. Single samples that hold most of the noise are
spikes: no motion is needed for these.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimator.blocks import blocks
from estimator.median import median
from estimator.records import dataclass
from estimator.types import ComplexArray, FloatArray, IntArray

Samples: TypeAlias = NDArray[np.floating[Any]]
Form: TypeAlias = Literal["curve", "product", "gain", "instants", "filled", "spikes"]
"""Of what depends on the motion; "product": as that of two channels of a sensor; "filled": what is
there where motion, or its slope, is small. Or "spikes": in single samples, as late or lost ones."""
_Tested: TypeAlias = tuple[Form, float, FloatArray, FloatArray]
"""Form, evidence from which it is certain, evidence and share, both of shape (n_channels,)."""
WIDTH = 4.0
"""Highest frequency of a band over that of the next."""
LEAST_BINS = 26
"""Least frequencies of a band."""
NOT_WEAK = 4.0
"""Power of what others predict of a channel over what they do not, in a band, from which it is
compared."""
BENT = 3.0
"""Share of the noise that is a curve or a product, over that of noise in what others predict: it
bends a curve of what is predicted, where motion is weak or in bursts."""
CERTAIN = 5.0
"""Evidence from which a channel depends on its motion."""
BURSTS = 0.7
"""By which evidence of little play counts less: what leaks at edges of bursts looks like it."""
SELDOM, STRONG = 3.5, 100.0
"""Residual over its usual standard deviation, from which it is seldom so large; and power of motion
over noise from which its sign is compared: weaker motion is predicted too small between spikes."""
FEW = 4.0
"""Evidence from which a channel depends on its motion in what is tested in one band alone: where
its noise is seldom so large, and where two frequencies of the motion make a third."""
PART = 0.4
"""Power that depends on the motion, over the most of any channel, from which a channel is named:
a third sensor has a quarter of it in what others leave of it."""
RARE, SPIKES = 0.003, 0.5
"""Share of the samples with so much of the noise that these are spikes."""
TOGETHER = 0.92
"""Evidence of all channels of a sensor, over what it were of independent ones."""
LASTS = 9
"""Samples over which the power of motion is averaged, too: a rattle lasts."""
PIECE = 24
"""Samples of a piece, of 2 to 2.5 for each wave of the highest frequency of a band."""
MUCH, WITHIN_BAND = 0.05, 4.0
"""Share of the residual from which all of it may depend on the motion; below, that at a frequency
over the mean of a band, at most."""
_LEAST = float(np.finfo(np.float32).tiny)
_CELLS = 48  # of a curve, an eighth of a standard deviation wide


@dataclass(frozen=True, slots=True)
class Dependence:
    """A channel whose noise depends on its motion, in a band.

    Attributes
    ----------
    channel : int
    band : tuple of (float, float)
        Hz.
    form : Form
    evidence : float
    size : float
        Standard deviation of the instants in seconds, or of the gain; 0 of other forms.
    explained : float64, shape (n_freqs,)
        Power spectrum that may depend on the motion, in this band or another: four times what
        these gains or instants leave, or what other sensors do not predict.
    power : float
        Power that depends on the motion over that of the channel.
    """

    channel: int
    band: tuple[float, float]
    form: Form
    evidence: float
    size: float
    explained: FloatArray
    power: float


def dependences(
    spectra: NDArray[np.complexfloating],
    means: FloatArray,
    frequency: FloatArray,
    window: FloatArray,
    sensor: IntArray,
    *,
    highest: float,
    most_predictors: int,
    past: FloatArray | None = None,
) -> list[Dependence]:
    """Return where channels depend on their motion, the clearest first.

    Parameters
    ----------
    spectra : complex, shape (n_segments, n_channels, n_freqs)
        Of segments without their means, times `window`, at all frequencies of the transform.
    means : float64, shape (n_segments, n_channels)
    frequency : float64, shape (n_freqs,)
        Hz.
    window : float64, shape (segment_length,)
    sensor : int64, shape (n_channels,)
        Sensor of each channel.
    highest : float
        Frequency in Hz up to which spectra are known.
    most_predictors : int
    past : float64, shape (n_segments, n_channels), optional
        Seconds from the samples of channels to those of segments, interpolated between them.
    """
    found: list[Dependence] = []
    rest = _residuals(spectra, sensor, most_predictors)
    if rest is None:
        return found
    for own in _channels(sensor):
        # what others predict: own noise in it would follow itself, where it is in gusts
        left = rest[own]
        motion = np.ascontiguousarray(spectra[:, own].transpose(1, 0, 2)) - left
        if past is not None:  # a converter bends what it samples, at these instants
            turn = np.exp(-2j * np.pi * past[:, own[0], None] * frequency).astype(np.complex64)
            motion, left = turn * motion, turn * left
        of_sensor = _Sensor(motion, left, means[:, own].T, frequency, window)
        bands = list(_bands(frequency, highest))
        for band in bands:
            clear = of_sensor.clearest(
                band, is_highest=band is bands[0], is_lowest=band is bands[-1]
            )
            found += [replace(one, channel=int(own[one.channel])) for one in clear]
    most = {each.band: 0.0 for each in found}
    for one in found:
        most[one.band] = max(most[one.band], one.power)
    found = [each for each in found if each.power > PART * most[each.band]]
    return sorted(found, key=lambda each: -each.evidence)


def _channels(sensor: IntArray) -> list[IntArray]:
    """Return the channels of each sensor."""
    return [np.flatnonzero(sensor == each) for each in range(int(sensor.max()) + 1)]


def _residuals(
    spectra: NDArray[np.complexfloating], sensor: IntArray, most_predictors: int
) -> NDArray[np.complex64] | None:
    """Return what other sensors leave of every channel, shape (n_channels, n_segments, n_freqs).

    Where all others predict, these are columns of the inverse of R, ``spectra = Q R``, for all
    sensors at once. None unless half of the segments or more are left to tell noise from what is
    explained.
    """
    n_segments, n, n_freqs = spectra.shape
    owns = _channels(sensor)
    of_all = n - min(map(len, owns))
    if 2 * min(of_all, most_predictors) > n_segments:
        return None
    found = np.empty((n, n_segments, n_freqs), np.complex64)
    for some in blocks(n_freqs, max(n, n_segments)):
        part = spectra[:, :, some].transpose(2, 0, 1).astype(np.complex128)
        if of_all > most_predictors:
            for own in owns:
                others = np.flatnonzero(sensor != sensor[own[0]])[:most_predictors]
                left = without(part[:, :, others], part[:, :, own])
                found[own, :, some] = left.transpose(2, 1, 0)
            continue
        q, r = np.linalg.qr(part)
        size = np.maximum(np.abs(np.einsum("fii->f", r)), _LEAST)
        inverse = np.linalg.inv(r + 1e-15 * size[:, None, None] * np.eye(n)).conj().swapaxes(1, 2)
        for own in owns:
            columns = inverse[..., own]
            left = q @ (columns @ np.linalg.inv(columns.conj().swapaxes(1, 2) @ columns))
            found[own, :, some] = left.transpose(2, 1, 0)
    return found


def without(predictors: ComplexArray, wanted: ComplexArray) -> ComplexArray:
    """Return what predictors leave of spectra, both (n_freqs, n_segments, n)."""
    basis, _ = np.linalg.qr(predictors)
    return np.asarray(wanted - basis @ (basis.conj().swapaxes(1, 2) @ wanted))


def _bands(frequency: FloatArray, highest: float) -> Iterator[slice]:
    """Yield the frequencies of the bands, the highest first."""
    high = int(np.searchsorted(frequency, highest))
    while high > LEAST_BINS:
        yield slice(2, high)
        high = int(high / WIDTH)


@dataclass(frozen=True, slots=True, eq=False)
class _Sensor:
    """Spectra of the channels of a sensor, and what others do not predict of them.

    Attributes
    ----------
    motion, rest : complex64, shape (n_channels, n_segments, n_freqs)
    means : float64, shape (n_channels, n_segments)
    frequency : float64, shape (n_freqs,)
    window : float64, shape (segment_length,)
    """

    motion: NDArray[np.complex64]
    rest: NDArray[np.complex64]
    means: FloatArray
    frequency: FloatArray
    window: FloatArray

    def clearest(self, own: slice, *, is_highest: bool, is_lowest: bool) -> Iterator[Dependence]:
        """Yield what is clearest in a band of each channel, if it is clear."""
        felt, left = (np.mean(np.abs(e) ** 2, axis=1) for e in (self.motion, self.rest))
        there = left[:, own].sum(axis=1) / np.maximum(felt[:, own].sum(axis=1), _LEAST)
        tested = np.flatnonzero((left[:, own] > 0).all(axis=1) & (there < 1 / NOT_WEAK))
        if not len(tested):
            return
        turn = (2j * np.pi * self.frequency).astype(np.complex64)
        rest = self.rest[tested] / np.sqrt(np.maximum(left[tested, None], _LEAST))
        motion, course = self.motion[tested], _Courses(self.window, own.stop)
        everything = slice(1, None) if is_highest else own
        x, slope = (course(each, everything) for each in (motion, turn * motion))
        r = _left(course(rest, own), x, course.edges * x, course.edges * slope)
        squares = x**2, slope**2
        slopes = np.abs(turn[own]) ** 2
        of_slope = left[tested, own] @ slopes / np.maximum(felt[tested, own] @ slopes, _LEAST)
        ratios = there[tested], of_slope
        bent = [BENT * _bent(*each) for each in zip(ratios, squares, strict=True)]
        whole = (
            course(motion, slice(0, everything.stop)) + course.scale * self.means[tested, :, None]
        )
        by_product, of_product, factors = _clearest_product(r, x, bent[0])
        found: list[_Tested] = [
            ("gain", CERTAIN, *_of_loudness(r, squares[0])),
            ("instants", CERTAIN, *_of_instants(r, squares[1])),
            ("product", CERTAIN, by_product, of_product),
            ("curve", CERTAIN, *_clearest_curve(r, whole, bent)),
        ]
        if is_highest:
            found += [_of_spikes(r), ("gain", FEW, *_seldom(r, x, there[tested]))]
        if is_lowest:
            found.append(("curve", FEW, *_coupled(rest, motion, min(own.stop, LEAST_BINS + 2))))
        forms, limits, *values = zip(*found, strict=True)
        limit, (evidence, shares) = np.array(limits), np.array(values)
        certain = np.abs(evidence) / limit[:, None]
        certain[np.ix_(limit == FEW, (certain[limit != FEW] >= 1).any(axis=0))] = 0.0
        for place, best in enumerate(certain.argmax(axis=0).tolist()):
            channel, share, form, size = int(tested[place]), shares[best, place], forms[best], 0.0
            # what predictors explain by chance lacks where motion is large, in long waves
            if certain[best, place] < 1 or (share < 0 and not is_highest):
                continue
            most = WITHIN_BAND * left[channel]
            if share < 0:
                form = "filled"
            elif form in {"gain", "instants"}:
                scale = np.mean(squares[0][place]) / np.mean(squares[form == "instants"][place])
                size = float(np.sqrt(share * there[channel] * scale))
            share = min(abs(share), 1.0)
            if (
                form == "curve" and limit[best] == FEW
            ):  # sums of frequencies up to the highest of the band
                most = np.where(np.arange(len(most)) < 2 * own.stop, most, 0.0)
            elif form == "product" and factors[0] is factors[1]:
                form = "curve"  # a part of what bends: the square of its integral, say
            elif form == "product":
                alike = course.power(factors[0] * factors[1]) / np.maximum(left[channel], _LEAST)
                alike *= share / max(float(alike[own].mean()), _LEAST)
                most = WITHIN_BAND * np.fmin(alike, 1.0) * left[channel]
            elif size and share < MUCH:
                alike = felt[channel] * size**2 * (1.0 if form == "gain" else np.abs(turn) ** 2)
                alike = np.maximum(share * left[channel, own].mean(), alike)
                most = np.minimum(WITHIN_BAND * alike, most)
            yield Dependence(
                channel=channel,
                band=(float(self.frequency[own.start]), float(self.frequency[own.stop - 1])),
                form=form,
                evidence=float(abs(evidence[best, place])),
                size=size,
                explained=most.astype(np.float64),
                power=min(float(np.abs(shares[certain[:, place] >= 1, place]).max()), 1.0)
                * float(there[channel]),
            )


class _Courses:
    """Courses of time of spectra of segments, up to the end of a band, without their windows.

    Attributes
    ----------
    edges : float32, shape (n_samples,)
        Slope of the window over it.
    scale : float
        Of courses, over that of the samples.
    """

    def __init__(self, window: FloatArray, stop: int) -> None:
        self._n = n = min(32 * (int(2.5 * stop) // 32 + 1), len(window))
        self._middle, self._n_freqs = slice(n // 4, n - n // 4), len(window) // 2 + 1
        self.scale = len(window) / n
        at = np.arange(n)[self._middle] * self.scale
        self._window = np.interp(at, np.arange(len(window)), window).astype(np.float32)
        self.edges = np.gradient(self._window) / self._window

    def __call__(self, spectra: NDArray[np.complex64], some: slice) -> Samples:
        """Return the middle half of segments, from some of the frequencies."""
        padded = np.zeros_like(spectra[..., : some.stop])
        padded[..., some] = spectra[..., some]
        return np.asarray(np.fft.irfft(padded, self._n)[..., self._middle] / self._window)

    def power(self, course: Samples) -> FloatArray:
        """Return the mean power of courses, (n_segments, n_samples), at the frequencies."""
        spectrum = np.mean(np.abs(np.fft.rfft(course - course.mean(axis=1, keepdims=True))) ** 2, 0)
        at = np.arange(self._n_freqs) * (course.shape[1] / self._n)
        return np.asarray(np.interp(at, np.arange(len(spectrum)), spectrum, right=0.0))


def _left(r: Samples, motion: Samples, *edges: Samples) -> Samples:
    """Return residuals without what the edges of windows let through of linear responses.

    Noise is in the motion, too, and has something in common with that of one segment: the rest is
    without that.
    """
    gram = np.einsum("acst,bcst->cab", edges, edges)
    along = np.einsum("acst,cst->ca", edges, r)
    much = (np.linalg.pinv(gram, hermitian=True) @ along[..., None])[..., 0]
    r = r - np.einsum("acst,ca->cst", edges, much)
    return _beside(r, motion)


def _beside(r: Samples, x: Samples) -> Samples:
    """Return what x leaves of r in each segment."""
    size = np.einsum("cst,cst->cs", x, x)
    common = np.einsum("cst,cst->cs", r, x) / np.maximum(size, _LEAST)
    return np.asarray(r - common[..., None] * x)


def _evidence(along: FloatArray) -> FloatArray:
    """Return how far the mean over segments, (n_channels, n_segments), is from 0 (Student)."""
    n = along.shape[1]
    t = along.mean(axis=1) / np.maximum(along.std(axis=1, ddof=1), _LEAST) * np.sqrt(n)
    normal = np.sqrt((n - 1) * np.log1p(t**2 / (n - 1))) * (8 * n - 7) / (8 * n - 5)  # Wallace
    return np.asarray(np.copysign(normal, t))


def _of_spikes(r: Samples) -> _Tested:
    """Return the share of noise that is in few samples, shape (n_channels,), as evidence."""
    power = r.reshape(len(r), -1) ** 2
    few = max(1, round(RARE * power.shape[1]))
    highest = np.partition(power, power.shape[1] - few, axis=1)[:, -few:]
    share = highest.sum(axis=1) / np.maximum(power.sum(axis=1), _LEAST)
    return "spikes", CERTAIN, CERTAIN * share / SPIKES, share


def _bent(ratio: FloatArray, square: Samples) -> FloatArray:
    """Return the share of noise that motion with noise in it may bend, shape (n_channels,).

    Noise given what it is part of is a curve of that, where this has no normal distribution: at
    most, in every piece, `ratio` of its power to the mean of `square`, over that of the piece.
    """
    n_pieces = square.shape[2] // PIECE
    pieces = square[..., : n_pieces * PIECE].reshape(len(square), -1, PIECE).mean(axis=2)
    noise = ratio[:, None] * pieces.mean(axis=1, keepdims=True)
    return np.asarray(np.mean(np.fmin(noise / np.maximum(pieces, _LEAST), 1.0), axis=1))


def _of_loudness(r: Samples, square: Samples) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of noise whose power follows a square, or its mean around."""
    found = _of_square(r, square)
    if r.shape[2] < PIECE + LASTS:
        return found
    around = np.cumsum(square, axis=2)
    around = around[..., LASTS:] - around[..., :-LASTS]
    lasting = _of_square(r[..., LASTS // 2 + 1 : -(LASTS // 2)], around)
    lasts = lasting[0] > np.abs(found[0])
    return np.where(lasts, lasting[0], found[0]), np.where(lasts, lasting[1], found[1])


def _seldom(r: Samples, x: Samples, ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of seldom large noise with a sign of the motion, (n_channels,).

    As of a gain that is another one at times. Signs of pieces are as likely plus as minus where
    noise knows nothing of the motion, however it is distributed. But a spike of another sensor is
    in what is predicted, with the opposite sign, and one of its own in what is recorded. `ratio`:
    power of the noise over that of the motion.
    """
    usual = median(np.abs(r).reshape(len(r), -1).T)[:, None, None] / 0.6745
    large = np.where(np.abs(r) > SELDOM * usual, r, 0.0)
    x, unit = (
        each / np.sqrt(np.maximum(np.mean(each**2, axis=(1, 2), keepdims=True), _LEAST))
        for each in (x, r)
    )
    n_pieces, evidence = r.shape[2] // PIECE, []
    for sign, felt in ((1, x), (-1, x + np.sqrt(ratio)[:, None, None] * unit)):
        along = sign * np.sign(large) * np.clip(felt, -1, 1)
        pieces = along[..., : n_pieces * PIECE].reshape(len(r), -1, PIECE).sum(axis=2)
        scatter = np.sqrt(np.maximum(np.sum(pieces**2, axis=1), _LEAST))
        evidence.append(pieces.sum(axis=1) / scatter)
    share = np.sum(large**2, axis=(1, 2)) / np.maximum(np.sum(r**2, axis=(1, 2)), _LEAST)
    return np.where(ratio < 1 / STRONG, np.max(evidence, axis=0), 0.0), share


def _coupled(
    rest: NDArray[np.complex64], motion: NDArray[np.complex64], top: int
) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of noise at sums and differences of frequencies of the motion.

    A square of whatever follows from the motion, as a displacement does, at any distance in time.
    """
    x = motion[..., :top] / np.sqrt(
        np.maximum(np.mean(np.abs(motion[..., :top]) ** 2, axis=1, keepdims=True), _LEAST)
    )
    at = np.arange(2, top)
    first, second = (each.ravel() for each in np.meshgrid(np.arange(1, top), at, indexing="ij"))
    below = 2 * first <= second
    above = first + second < top
    sums = rest[..., second[below]].conj() * x[..., first[below]] * x[..., (second - first)[below]]
    sums[..., (2 * first == second)[below]] /= np.sqrt(2)  # of a square of one frequency
    differences = (
        rest[..., second[above]].conj()
        * x[..., (first + second)[above]]
        * x[..., first[above]].conj()
    )
    both = np.concatenate([sums, differences], axis=2)
    gram = (both @ both.conj().swapaxes(1, 2)).real
    evidence, more = _by_signs(np.asarray(gram, np.float64))
    return evidence, more / (rest.shape[1] ** 2 * len(at))


def _by_signs(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return evidence that the sum over segments is not 0, and its square beyond the expected one.

    By products of segments, (n_channels, n_segments, n_segments). Where signs of segments are as
    likely plus as minus, it has the mean and the variance below, and close to a chi-squared
    distribution.
    """
    own = np.einsum("css->cs", gram)
    total, expected = gram.sum(axis=(1, 2)), own.sum(axis=1)
    variance = 2 * (np.sum(gram**2, axis=(1, 2)) - np.sum(own**2, axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = variance / (9 * expected**2)  # of the cube root (Wilson and Hilferty)
        evidence = (np.cbrt(total / expected) - (1 - spread)) / np.sqrt(spread)
    return np.where(variance > 0, evidence, 0.0), np.maximum(total - expected, 0.0)


def _of_instants(r: Samples, square: Samples) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of noise whose power follows the square of the slope.

    All channels of a sensor are sampled at one instant; their residuals are not independent.
    """
    found, share = _of_square(r, square)
    return np.maximum(found, TOGETHER * found.sum() / np.sqrt(len(found))), share


def _clearest_curve(
    r: Samples, x: Samples, least: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of a curve of x or, as of play, of its steps: (n_channels,).

    Evidence of what explains all is no larger than that of less: of two that are certain, the
    curve is the one with the larger share.
    """
    steps = np.diff(x, axis=2)
    by_value, of_value = _clear(_curve(_beside(r, x), x), least[0])
    by_step, of_step = _clear(_curve(_beside(r[..., 1:], steps), steps), least[1])
    by_step = np.where(of_step > MUCH, by_step, BURSTS * by_step)
    certain = np.fmin(by_value, by_step) > CERTAIN
    stepwise = np.where(certain, of_step > of_value, by_step > by_value)
    found = np.where(stepwise, [by_step, of_step], [by_value, of_value])
    return found[0], found[1]


def _clearest_product(
    r: Samples, x: Samples, least: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[Samples, Samples]]:
    """Return evidence and share of a product of two channels, or a square, and its factors."""
    pairs = list(itertools.combinations_with_replacement(x, 2))
    found = [_clear(_of_product(r, first * second), least) for first, second in pairs]
    clearest = max(range(len(pairs)), key=lambda each: found[each][0].max())
    return *found[clearest], pairs[clearest]


def _clear(
    found: tuple[FloatArray, FloatArray], least: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share; no evidence where the share is below the least."""
    evidence, share = found
    return np.where(share > least, evidence, 0.0), share


def _of_product(r: Samples, product: Samples) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of noise that is as a product, shape (n_channels,)."""
    product = product - product.mean(axis=1, keepdims=True)
    size = np.sqrt(np.einsum("st,st->s", product, product))
    along = np.einsum("cst,st->cs", r, product / np.maximum(size, _LEAST)[:, None])
    power = np.einsum("cst,cst->c", r, r)
    return np.abs(_evidence(along)), along.mean(axis=1) ** 2 * len(size) / np.maximum(power, _LEAST)


def _of_square(r: Samples, square: Samples) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of noise whose power follows a square, shape (n_channels,).

    Both of shape (n_channels, n_segments, n_samples). Means of short pieces are taken off: loudness
    that noise and motion have in common is none that follows the motion at every instant.
    """
    n_pieces = r.shape[2] // PIECE
    shape = (*r.shape[:2], n_pieces, PIECE)
    power, square = (e[..., : n_pieces * PIECE].reshape(shape) for e in (r**2, square))
    of_noise, of_motion = (
        np.maximum(each.mean(axis=(2, 3), dtype=np.float64), _LEAST) for each in (power, square)
    )
    power, square = (each - each.mean(axis=3, keepdims=True) for each in (power, square))
    number = PIECE * n_pieces
    along = np.einsum("cspt,cspt->cs", power, square) / number / (of_noise * of_motion)
    spread = np.einsum("cspt,cspt->cs", square, square) / number / of_motion**2
    share = along.mean(axis=1) / np.maximum(spread.mean(axis=1), _LEAST)
    return _evidence(along), share


def _curve(r: Samples, x: Samples) -> tuple[FloatArray, FloatArray]:
    """Return evidence and share of noise with a mean that is a curve of x, shape (n_channels,).

    A straight line is none.
    """
    shape = n_channels, n, _ = r.shape
    x = x / np.sqrt(np.maximum(np.mean(x**2, axis=(1, 2), keepdims=True), _LEAST))
    cell = np.clip(8 * x + _CELLS / 2, 0, _CELLS - 1).astype(np.int64)
    cell += _CELLS * np.arange(n_channels * n).reshape(*shape[:2], 1)
    sizes = n_channels, n, _CELLS
    count, sums = (
        np.bincount(cell.ravel(), weights, n_channels * n * _CELLS).reshape(sizes)
        for weights in (None, r.ravel())
    )
    size = np.sqrt(count.sum(axis=1))
    used = size**2 > n
    scale = np.where(used, 1 / np.where(used, size, 1.0), 0.0)
    line = size * (np.arange(_CELLS) - (_CELLS - 1) / 2)
    basis, _ = np.linalg.qr(np.stack([size * used, line * used], axis=2))
    sums = sums * scale[:, None]
    sums -= (sums @ basis) @ basis.swapaxes(1, 2)
    evidence, more = _by_signs(np.asarray(sums @ sums.swapaxes(1, 2), np.float64))
    return evidence, more / np.sum(r**2, axis=(1, 2))
