"""How the sensors of a test stand: their axes against those of one, and the coherence of pairs."""

from __future__ import annotations

import math
from itertools import combinations, pairwise

import numpy as np

from daq.bench.channel import Channel
from daq.estimation.diagnosis import vertical_channel
from daq.estimation.snapshot import Snapshot
from daq.results.band_summary import Estimate
from estimator.checks.shared_motion import CanonicalCoherence
from estimator.errors import EstimatorError
from estimator.levels.bands import log_edges
from estimator.records import dataclass
from estimator.self_noise.coherency import coherency, own_channels
from estimator.types import FloatArray

POINTS = 40
"""Points of a coherence against frequency."""
_BINS = 24
"""Frequencies of which a point is the mean: more make it no clearer."""


@dataclass(frozen=True, slots=True, eq=False)
class Stance:
    """The axes of one sensor in those of the reference.

    Attributes
    ----------
    name : str
    channels : tuple of str
    directions : float64, shape (d, d)
        Unit vectors of its channels, by those of the reference; NaN where it cannot be compared.
    order : tuple of int
        Channels that point right, up and towards the viewer, as far as there are.
    turn_deg, lean_deg, error_deg : float
        Angle in the horizontal plane, angle of its vertical to that of the reference, and standard
        error of angles; NaN where they are not known.
    reversed_channels : tuple of int
    is_reference : bool
    """

    name: str
    channels: tuple[str, ...]
    directions: FloatArray
    order: tuple[int, ...]
    turn_deg: float = math.nan
    lean_deg: float = math.nan
    error_deg: float = math.nan
    reversed_channels: tuple[int, ...] = ()
    is_reference: bool = False

    @property
    def is_known(self) -> bool:
        """Whether it could be compared."""
        return bool(np.isfinite(self.directions).all())

    @property
    def is_upside_down(self) -> bool:
        """Whether its vertical points down although no channel is reversed."""
        if len(self.order) < 3 or not self.is_known or self.reversed_channels:
            return False
        return float(self.directions[self.order[2], self.order[2]]) < 0


def stances(snapshot: Snapshot) -> tuple[Stance, ...]:
    """Return the axes of every sensor against the first that others are compared with.

    Empty where no sensor could be compared.
    """
    diagnosis = snapshot.diagnostics.diagnosis
    responses = () if diagnosis is None else diagnosis.responses
    if not responses:
        return ()
    first = min(each.first for each in responses)
    found = {each.second: each for each in responses if each.first == first}
    result = []
    for sensor, name in enumerate(snapshot.sensor_names):
        columns = own_channels(snapshot.dims, sensor)
        channels = tuple(snapshot.channels[column].channel for column in columns)
        order = _order(channels)
        if sensor == first:
            axes = np.eye(len(channels))
            result.append(Stance(name, channels, axes, order, 0.0, 0.0, 0.0, is_reference=True))
            continue
        pair = found.get(sensor)
        if pair is None:
            unknown = np.full((len(channels), len(channels)), math.nan)
            result.append(Stance(name, channels, unknown, order))
            continue
        axes = pair.matrix / np.linalg.norm(pair.matrix, axis=1, keepdims=True)
        lean = math.nan
        if len(order) == 3:
            up = abs(float(axes[order[2], order[2]]))
            lean = math.degrees(math.acos(min(up, 1.0)))
        if pair.is_ambiguous:  # then the signs are not known
            axes = np.full_like(axes, math.nan)
        result.append(
            Stance(
                name,
                channels,
                axes,
                order,
                pair.horizontal_deg,
                lean,
                pair.angle_error_deg,
                pair.reversed_channels,
            )
        )
    return tuple(result)


def _order(channels: tuple[str, ...]) -> tuple[int, ...]:
    """Return the channels with the vertical one last; as they are where none is known."""
    named = [Channel(name=each, sensitivity=1.0) for each in channels]
    vertical = vertical_channel(named)
    flat = [each for each in range(len(channels)) if each != vertical]
    return tuple(flat if vertical is None else [*flat, vertical])


@dataclass(frozen=True, slots=True, eq=False)
class PairCoherence:
    """Coherence of all pairs of sensors, in the direction in which it is least.

    Attributes
    ----------
    pairs : tuple of (int, int)
    frequency : float64, shape (n_points,)
        In Hz.
    value : float64, shape (n_pairs, n_points)
        Without the bias of few averages; NaN where it is not known.
    matrix : float64, shape (n_sensors, n_sensors)
        Mean over the band of the result; 1 on the diagonal.
    """

    pairs: tuple[tuple[int, int], ...]
    frequency: FloatArray
    value: FloatArray
    matrix: FloatArray


def pair_coherence(estimate: Estimate) -> PairCoherence | None:
    """Return the coherence of all pairs; None without two sensors or averages of them."""
    snapshot, dims = estimate.snapshot, estimate.snapshot.dims
    frequency = snapshot.frequency
    if len(dims) < 2 or frequency.size < 4:
        return None
    edges = log_edges(frequency, POINTS)
    chosen = np.zeros(frequency.size, np.bool_)
    point = np.zeros(frequency.size, np.int64)
    for number, (begin, end) in enumerate(pairwise(edges)):
        some = np.unique(np.linspace(begin, end - 1, min(_BINS, end - begin)).round().astype(int))
        chosen[some], point[some] = True, number
    try:
        checked = coherency(snapshot.csm, dims)
    except EstimatorError:
        return None
    coherence = CanonicalCoherence(checked.matrix, checked.valid)
    chosen &= coherence.usable
    low, high = estimate.band
    inside = (frequency >= low) & (frequency <= high) & chosen
    pairs = tuple(combinations(range(len(dims)), 2))
    n_points, matrix = edges.size - 1, np.eye(len(dims))
    value = np.full((len(pairs), n_points), math.nan)
    weight = np.bincount(point[chosen], minlength=n_points)
    for number, (one, two) in enumerate(pairs):
        own = (own_channels(dims, each) for each in (one, two))
        least = coherence.between(*own, where=chosen)[:, -1]
        n = snapshot.n_effective
        freed = np.clip(1 - (1 - least) * n / max(n - min(dims[one], dims[two]), 1.0), 0.0, 1.0)
        total = np.bincount(point[chosen], freed[chosen], minlength=n_points)
        with np.errstate(invalid="ignore"):
            value[number] = total / weight
        matrix[one, two] = matrix[two, one] = freed[inside].mean() if inside.any() else math.nan
    middle = np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1])
    return PairCoherence(pairs, middle, value, matrix)
