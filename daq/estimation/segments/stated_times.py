"""Whether the times that devices or files state agree with the motion that the sensors share.

A digitizer without GPS, or whose receiver has lost it, states times that drift. The delays between
its sensors and others then drift as well. They are measured in pieces of the whole recording, and
their means over parts of it are compared with their scatter within the parts. That scatter is
measured, not predicted: waves that cross the bench in changing directions add to it.

Where the motion is weak, some delays are those of false peaks: up to 32 samples away, with small
predicted deviations. Delays far from the others of their part are left out, and so are parts with
one or two. Where many are false, nothing can be said.

Reading these pieces costs more than the estimate of an imported file. The spectra of single
segments that a pass keeps show in most recordings that nothing drifts (`agree`): one prediction for
the whole recording must hold in each of its parts, but for the delay that its noise explains. Only
where that cannot be said are pieces read. A drift that these spectra miss is less than twice their
error; with it, the noise is high by less than one part in the number of bins.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.delay_estimation import REFERENCES, DelayEstimator
from daq.clocks.quantiles import median
from daq.estimation.segments.delay_measurement import around_gaps
from daq.estimation.settings import Settings
from estimator.spectra.welch import SegmentSpectra, WelchSettings
from estimator.spectra.windows import get_window

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]
Delays = tuple[FloatArray, FloatArray, FloatArray]

_PIECES = 40  # lengths of a piece in the recording, at least where it is short
_LONGEST = 60.0  # s of a piece, where there are few gaps
_SHORTEST = 256  # samples of a piece
_SPREAD = 48  # pieces from the whole recording, besides the first ones
_VALUES_AT_ONCE = 1 << 20  # samples times channels: 8 MB
_MOST_VALUES = 1 << 22  # the same of the first pieces together: 32 MB
_TRIES = 4  # stretches that are searched for first pieces, which define the frame
_PARTS = 8
_DRIFTS = 60.0  # χ² of 7 degrees of freedom: 2e-10; the scatter is estimated
_OVERLAPS = 1.4  # variance of a mean of half overlapping pieces, against independent ones
_NORMAL = 1.4826  # standard deviation of normal values over the median of their magnitudes
_FALSE = 5.0  # scatters from the median of its part: a delay of a false peak
_MOST_FALSE = 0.1  # of the delays
_FEWEST = 3  # delays of a part: one or two may be false
_BLIND = 4.0  # samples of scatter within parts: most peaks are false. Drifts leave 3 at most
_SCATTERS = 3.0  # times the predicted scatter: the times of single blocks are wrong
_CLEARLY = 2.0  # times the scatter of all parts: that of one is known from a few delays
_GROWTH = 0.5  # of the stretch whose clocks are set, from one setting to the next
_STEP = 16  # pieces that are measured in between
_AGREE = 25.0  # χ² of 7 degrees of freedom: 8e-4. More is no news yet: pieces are measured then
_FOLLOWS = 0.5  # of the power of a prediction, that a part meets at least
_TURNED = 8.0  # standard deviations of the χ² of all phases: neighbouring frequencies depend
_COARSE = 0.05  # samples; standard error of a part: above, one phase may be that of two delays


def compare(aligned: AlignedRecording, settings: Settings, welch: WelchSettings) -> bool:
    """Compare stated UTC with the motion; return whether that of any sensor drifts.

    Clocks that drift are then set by the motion. Does nothing where fewer than two sensors state
    UTC, or clocks are not to be refined.

    Parameters
    ----------
    aligned : AlignedRecording
    settings : Settings
    welch : WelchSettings
        Of the segments.
    """
    sensors = aligned.stated
    if len(sensors) < 2 or not aligned.n_available or settings.clocks != "refined":
        return False
    longest = _LONGEST
    drift, reference = _drifts(aligned, welch, sensors, most=settings.bridge, longest=longest)
    unknown = sum(not math.isfinite(each) for each in drift.values())
    short = settings.segment
    first, last = aligned.common
    of_short = (last - first) / welch.sampling_rate / _PIECES
    if unknown and short < min(longest, of_short):  # gaps may leave nothing of long pieces
        found, against = _drifts(aligned, welch, sensors, most=settings.bridge, longest=short)
        if sum(not math.isfinite(each) for each in found.values()) < unknown:
            drift, reference, longest = found, against, short
    drifts = aligned.compare_stated(drift, reference)
    if drifts:
        _follow(aligned, welch, most=settings.bridge, longest=longest)
    if not aligned.distrust(followed=drifts):
        return drifts
    _follow(aligned, welch, most=settings.bridge, longest=longest)
    suspects = aligned.distrusted
    compared = (reference, *suspects)
    drift, _ = _drifts(aligned, welch, compared, most=settings.bridge, longest=longest)
    left = [n for n in suspects if not drift[n] < _COARSE / welch.sampling_rate]
    aligned.give_up(left)
    return drifts or len(left) < len(suspects)


def agree(
    aligned: AlignedRecording,
    single: SegmentSpectra,
    at: IntArray,
    welch: WelchSettings,
    *,
    n_effective: float,
) -> bool:
    """Return whether spectra of single segments show that no stated UTC drifts.

    False where they show a drift or cannot tell: weak motion, parts of the recording without
    segments, or times that are not those of a nominal rate, of which single ones may be wrong.

    Parameters
    ----------
    aligned : AlignedRecording
    single : SegmentSpectra
    at : int64, shape (n_segments,)
        Grid samples at which these segments begin.
    welch : WelchSettings
    n_effective : float
        Independent averages in all segments of the pass.
    """
    sensors = aligned.stated
    clocks = [aligned.clocks[n] for n in sensors]
    if any(map(aligned.stepped, sensors)) or any(each.ppm or each.wander_ppm for each in clocks):
        return False
    edges = np.cumsum([0, *aligned.dims])
    first, last = aligned.common
    part = np.clip((at - first) * _PARTS // max(last - first, 1), 0, _PARTS - 1)
    n_first = int(edges[sensors[0] + 1] - edges[sensors[0]])
    if np.bincount(part, minlength=_PARTS).min() < max(_FEWEST, n_first):
        return False
    spectra = single.values().astype(np.complex128).transpose(1, 0, 2)
    omega = 2 * np.pi * single.bins * welch.sampling_rate / welch.segment_length
    independent = min(1.0, n_effective / len(at))
    x0, *others = (spectra[:, :, edges[n] : edges[n + 1]] for n in sensors)
    for xj in others:
        crossed, energy, spurious = _met(x0, xj, part)
        info = 2 * independent * (omega**2 @ (energy - spurious))
        if not (info > (welch.sampling_rate / _COARSE) ** 2).all():
            return False
        followed, turned_by = crossed.real.sum(axis=0), crossed.imag
        if (followed < _FOLLOWS * (energy - spurious).sum(axis=0)).any():
            return False  # another motion in a part, or the same some segments later
        delays = 2 * independent * (omega @ turned_by) / info
        delays -= info @ delays / info.sum()
        # A jump by samples turns phases round, and their slope may be that of no delay.
        turned = 2 * independent * turned_by**2 / energy
        excess = turned.sum() - turned.size
        if not (info @ delays**2 < _AGREE and excess < _TURNED * math.sqrt(2 * turned.size)):
            return False
    return True


def _met(
    x0: ComplexArray, xj: ComplexArray, part: IntArray
) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return how a sensor's prediction in each part meets what was measured.

    Parameters
    ----------
    x0, xj : complex128, shape (n_freqs, n_segments, n_channels)
        Spectra of the reference and of the sensor.
    part : int64, shape (n_segments,)

    Returns
    -------
    crossed, energy : complex128 and float64, shape (n_freqs, n_parts)
        Products of the prediction and the spectra, and the power of the prediction, over the power
        that is not predicted.
    spurious : float64, shape (n_parts,)
        Of this power, the mean that noise adds to any prediction.
    """
    n = len(part)
    adjoint = x0.conj().transpose(0, 2, 1)
    # Least squares of xj on x0: P^T, for spectra in rows.
    predicted = x0 @ (np.linalg.pinv(adjoint @ x0, hermitian=True) @ (adjoint @ xj))
    power, left = (np.mean(each.real**2 + each.imag**2, axis=1) for each in (xj, xj - predicted))
    noise = np.maximum(left, 1e-12 * power)
    weight = np.where(noise > 0, 1.0, 0.0) / np.where(noise > 0, noise, 1.0)
    of_part = (part[:, None] == np.arange(_PARTS)).astype(np.float64)
    crossed = np.einsum("fp,fsp,fsp->fs", weight, xj.conj(), predicted) @ of_part
    energy = np.einsum("fp,fsp,fsp->fs", weight, predicted.conj(), predicted).real @ of_part
    return crossed, energy, x0.shape[2] * xj.shape[2] / n * of_part.sum(axis=0)


def _drifts(
    aligned: AlignedRecording,
    welch: WelchSettings,
    sensors: tuple[int, ...],
    *,
    most: float,
    longest: float,
) -> tuple[dict[int, float], int]:
    """Return `drift_of` sensors, and that against which, in pieces of `longest` s at most.

    Unless that is known, it is the sensor against which fewest drift: the one that is off itself
    drifts against all others.
    """
    pieces = _Pieces(aligned, welch, sensors, most=most, longest=longest)
    first = pieces.begin()
    found = pieces.spread(first) if first else []
    none = np.empty(0), np.empty((0, len(sensors))), np.empty((0, len(sensors)))
    at, delays, std = map(np.concatenate, zip(none, *found, strict=True))
    order = np.argsort(at)
    at, delays, std = at[order] / welch.sampling_rate, delays[order], std[order]
    duration = (pieces.end - pieces.start) / welch.sampling_rate

    def against(reference: int) -> dict[int, float]:
        drift = {}
        for column, number in enumerate(sensors):
            clock = aligned.clocks[number]
            drift[number] = drift_of(
                at,
                delays[:, column] - delays[:, reference],
                np.hypot(std[:, column], std[:, reference]),
                nominal=clock.ppm == clock.wander_ppm == 0,
                duration=duration,
                sampling_rate=welch.sampling_rate,
            )
            stepped = aligned.stepped(number)  # which of the times are right, the motion says
            if stepped and not math.isinf(drift[number]):
                drift[number] = float(np.fmax(drift[number], stepped))
        return drift | ({sensors[reference]: 0.0} if len(at) else {})

    def off(drift: dict[int, float]) -> int:
        return sum(each != 0 for each in drift.values())

    reference = int(np.argmax((std == 0).all(axis=0)))  # that they were measured against
    drift = against(reference)
    if off(drift) > 1 and aligned.stated_reference is None:
        others = {n: against(n) for n in range(len(sensors)) if n != reference}
        best = min(others, key=lambda n: off(others[n]))
        if off(others[best]) < off(drift):
            reference, drift = best, others[best]
    return drift, sensors[reference]


def drift_of(
    at: FloatArray,
    delays: FloatArray,
    std: FloatArray,
    *,
    nominal: bool,
    duration: float,
    sampling_rate: float,
) -> float:
    """Return by how much delays of a sensor drift over a recording, in s rms.

    0 where that is not more than they scatter, NaN where too few are known or too many are false.
    Infinite where the sensor does not follow a strong motion in a part of the recording: its times
    are off by more than can be measured, or it measures something else there.

    Parameters
    ----------
    at, delays, std : float64, shape (n,)
        When, the delays and their predicted standard deviations, in s. NaN: not the motion.
    nominal : bool
        Whether the times stated are those of the nominal rate. Of others single ones may be wrong
        too, which shows as scatter.
    duration : float
        Of the recording in s. Delays that drift far cannot be measured any more.
    sampling_rate : float
        Of the samples that the delays were measured from, in Hz.
    """
    known = np.isfinite(std) & (std > 0)
    if _is_elsewhere(at, np.isnan(std), known):
        return math.inf
    at, delays, std = at[known], delays[known], std[known]
    if len(at) < 2 * _PARTS:
        return math.nan
    n_parts = min(_PARTS, len(at) // _FEWEST)
    part = np.minimum((at - at[0]) / (at[-1] - at[0]) * n_parts, n_parts - 1).astype(np.int64)
    used = np.unique(part)
    middle = np.zeros(_PARTS)
    middle[used] = [median(delays[part == each]) for each in used]
    least = median(std)
    within = _NORMAL * median(np.abs(delays - middle[part]))
    within *= float(np.sqrt(len(at) / (len(at) - len(used))))
    if within * sampling_rate > _BLIND:
        return math.nan
    scatter = max(within, least)
    away = np.abs(delays - middle[part])
    spread = _scatter_of_parts(away, part, scatter, most=_COARSE / sampling_rate)
    false = away > _FALSE * np.maximum(spread[part], std)
    agrees = away <= _FALSE * spread[part]
    agrees &= np.bincount(part[agrees], minlength=_PARTS)[part] >= _FEWEST
    if np.mean(false) > _MOST_FALSE or np.count_nonzero(agrees) < 2 * n_parts:
        return math.nan
    at, delays, part = at[agrees], delays[agrees], part[agrees]
    own = _scatter_of_bends(delays, std[agrees], part)
    blind = own > max(_SCATTERS * scatter, _COARSE / sampling_rate)
    spread = np.where(own > _CLEARLY * scatter, np.maximum(spread, own), spread)
    n = np.bincount(part, minlength=_PARTS)
    means = np.bincount(part, delays, minlength=_PARTS) / np.maximum(n, 1)
    between = float(n @ (means - delays.mean()) ** 2)
    weight = n / spread**2
    chi_square = float(weight @ (means - weight @ means / weight.sum()) ** 2)
    drifts = chi_square > _DRIFTS * _OVERLAPS and between > len(at) * least**2
    if not drifts and (nominal or within <= _SCATTERS * least):
        return math.nan if blind.any() else 0.0
    slope = float(np.polyfit(at, delays, 1)[0])
    return max(abs(slope) * duration / math.sqrt(12), float(np.std(delays)))


def _scatter_of_parts(
    away: FloatArray, part: IntArray, scatter: float, *, most: float
) -> FloatArray:
    """Return the scatter in each part: the common one, or its own where that is clearly larger.

    Where samples are far out of step, less of a piece is common, and delays are less certain. What
    scatters by more than `most` is no such thing: it has false peaks.
    """
    found = np.full(_PARTS, scatter)
    for each in np.unique(part):
        own = _NORMAL * median(away[part == each])
        if own > _SCATTERS * scatter:
            found[each] = max(scatter, min(own, most))
    return found


def _scatter_of_bends(delays: FloatArray, std: FloatArray, part: IntArray) -> FloatArray:
    """Return the scatter in each part by how three pieces bend: drifts are smooth.

    Weak motion has more than is predicted.
    """
    found = np.zeros(_PARTS)
    for each in np.unique(part):
        own, bends = std[part == each], np.abs(np.diff(delays[part == each], n=2))
        if len(bends):
            predicted = np.sqrt(own[2:] ** 2 + 4 * own[1:-1] ** 2 + own[:-2] ** 2)
            found[each] = _NORMAL * median(bends / predicted) * median(own)
    return found


def _is_elsewhere(at: FloatArray, unmet: BoolArray, known: BoolArray) -> bool:
    """Whether most delays of a part of the recording are those of another motion."""
    if not unmet.any():
        return False
    part = np.minimum((at - at[0]) / (at[-1] - at[0]) * _PARTS, _PARTS - 1).astype(np.int64)
    n_unmet, n_known = (np.bincount(part, each, minlength=_PARTS) for each in (unmet, known))
    return bool(((n_unmet >= _FEWEST) & (n_unmet > n_known)).any())


class _Pieces:
    """Pieces of a recording, half overlapping, in which delays are measured.

    They are as long as the recording allows, so that weak motion does; segments are as long as
    those who estimate noise want them.
    """

    def __init__(
        self,
        aligned: AlignedRecording,
        welch: WelchSettings,
        sensors: tuple[int, ...],
        *,
        most: float,
        longest: float,
    ) -> None:
        self._aligned, self._most = aligned, most
        self.start, self.end = aligned.common
        edges = np.cumsum([0, *aligned.dims])
        self._columns = tuple(slice(int(edges[n]), int(edges[n + 1])) for n in sensors)
        self._n_channels = int(edges[-1])
        fewest = DelayEstimator(welch.sampling_rate, np.empty(0), self._columns).min_segments
        n_first = max(2 * fewest, 3 * _PARTS)
        length = min(
            (self.end - self.start) / _PIECES,
            longest * welch.sampling_rate,
            _MOST_VALUES / (n_first * self._n_channels),
        )
        self._welch = replace(welch, segment_length=max(round(length), _SHORTEST), overlap=0.5)
        hop, length = self._welch.hop, self._welch.segment_length
        self.total = max(0, (self.end - self.start - length) // hop + 1)
        self.first = np.arange(min(n_first, self.total))

    def begin(self) -> list[Delays]:
        """Measure the first pieces, where there is motion; return nothing if there is none."""
        n_first = len(self.first)
        for begin in np.linspace(0, self.total, _TRIES, endpoint=False).astype(np.int64).tolist():
            window = get_window(self._welch.window, self._welch.segment_length)
            fixed = self._aligned.stated_reference is not None
            self.meter = DelayEstimator(
                self._welch.sampling_rate,
                window,
                self._columns,
                1 if fixed else REFERENCES,
                hop=self._welch.hop,
                is_wide=True,
            )
            self.first = np.arange(begin, min(begin + n_first, self.total))
            found = self.measure(self.first, at_once=n_first)
            if any(np.isfinite(std).any(axis=0).sum() > 1 for _, _, std in found):
                return found  # one is the reference
        return []

    def spread(self, first: list[Delays]) -> list[Delays]:
        """Return delays of the first pieces and of others; more where motion is short."""
        found, measured, low, high = first, self.first, 0, self.total - 1
        while True:
            new = np.setdiff1d(np.linspace(low, high, _SPREAD).astype(np.int64), measured)
            found, measured = [*found, *self.measure(new)], np.union1d(measured, new)
            # one with a delay is the reference
            moving = [at[np.isfinite(std).sum(axis=1) > 1] for at, _, std in found]
            place = (np.concatenate(moving) - self.start) / self._welch.hop - 1
            if np.ptp(place) > (high - low) / 2 or not len(new):
                return found
            low, high = round(place.min()), round(place.max())

    def measure(self, numbers: IntArray, *, at_once: int = 0) -> list[Delays]:
        """Return grid positions, delays and their standard deviations of pieces that are usable."""
        found = []
        length = self._welch.segment_length
        at_once = at_once or max(1, _VALUES_AT_ONCE // (length * self._n_channels))
        for some in np.split(numbers, range(at_once, len(numbers), at_once)):
            parts = [self._piece(n) for n in some.tolist()]
            known = np.array([samples is not None for samples in parts], dtype=bool)
            kept = [samples for samples in parts if samples is not None]
            if kept:
                starts = np.arange(len(kept)) * length
                at = self.start + some[known] * self._welch.hop + length / 2
                found.append((at, *self.meter.measure(np.concatenate(kept), starts)))
        return found

    def _piece(self, number: int) -> FloatArray | None:
        begin = self.start + number * self._welch.hop
        if begin + self._welch.segment_length > self._aligned.n_available:
            return None  # clocks that have been set may end earlier
        samples, valid = self._aligned.read(
            begin, begin + self._welch.segment_length, is_final=False
        )
        valid &= np.isfinite(samples).all(axis=1)
        return around_gaps(self._aligned, self._welch, samples, valid, begin, most=self._most)


def _follow(
    aligned: AlignedRecording, welch: WelchSettings, *, most: float, longest: float
) -> None:
    """Set clocks by delays in a stretch that grows.

    Over hours they drift by more than a segment is long. Each setting brings the next pieces near
    enough to be measured.
    """
    pieces = _Pieces(aligned, welch, aligned.measurable, most=most, longest=longest)
    found = pieces.begin()
    if not found:
        return
    low, high = int(pieces.first[0]), int(pieces.first[-1]) + 1
    while True:
        for at, delays, std in found:
            frame_delays = pieces.meter.frame_delays
            aligned.learn(at, delays, std=std, frame_delays=frame_delays)
        aligned.set_clocks()
        if low == 0 and high == pieces.total:
            return
        more = math.ceil(_GROWTH * (high - low))
        low, before, high, after = max(0, low - more), low, min(pieces.total, high + more), high
        new = np.concatenate([np.arange(low, before), np.arange(after, high)])
        found = pieces.measure(new[:: math.ceil(len(new) / _STEP)])
