"""Uncertainty budgets: their lines, their combination, and the coverage factor.

Every number has one budget, one U and one k, whoever shows it. The standard uncertainties of its
lines add by squares (JCGM 100:2008, 5.1.2). The interval of noise is that of
`daq.results.band_summary.Levels`, because noise is not linear in what it is made of (JCGM 101:2008,
5.10.1): the estimate scatters like a PSD, sensitivities are factors, and the largest error by an
effect without a distribution is added as it is. U is half the width of the interval, and k is U
over the combined standard uncertainty.

The budgets of calibrated channels are in terms of their calibrated sensitivities.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import cache
from statistics import NormalDist
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from daq.bench.sensitivity import KnownSensitivity
from daq.estimation.snapshot import ChannelLabel
from daq.results.band_summary import Estimate, Levels
from estimator.levels.bands import band_edges, third_octaves
from estimator.levels.contributions import Source
from estimator.levels.interval import NORMAL_95
from estimator.records import NOT_IN_JSON, dataclass
from estimator.types import FloatArray

STATED = 1e6
"""Degrees of freedom of an uncertainty that is stated."""


@dataclass(frozen=True, slots=True)
class Component:
    """One line of a budget.

    Attributes
    ----------
    source : str
        "estimate", "variation", "quantisation", "certificate", "tolerance", "drift", or a cause of
        `estimator.levels.contributions.Source`.
    kind : str
        "A" (from the scatter of these data) or "B" (from elsewhere).
    distribution : str
        "normal", "rectangular" or "chi-squared".
    relative : float
        Standard uncertainty over the value.
    dof : float
        Degrees of freedom.
    reach : (float, float)
        How far it alone moves the ends of the interval, of the value; NaN where the expanded
        uncertainty has no ends of its own.
    """

    source: str
    kind: str = field(metadata={"key": "type"})
    distribution: str
    relative: float = field(metadata={"key": "relative_standard_uncertainty"})
    dof: float = field(default=STATED, metadata={"key": "degrees_of_freedom"})
    reach: tuple[float, float] = field(default=(math.nan, math.nan), metadata=NOT_IN_JSON)


@dataclass(frozen=True, slots=True)
class Budget:
    """The uncertainty of one value of one channel in one band.

    Attributes
    ----------
    sensor : str
        Name of the sensor.
    channel : str
        Name of the channel.
    quantity : str
        sensitivity: in counts per unit if `is_absolute`, otherwise relative to the bench file;
        noise: PSD by the calibrated sensitivities.
    low, high : float
        Band, Hz.
    value : float
        The value.
    components : tuple of Component
        Lines of the budget.
    confidence : float
    is_absolute : bool
        Whether the value rests on a certificate.
    ends : (float, float) or None
        The interval, where its ends are not those of Student's distribution: noise is not linear
        in what it is made of (JCGM 101), and bounds add.
    """

    sensor: str
    channel: str
    quantity: str = field(metadata={"enum": ("sensitivity", "noise")})
    low: float = field(metadata=NOT_IN_JSON)
    high: float = field(metadata=NOT_IN_JSON)
    value: float
    components: tuple[Component, ...]
    confidence: float = field(metadata=NOT_IN_JSON)
    is_absolute: bool = False
    ends: tuple[float, float] | None = field(default=None, metadata=NOT_IN_JSON)
    IN_JSON: ClassVar[Mapping[str, str]] = {
        "band_hz": "band",
        "combined_relative": "combined",
        "effective_degrees_of_freedom": "dof",
        "k": "k",
        "expanded_uncertainty": "expanded",
    }

    @property
    def band(self) -> tuple[float, float]:
        """Band."""
        return self.low, self.high

    @property
    def combined(self) -> float:
        """Combined standard uncertainty, as a fraction of the value."""
        return math.sqrt(sum(each.relative**2 for each in self.components))

    @property
    def dof(self) -> float:
        """Effective degrees of freedom (Welch and Satterthwaite); null in JSON: no limit."""
        total = sum(each.relative**4 / each.dof for each in self.components)
        return self.combined**4 / total if 0 < total < math.inf else STATED

    @property
    def k(self) -> float:
        """Coverage factor: expanded over combined standard uncertainty."""
        if self.ends is None:
            return student_quantile(0.5 + self.confidence / 2, self.dof)
        return (self.ends[1] - self.ends[0]) / 2 / self.standard if self.standard else math.nan

    @property
    def standard(self) -> float:
        """Combined standard uncertainty, in the unit of the value."""
        return abs(self.value) * self.combined

    @property
    def expanded(self) -> float:
        """Expanded uncertainty, in the unit of the value: half the width of the interval."""
        return self.k * self.standard

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends of the interval, in the unit of the value."""
        return self.ends or (self.value - self.expanded, self.value + self.expanded)

    def over(self, divisor: float) -> Budget:
        """Return the budget of the value over a number that is known."""
        low, high = self.interval
        return replace(self, value=self.value / divisor, ends=(low / divisor, high / divisor))


@cache
def student_quantile(probability: float, dof: float) -> float:
    """Return a quantile of Student's distribution, with 2 degrees of freedom at least.

    By Newton's method from the expansion of Abramowitz and Stegun 26.7.5, which is exact to
    rounding for `_MANY` degrees: scipy.special takes a quarter of a second to import.
    """
    n, z = max(dof, 2.0), NormalDist().inv_cdf(probability)
    t = z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
    t += (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    step = t if n < _MANY else 0.0
    while abs(step) > 1e-12 * t:
        at = np.linspace(0.0, t, 4001)
        front = math.exp(math.lgamma((n + 1) / 2) - math.lgamma(n / 2)) / math.sqrt(n * math.pi)
        density = front * (1 + at**2 / n) ** (-(n + 1) / 2)
        inner = 4 * density[1::2].sum() + 2 * density[2:-1:2].sum()  # Simpson's rule
        area = at[1] / 3 * (density[0] + inner + density[-1])
        step = float((probability - 0.5 - area) / density[-1])
        t += step
    return t


def level_budget(
    found: Levels,
    column: int,
    label: ChannelLabel,
    band: tuple[float, float],
    *,
    row: int = 0,
    confidence: float = 0.95,
) -> Budget:
    """Return the budget of the noise of one channel in one band.

    The one place in which the parts of an interval become a standard uncertainty and a k.

    Parameters
    ----------
    found : Levels
    column, row : int
        Channel and band in them.
    label : ChannelLabel
    band : (float, float)
        Hz.
    confidence : float

    Raises
    ------
    ArithmeticError
        If the total interval does not hold the statistical one: it never may.
    """
    quantile = NORMAL_95
    if confidence != 0.95:
        quantile = NormalDist().inv_cdf(0.5 + confidence / 2)
    level = float(found.mean[row, column])
    low, high = (float(end[row, column]) for end in found.ends(quantile))
    # the bound, which needs no model of the motion, cuts both intervals
    inner = [min(float(end[row, column]), high) for end in found.of_scatter.interval(quantile)]
    if low > inner[0] or high < inner[1]:
        raise ArithmeticError(f"{label.name}: {low, high} does not hold the statistical {inner}")
    scale = abs(level) if level else math.nan
    variance = float(found.of_scatter.cumulants[0, row, column])
    deviation = 0.0
    if variance:
        deviation = math.inf if variance < 0 else math.sqrt(variance) / scale
    parts = [
        Component(
            "estimate", "A", "chi-squared", deviation,
            2 / deviation**2 if deviation else STATED,
            ((inner[0] - level) / scale, (inner[1] - level) / scale),
        )
    ]  # fmt: skip
    for each in found.contributions:
        below, above = (
            float(side[row]) / scale for side in each.adds(column, found.mean[:, column], quantile)
        )
        by_chance = float(np.broadcast_to(each.deviation, found.mean.shape[1:])[column])
        off = below - abs(math.expm1(-quantile * by_chance))
        bound = (off + above - math.expm1(quantile * by_chance)) / _RECTANGULAR
        parts.append(
            Component(
                each.source, "A" if each.source is Source.GUSTS else "B",
                "normal" if by_chance else "rectangular",
                math.hypot(by_chance, bound), reach=(-below, above),
            )
        )  # fmt: skip
    return Budget(
        sensor=label.sensor,
        channel=label.channel,
        quantity="noise",
        low=band[0],
        high=band[1],
        value=level if low <= level <= high else math.nan,
        components=tuple(parts),
        confidence=confidence,
        ends=(low, high),
    )


_MANY = 1000.0
_RECTANGULAR = math.sqrt(12.0)
"""Width of a rectangular distribution over its standard deviation (JCGM 100:2008, 4.3.8)."""


def band_budgets(estimate: Estimate) -> list[Budget]:
    """Return the budget of every channel over the band of the tables; none without a result."""
    return [found[0] for found in _budgets(estimate, band_edges)]


def third_octave_budgets(estimate: Estimate) -> list[list[Budget]]:
    """Return the budgets of every channel in thirds of an octave of the band of the tables.

    Those whose interval has both ends.
    """
    return [
        [each for each in of_channel if all(map(math.isfinite, (each.value, *each.interval)))]
        for of_channel in _budgets(
            estimate, lambda frequency, band: third_octaves(frequency, *band)
        )
    ]


def _budgets(
    estimate: Estimate,
    divided: Callable[[FloatArray, tuple[float, float]], NDArray[np.int64]],
) -> list[list[Budget]]:
    """Return the budgets of the bands of every channel, by the method that judges."""
    snapshot = estimate.snapshot
    if estimate.noise is None:
        return []
    edges = divided(snapshot.frequency, estimate.band)
    found, frequency = estimate.spectrum(estimate.method).levels(edges), snapshot.frequency
    bands = [
        (float(frequency[first]), float(frequency[last - 1]))
        for first, last in itertools.pairwise(edges)
    ]
    return [
        [level_budget(found, column, label, band, row=row) for row, band in enumerate(bands)]
        for column, label in enumerate(snapshot.channels)
    ]


def calibrated_budgets(
    estimate: Estimate,
    band: tuple[float, float],
    calibrated: Mapping[int, tuple[float, float]],
    *,
    confidence: float,
    is_absolute: bool,
) -> tuple[list[Budget], list[ChannelLabel]]:
    """Return a budget for the noise of each calibrated channel over a band.

    It is that of `level_budget`, with the calibrated sensitivities in place of the stated ones.

    Parameters
    ----------
    estimate : Estimate
    band : (float, float)
        Hz.
    calibrated : mapping of int to (float, float)
        By number of the channel: its calibrated sensitivity over that of the bench file, and the
        relative standard uncertainty of this. Channels that are not in it have no budget.
    confidence : float
    is_absolute : bool
        Whether the sensitivities rest on a certificate.

    Returns
    -------
    budgets : list of Budget
    unknown : list of ChannelLabel
        Calibrated channels whose mean noise is not positive.
    """
    snapshot = estimate.snapshot
    if estimate.noise is None:
        return [], []
    sensitivities = {
        (label.sensor, label.channel): KnownSensitivity(own=calibrated[column][1])
        for column, label in enumerate(snapshot.channels)
        if column in calibrated
    }
    stated = replace(snapshot, sensitivities=sensitivities)
    whole = Estimate(stated, estimate.settings).levels(estimate.method, band)
    budgets: list[Budget] = []
    unknown: list[ChannelLabel] = []
    for column, (ratio, _) in sorted(calibrated.items()):
        label = snapshot.channels[column]
        if not whole.mean[0, column] > 0:
            unknown.append(label)
            continue
        found = level_budget(whole, column, label, band, confidence=confidence)
        budgets.append(replace(found.over(ratio**2), is_absolute=is_absolute))
    return budgets, unknown


def known(value: float) -> float:
    """Return a value, or 0 where it is not known."""
    return value if math.isfinite(value) else 0.0
