"""Calibration results: every sensor against the reference, with budgets of the uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from daq.clocks.clock_model import RelativeTime
from daq.errors import WrongSettingError
from daq.results.band_summary import correlation_of, data_means
from daq.results.clock_effect import relative_time
from daq.results.uncertainty_budget import Budget, Component, calibrated_budgets, known
from estimator.checks.shared_motion import CanonicalCoherence
from estimator.errors import InsufficientDataError
from estimator.levels.bands import band_edges
from estimator.levels.contributions import Source
from estimator.responses.calibration import CommonMotion
from estimator.responses.derived_quantities import Value
from estimator.responses.edge_leakage import channel_responses, slope_factor
from estimator.self_noise.coherency import coherency, other_channels, own_channels
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.bench.channel import Certificate, Channel
    from daq.bench.model import Bench
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from daq.results.band_summary import Estimate
    from estimator.responses.calibration import ResponseCurve, SensorCalibration
    from estimator.types import ComplexArray, FloatArray

CONFIDENCE = 0.95
BANDS_PER_OCTAVE = 1
_RECTANGULAR = math.sqrt(3.0)
_SHARED = {Source.MISFIT, Source.SHARED_NOISE, Source.COUNTS}
"""Contributions to noise by what sensors share beside the motion."""
_FOLLOWING = {Source.LINEARITY, Source.OF_MOTION}
"""By noise that follows the motion of the channel."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Sensors calibrated against one of them.

    Attributes
    ----------
    reference : int
        From 0.
    certificates : tuple of Certificate
        Of its channels; empty where it has none, and all is relative to it.
    sensors : tuple of SensorCalibration
        Over the whole band. The delay is NaN where the clocks are aligned.
    curves : tuple of ResponseCurve
        The same, in thirds of an octave.
    budgets : tuple of Budget
        Of the sensitivities in the whole band and in octaves, and of the noise in the whole band,
        in terms of the calibrated sensitivities.
    confidence : float
    refused : mapping of int to str
        Why a sensor is not calibrated. Its noise has no budget.
    without_noise : tuple of ChannelLabel
        Calibrated channels whose mean noise is not positive, and that have no budget of it.
    untested : tuple of str
        Sensors, the reference among them, of which no test tells what may bend them: U has none of
        it.
    """

    reference: int
    certificates: tuple[Certificate, ...]
    sensors: tuple[SensorCalibration, ...]
    curves: tuple[ResponseCurve, ...]
    budgets: tuple[Budget, ...]
    confidence: float
    refused: dict[int, str] = field(default_factory=dict)
    without_noise: tuple[ChannelLabel, ...] = ()
    untested: tuple[str, ...] = ()

    def whole_band(self, quantity: str) -> tuple[Budget, ...]:
        """Return the budgets of a quantity in the widest band."""
        found = [each for each in self.budgets if each.quantity == quantity]
        widest = {(each.sensor, each.channel): each for each in reversed(found)}
        return tuple(each for each in found if widest[each.sensor, each.channel] is each)


def calibrate(
    estimate: Estimate,
    bench: Bench | None,
    *,
    reference: str | None = None,
    confidence: float = CONFIDENCE,
) -> Calibration:
    """Calibrate all sensors against one.

    Parameters
    ----------
    estimate : Estimate
        A finished one.
    bench : Bench or None
        With the certificates of the reference, if it has any.
    reference : str, optional
        Name of the sensor; by default the first with certificates, or else the first of all.
    confidence : float
        Level of the expanded uncertainties.

    Raises
    ------
    WrongSettingError
        If the reference is unknown, or the level not between 0 and 1.
    InsufficientDataError
        If no sensor can be compared with the reference.
    """
    snapshot = estimate.snapshot
    if not 0 < confidence < 1:
        raise WrongSettingError(f"confidence {confidence:g}: expected a fraction such as 0.95")
    names, known = snapshot.sensor_names, {} if bench is None else bench.channels
    certified = [_certificates_of(snapshot, known, name) for name in names]
    if reference is not None and reference not in names:
        raise WrongSettingError(f"reference {reference!r}: expected one of {', '.join(names)}")
    chosen = next((n for n, each in enumerate(certified) if each), 0)
    chosen = chosen if reference is None else names.index(reference)
    work = _Work(estimate, known, chosen, certified[chosen], confidence)
    sensors: list[SensorCalibration] = []
    curves: list[ResponseCurve] = []
    budgets: list[Budget] = []
    refused: dict[int, str] = {}
    for sensor in range(len(names)):
        if sensor == chosen:
            continue
        try:
            found = work.motion.calibrated(sensor, work.band)
            if relative_time(snapshot, names[sensor], names[chosen]) is RelativeTime.ALIGNED:
                unknown = np.full(found.delay.value.shape, np.nan)
                found = replace(found, delay=Value(unknown, unknown))
            sensors.append(found)
            curves.append(work.motion.curve(sensor, work.edges(3)))
        except InsufficientDataError as error:
            refused[sensor] = str(error)
            continue
        budgets += work.sensitivities(sensors[-1])
        sensors[-1] = work.widened(sensors[-1], budgets[-len(found.scatter) :])
        for low, high in work.octaves():
            try:
                budgets += work.sensitivities(work.motion.calibrated(sensor, (low, high)))
            except InsufficientDataError:  # not coherent there
                continue
    if not sensors:
        raise InsufficientDataError(
            f"no sensor can be compared with {names[chosen]}: " + "; ".join(refused.values())
        )
    noise, without_noise = work.noise(sensors, budgets)
    return Calibration(
        reference=chosen,
        certificates=certified[chosen],
        sensors=tuple(sensors),
        curves=tuple(curves),
        budgets=(*budgets, *noise),
        confidence=confidence,
        refused=refused,
        without_noise=tuple(without_noise),
        untested=_untested(snapshot),
    )


def _untested(snapshot: Snapshot) -> tuple[str, ...]:
    """Return the sensors whose linearity too few segments, or none, tell."""
    bends = np.full(len(snapshot.channels), np.nan) if snapshot.bends is None else snapshot.bends
    unknown = set(np.flatnonzero(np.isnan(bends)).tolist())
    unknown -= {each.column for each in snapshot.nonlinear}
    found = {label.sensor for n, label in enumerate(snapshot.channels) if n in unknown}
    return tuple(name for name in snapshot.sensor_names if name in found)


class _Work:
    """What all sensors are calibrated with."""

    def __init__(
        self,
        estimate: Estimate,
        known: Mapping[tuple[str, str], Channel],
        reference: int,
        certificates: Sequence[Certificate],
        confidence: float,
    ) -> None:
        snapshot = estimate.snapshot
        self.snapshot, self._estimate, self._known = snapshot, estimate, known
        self._reference, self._confidence = reference, confidence
        self._certificates = certificates
        self.band = estimate.band
        self._scale = scale = np.ones(len(snapshot.channels))
        of_certificates = 0.0
        for column, certificate in zip(self._columns(reference), certificates, strict=False):
            # motion by the certificate, not by the bench file
            scale[column] = known[self._key(column)].sensitivity / certificate.value
            relative = certificate.expanded_uncertainty / certificate.k / abs(certificate.value)
            of_certificates = max(of_certificates, relative)
        # conservative: as if the sensitivities of all its channels erred together
        stated = [snapshot.sensitivities.get(self._key(n)) for n in self._columns(reference)]
        own = [math.hypot(0.0 if certificates else e.own, e.by_temperature) for e in stated if e]
        self._of_reference = math.hypot(max(own, default=0.0), of_certificates)
        self._csm: ComplexArray = snapshot.csm * scale[:, None] * scale[None, :]
        self.motion = CommonMotion(
            self._csm,
            snapshot.frequency,
            snapshot.dims,
            reference,
            min([snapshot.n_effective, *(octave.n_effective for octave in snapshot.octaves)]),
            correlation_of(estimate.settings),
            CanonicalCoherence(coherency(self._csm, snapshot.dims).matrix),
        )
        self._bending = self._curvature()

    def _columns(self, sensor: int) -> range:
        return own_channels(self.snapshot.dims, sensor)

    def _key(self, column: int) -> tuple[str, str]:
        return self.snapshot.channels[column].sensor, self.snapshot.channels[column].channel

    def octaves(self) -> list[tuple[float, float]]:
        edges = self.edges(BANDS_PER_OCTAVE).tolist()
        return list(pairwise(edges)) if len(edges) > 2 else []

    def edges(self, per_octave: int) -> FloatArray:
        low, high = self.band
        count = max(1, round(per_octave * math.log2(high / low)))
        return np.asarray(np.geomspace(low, high * (1 + 1e-9), count + 1))

    def _curvature(self) -> ComplexArray:
        """Return how a window's width changes relative responses, (n_freqs, n_channels).

        With the responses D of the channel and K of the instruments, both relative to the
        reference, averages over the width of a line differ from its middle by
        ``factor / 2 (D'' / D + 2 D' / D conj(K' / K))``.
        """
        f, dims, reference = self.snapshot.frequency, self.snapshot.dims, self._reference
        window = get_window(self._estimate.settings.window, 512)
        factor = slope_factor(window, 512 / self._estimate.settings.segment)
        found = channel_responses(self._csm, f, dims=dims)
        ratio, slopes = found.ratio[:, :, reference], found.slopes()[:, :, reference]
        width = np.gradient(f)[1:-1, None]
        bending = np.full(ratio.shape, np.nan, dtype=np.complex128)
        with np.errstate(invalid="ignore", divide="ignore"):
            second = (ratio[2:] - 2 * ratio[1:-1] + ratio[:-2]) / width**2
            bending[1:-1] = factor / 2 * second / ratio[1:-1]
        known_slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        for sensor in range(len(dims)):
            own = list(self._columns(sensor))
            rest = other_channels(dims, sensor, reference)
            count = np.isfinite(slopes[:, rest]).sum(axis=1)
            mean = known_slopes[:, rest].sum(axis=1) / np.maximum(count, 1)
            bending[:, own] += factor * slopes[:, own] * mean[:, None].conj()
        return bending

    def sensitivities(self, found: SensorCalibration) -> list[Budget]:
        """Return a budget for each channel of a sensor."""
        f = self.snapshot.frequency
        inside = (f >= found.low) & (f <= found.high)
        omega_squared = float(np.mean((2 * np.pi * f[inside]) ** 2))
        residual = self.snapshot.diagnostics.synchronisation.residual
        names = self.snapshot.sensor_names
        jitter = math.hypot(
            *(known(residual.get(names[each], 0.0)) for each in (found.sensor, found.reference))
        )
        n = max(found.n_frequencies - 1, 1)
        shared, following = self._unmodelled((found.low, found.high))
        clocks = omega_squared * jitter**2 / 2 / _RECTANGULAR
        budgets = []
        for number, column in enumerate(self._columns(found.sensor)):
            sensor, name = self._key(column)
            channel = self._known.get((sensor, name))
            gain = float(found.gain.value[number])
            scatter = float(found.scatter[number]) / gain
            variation = math.sqrt(
                max((float(found.gain.error[number]) / gain) ** 2 - scatter**2, 0)
            )
            bent = self._bending[inside, column]
            bent = bent[np.isfinite(bent)]
            leakage = float(abs(np.mean(bent.real))) / _RECTANGULAR if bent.size else 0.0
            components = [
                Component("estimate", "A", "normal", scatter, found.dof),
                Component("variation", "A", "normal", variation, float(n)),
                Component("clocks", "B", "rectangular", clocks),
                Component("leakage", "B", "rectangular", leakage),
                Component("quantisation", "B", "rectangular", self._counting(column, inside)),
            ]
            further = {
                "drift": self._drift(column),
                "linearity": max(self._nonlinearity(column, inside), self._with(column, following)),
                "misfit": self._with(column, shared) / _RECTANGULAR,
                "certificate" if self._certificates else "tolerance": self._of_reference,
            }
            components += [
                Component(source, "B", "normal", size) for source, size in further.items() if size
            ]
            absolute = bool(self._certificates) and channel is not None
            budgets.append(
                Budget(
                    sensor=sensor,
                    channel=name,
                    quantity="sensitivity",
                    low=found.low,
                    high=found.high,
                    value=gain * (channel.sensitivity if absolute and channel else 1.0),
                    components=tuple(components),
                    confidence=self._confidence,
                    is_absolute=absolute,
                )
            )
        return budgets

    def widened(self, found: SensorCalibration, budgets: Sequence[Budget]) -> SensorCalibration:
        """Return a calibration whose matrix, angles and delays have what budgets of gains have.

        Their scatter is in them already, and the sensitivity of the reference is none of theirs.
        Changes of gains turn nothing, nor does what bends a channel unseen.
        """
        diagnosis = self.snapshot.diagnostics.diagnosis
        changes = diagnosis.stability.changes if diagnosis and diagnosis.stability else ()
        turns = any(
            each.is_turn or each.channel is not None
            for each in changes
            if each.sensor in (found.sensor, found.reference)
        )
        known = {"estimate", "variation", "certificate", "tolerance"}
        late = {"linearity", "misfit", *(("drift",) if turns else ())}
        is_seen = self.snapshot.nonlinear or self.snapshot.dependent
        turning = late if is_seen else late - {"linearity"}
        parts = [{e.source: e.relative for e in each.components} for each in budgets]
        return found.widened(
            *(
                np.array([math.hypot(*(each[n] for n in each if n in which)) for each in parts])
                for which in ({n for each in parts for n in each} - known, turning, late)
            )
        )

    def _unmodelled(self, band: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        """Return by how much gains may be off where the model does not hold, two of (n_channels,).

        By power that sensors share beside the motion, as a share of the motion: a cross-spectrum
        is off by it at most. And by noise that follows the motion: a part of the gain may be in it.
        """
        snapshot, estimate = self.snapshot, self._estimate
        of_motion, of_others = np.zeros((2, len(snapshot.channels)))
        if estimate.noise is None:
            return of_others, of_motion
        edges = band_edges(snapshot.frequency, band)
        levels = estimate.spectrum(estimate.method).levels(edges)
        high = levels.ends(factor=False)[1][0]
        is_known = np.isfinite(high)
        level = np.where(is_known, np.clip(np.nan_to_num(levels.mean[0]), 0.0, high), 0.0)
        most = np.where(is_known, np.fmax(level, high - level), np.inf)
        for each in levels.contributions:
            with np.errstate(invalid="ignore"):
                amount = np.fmax(each.below, each.above)[0] + np.nan_to_num(each.share[0] * level)
            amount = np.fmin(np.where(np.isinf(each.share[0]), np.inf, amount), most)
            if each.source in _SHARED:
                of_others = np.fmax(of_others, amount)
            elif each.source in _FOLLOWING:
                of_motion = np.fmax(of_motion, amount)
        motion = np.fmax(data_means(snapshot, band) - level, level / 1e6)
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = (np.nan_to_num(each / motion) for each in (of_others, of_motion))
        shared, following = (np.fmin(each, 1.0) for each in shares)
        return shared, np.sqrt(following)

    def _with(self, column: int, sizes: FloatArray) -> float:
        """Return the size of a channel with the largest of the reference."""
        return math.hypot(sizes[column], sizes[list(self._columns(self._reference))].max())

    def _drift(self, column: int) -> float:
        """Return the standard deviation of a gain over the recording, where responses change.

        While a channel stands still, its gain is 0: the mean gain lacks that share of the time.
        """
        found, still = self.snapshot.diagnostics.diagnosis, self.snapshot.diagnostics.stood_still
        added = np.zeros(len(self.snapshot.channels))
        if found is not None and found.stability is not None:
            added += found.stability.added
        for each, seconds in still.items():
            added[each] += (seconds / self.snapshot.elapsed) ** 2
        return math.sqrt(added[column] + added[list(self._columns(self._reference))].max())

    def _nonlinearity(self, column: int, inside: np.ndarray) -> float:
        """Return by how much a gain at this loudness may differ from that at another.

        A cube ``c x**3`` adds ``3 c s**2`` to the gain, with s the standard deviation, and noise of
        ``6 c**2 s**6``: two thirds of the square of what it adds to the gain, of the motion. A
        square adds about as much at an offset of s. What is not found may be `Snapshot.bends`.
        """
        psd = self.snapshot.data_psd[inside]
        bends = self.snapshot.bends
        squares = np.zeros(len(psd[0])) if bends is None else np.nan_to_num(bends) ** 2
        for each in self.snapshot.nonlinear:
            share = float(each.explained[inside].sum() / psd[:, each.column].sum())
            squares[each.column] = max(squares[each.column], 1.5 * share)
        return math.sqrt(squares[column] + squares[list(self._columns(self._reference))].max())

    def _counting(self, column: int, inside: np.ndarray) -> float:
        """Return the relative uncertainty of a gain by the noise of whole counts."""
        psd = self.snapshot.quantisation_psd
        if psd is None:
            return 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            share = psd[inside, column] / self.snapshot.data_psd[inside, column]
        share = share[np.isfinite(share)]
        if not share.size:
            return 0.0
        return float(np.sqrt(share.mean() / (2 * max(self.motion.n_effective, 1.0) * share.size)))

    def noise(
        self, sensors: Sequence[SensorCalibration], sensitivities: Sequence[Budget]
    ) -> tuple[list[Budget], list[ChannelLabel]]:
        """Return budgets of the noise over the whole band, and the channels without noise."""
        combined = {(each.sensor, each.channel): each.combined for each in reversed(sensitivities)}
        calibrated = {
            column: (1 / float(self._scale[column]), self._of_reference)
            for column in self._columns(self._reference)
        }
        for found in sensors:
            for column, gain in zip(
                self._columns(found.sensor), found.gain.value.tolist(), strict=True
            ):
                calibrated[column] = gain, combined[self._key(column)]
        return calibrated_budgets(
            self._estimate,
            self.band,
            calibrated,
            confidence=self._confidence,
            is_absolute=bool(self._certificates),
        )


def _certificates_of(
    snapshot: Snapshot, known: Mapping[tuple[str, str], Channel], name: str
) -> tuple[Certificate, ...]:
    """Return the certificates of a sensor, in the order of its channels; empty if one has none."""
    channels = [known.get((name, e.channel)) for e in snapshot.channels if e.sensor == name]
    found = tuple(each.certificate for each in channels if each and each.certificate)
    return found if len(found) == len(channels) else ()
