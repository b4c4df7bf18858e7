"""The limits of a bench file, and which channels are below them: `estimator.decision` decides.

A limit is judged in bands a third of an octave wide, divided at notches, peaks and steps of the
mask. The ends of the intervals are those of every table (`daq.results.band_summary`), at the
quantile that holds for all channels, limits and bands together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import (
    averages_at,
    held,
    known_range,
    without_partners,
)
from daq.results.decision.facts import WrongSensitivity
from daq.results.decision.verdict import LimitResult, TestVerdict
from estimator.checks.advice import Rank
from estimator.checks.advice_on_noise import ResponseChanges
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.sensitivities import TOLERANCE, Cause, wrong_gains
from estimator.decision.comparison import (
    Comparison,
    Judged,
    joint_quantile,
    mask_edges,
    mean_mask,
    prediction,
    whole,
)
from estimator.decision.verdict import MIN_AVERAGES, Obstacle, Verdict
from estimator.levels.contributions import Source, by_chance

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from daq.bench.model import Bench, Limit
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from daq.results.band_summary import Estimate, Levels
    from estimator.checks.sensitivities import WrongGain
    from estimator.types import FloatArray

ALIKE = 0.05
"""Difference of the gains of a sensor's channels up to which they are one gain."""


def judge(bench: Bench | None, estimate: Estimate) -> TestVerdict | None:
    """Return the verdict on all limits, by the method of the settings; None without limits."""
    snapshot = estimate.snapshot
    if bench is None or not bench.limits:
        return None
    method = estimate.method
    bands = [Bands.of(bench, limit, snapshot) for limit in bench.limits]
    quantile = joint_quantile(sum(each.n_bands * len(each.columns) for each in bands))
    spectrum = None if estimate.noise is None else estimate.spectrum(method)
    known: dict[bytes, ColumnLevels] = {}  # limits often share their bands
    found: list[Comparison] = []
    judged: list[Judged] = []
    doubted = _doubted(snapshot)
    limits: list[LimitResult] = []
    for each in bands:
        columns = known.get(each.edges.tobytes())
        if columns is None and spectrum is not None and each.n_bands:
            columns = ColumnLevels.of(spectrum.levels(each.edges), quantile)
            known[each.edges.tobytes()] = columns
        for column in each.columns:
            found.append(
                replace(
                    each.comparison(bench, snapshot, columns, column),
                    gains=doubted[column].alternatives if column in doubted else (),
                )
            )
            judged.append(found[-1].judged())
            limits.append(each.result(snapshot.channels[column], method, found[-1], judged[-1]))
    is_complete = all(each.columns for each in bands)
    verdict, obstacles = whole(
        judged,
        _general_obstacles(snapshot),
        is_complete=is_complete and not snapshot.not_estimated,
    )
    if verdict is Verdict.NOT_DECIDED and not (is_complete or snapshot.not_estimated):
        obstacles = (*obstacles, Obstacle.NO_CHANNEL)
    sensitivities = _named(snapshot, doubted.values())
    so_far = TestVerdict(verdict, tuple(limits), obstacles, sensitivities=sensitivities, k=quantile)
    if so_far.is_sure or snapshot.not_estimated:
        return so_far
    left = prediction(found, obstacles, quantile=quantile, elapsed=snapshot.elapsed)
    return replace(so_far, prediction=left)


def _doubted(snapshot: Snapshot) -> dict[int, WrongGain]:
    """Return the channels whose sensitivity the motion contradicts, by column.

    A channel with a certificate that agrees with its sensitivity is not doubted.
    """
    diagnosis = snapshot.diagnostics.diagnosis
    if diagnosis is None:
        return {}
    certified = {
        column
        for column, label in enumerate(snapshot.channels)
        if (known := snapshot.sensitivities.get((label.sensor, label.channel))) is not None
        and known.is_certified
        and abs(known.off) <= TOLERANCE
    }
    faulty = snapshot.diagnostics.faulty
    found = wrong_gains(diagnosis.responses, snapshot.dims, certified=certified)
    return {each.channel: each for each in found if each.channel not in faulty}


def _named(snapshot: Snapshot, found: Iterable[WrongGain]) -> tuple[WrongSensitivity, ...]:
    """Return wrong gains by name: one fact for a sensor whose channels are wrong alike."""
    labels, sensors = snapshot.channels, snapshot.sensor_names
    of_sensors: dict[str, list[WrongGain]] = {}
    for each in found:
        of_sensors.setdefault(labels[each.channel].sensor, []).append(each)
    groups: list[list[WrongGain]] = []
    for wrong in of_sensors.values():
        gains = [each.gain for each in wrong]
        is_one = max(gains) <= (1 + ALIKE) * min(gains)
        groups += [wrong] if is_one else [[each] for each in wrong]
    return tuple(
        WrongSensitivity(
            rank=Rank.INVALIDATES,
            sensors=(labels[group[0].channel].sensor,),
            channels=tuple(labels[each.channel].name for each in group),
            gains=tuple(each.gain for each in group),
            standard_errors=tuple(each.error for each in group),
            against=tuple(sensors[n] for n in group[0].against),
            cause=Cause.CHANGED if _has_changed(snapshot, group[0]) else group[0].cause,
        )
        for group in groups
    )


def _has_changed(snapshot: Snapshot, wrong: WrongGain) -> bool:
    """Whether the sensor was carried away, or its response changed by half of this or more."""
    sensor = snapshot.sensor_names.index(snapshot.channels[wrong.channel].sensor)
    return any(
        isinstance(each, NoSharedMotion)
        or (isinstance(each, ResponseChanges) and 2 * abs(each.size) >= abs(wrong.gain - 1))
        for each in snapshot.diagnostics.advice
        if sensor in each.sensors
    )


def concerns(limit: Limit, label: ChannelLabel) -> bool:
    """Whether a mask is for a channel."""
    return limit.concerns(label.sensor, label.channel)


def mask_psd(bench: Bench, limit: Limit, label: ChannelLabel, frequency: FloatArray) -> FloatArray:
    """Return a mask between its points, straight in log-log, in the unit of the result squared/Hz.

    A mask without a unit is in the unit that the channel has in the bench file. A band that ends
    just outside of the mask has its value at the end.
    """
    mask = limit.mask
    inside = np.clip(frequency, mask.frequency[0], mask.frequency[-1])
    in_file = bench.channels.get((label.sensor, label.channel))
    return mask.at(inside, label.unit, of_channel=None if in_file is None else in_file.unit)


@dataclass(frozen=True, slots=True, eq=False)
class ColumnLevels:
    """Levels of all channels in the bands of a limit, as a verdict needs them.

    Each pair has lower and upper ends, shape (n_bands, n_channels): by what is random (the scatter
    and the sensitivities), with all that widens it, and with all but the clocks. `reach` is that of
    the sensitivities alone, in logarithms of the level, shape (n_channels,).
    """

    levels: Levels
    scatter: tuple[FloatArray, FloatArray]
    outer: tuple[FloatArray, FloatArray]
    no_clocks: tuple[FloatArray, FloatArray]
    withdrawn: NDArray[np.bool_]
    reach: FloatArray

    @classmethod
    def of(cls, found: Levels, quantile: float) -> ColumnLevels:
        """Return the columns at a quantile."""
        reach = quantile * found.deviation
        return cls(
            found,
            by_chance(found.mean, *found.of_scatter.interval(quantile), reach),
            found.ends(quantile),
            found.ends(quantile, without={Source.CLOCKS}),
            found.withdrawn(quantile),
            reach,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """The bands of one limit, and the channels that it is for."""

    limit: Limit
    edges: NDArray[np.int64]
    judged: tuple[float, float]
    columns: tuple[int, ...]
    alone: NDArray[np.bool_]

    @classmethod
    def of(cls, bench: Bench, limit: Limit, snapshot: Snapshot) -> Bands:
        """Return the bands of a limit in a spectrum; the last ends where nothing is known."""
        frequency, points = snapshot.frequency, np.asarray(limit.mask.frequency)
        columns = tuple(n for n, each in enumerate(snapshot.channels) if concerns(limit, each))
        lowest, highest = known_range(snapshot)
        known = lowest, highest or math.inf
        edges = np.empty(0, dtype=np.int64)
        if columns:
            mask = mask_psd(bench, limit, snapshot.channels[columns[0]], frequency)
            edges = mask_edges(frequency, mask, points, known=known)
        alone = np.zeros((max(len(edges) - 1, 0), len(snapshot.channels)), np.bool_)
        if len(alone) and without_partners(snapshot, (frequency[edges[0]], frequency[edges[-1]])):
            for band, centre in enumerate(_centres(frequency, edges).tolist()):
                alone[band, list(without_partners(snapshot, (centre, centre)))] = True
        return cls(limit, edges, _judged_range(frequency, points, edges, known), columns, alone)

    @property
    def n_bands(self) -> int:
        """Number of bands."""
        return max(len(self.edges) - 1, 0)

    def comparison(
        self, bench: Bench, snapshot: Snapshot, columns: ColumnLevels | None, column: int
    ) -> Comparison:
        """Return the noise of a channel beside the mask."""
        frequency, label = snapshot.frequency, snapshot.channels[column]
        centre = _centres(frequency, self.edges)
        nothing = np.full(centre.shape, np.nan)
        mask = nothing
        if centre.size:
            mask = mean_mask(frequency, mask_psd(bench, self.limit, label, frequency), self.edges)
        mean, cumulants = nothing, np.full((3, *centre.shape), np.nan)
        scatter = outer = no_clocks = (nothing, nothing)
        withdrawn, reach = np.zeros(centre.shape, np.bool_), 0.0
        if columns is not None:
            found = columns.levels
            complete = found.of_scatter.complete[:, column]
            mean = np.where(complete, found.mean[:, column], np.nan)
            cumulants = found.of_scatter.cumulants[:, :, column]
            scatter, outer, no_clocks = (
                (low[:, column], high[:, column])
                for low, high in (columns.scatter, columns.outer, columns.no_clocks)
            )
            withdrawn, reach = columns.withdrawn[:, column], float(columns.reach[column])
        diagnostics = snapshot.diagnostics
        return Comparison(
            centre=centre,
            mask=mask,
            mean=mean,
            cumulants=cumulants,
            low=scatter[0],
            high=scatter[1],
            outer_low=outer[0],
            outer_high=outer[1],
            no_clocks=no_clocks,
            averages=averages_at(snapshot, centre),
            is_alone=self.alone[:, column],
            is_withdrawn=withdrawn,
            is_faulty=column in diagnostics.faulty,
            reach=reach,
            least=max(MIN_AVERAGES, len(snapshot.channels) + 1.0),  # as the model test
        )

    def result(
        self, label: ChannelLabel, method: str, found: Comparison, judged: Judged
    ) -> LimitResult:
        """Return the verdict on a channel, with the numbers of the band where it does worst."""

        def number(values: FloatArray) -> float:
            return math.nan if judged.band is None else float(values[judged.band])

        return LimitResult(
            limit=self.limit.name,
            sensor=label.sensor,
            channel=label.channel,
            method=method,
            frequency=number(found.centre),
            noise_psd=number(held(found.mean, found.outer_low, found.outer_high)),
            low=number(found.outer_low),
            high=number(found.outer_high),
            limit_psd=number(found.mask),
            verdict=judged.verdict,
            covers=(self.limit.mask.frequency[0], self.limit.mask.frequency[-1]),
            judged=self.judged,
            obstacle=judged.obstacle,
        )


def _centres(frequency: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    if edges.size < 2:
        return np.empty(0)
    return np.asarray(np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1]))


def _judged_range(
    frequency: FloatArray, points: FloatArray, edges: NDArray[np.int64], known: tuple[float, float]
) -> tuple[float, float]:
    """Return from and to which frequency a mask is judged; its own ends where it is to there."""
    if edges.size < 2:
        return math.nan, math.nan
    low, high, spacing = float(points[0]), float(points[-1]), float(frequency[1])
    first, last = float(frequency[edges[0]]), min(float(frequency[edges[-1] - 1]), known[1])
    return (
        low if low >= known[0] else first,
        high if high <= last + 2 * spacing else last,
    )


def _general_obstacles(snapshot: Snapshot) -> set[Obstacle]:
    """Return what keeps the whole test from a decision."""
    found = set()
    if snapshot.sensors and all(sensor.is_lost for sensor in snapshot.sensors):
        found.add(Obstacle.SENSORS_LOST)
    if snapshot.n_segments == 0:
        found.add(Obstacle.NO_SEGMENTS)
    is_known = snapshot.diagnostics.synchronisation.is_known
    if not is_known or not all(clock.is_understood for clock in snapshot.clocks):
        found.add(Obstacle.CLOCKS)
    return found
