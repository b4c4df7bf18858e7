"""Noise that only the channels of one sensor share: no motion, and no fault of the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.likelihood.factor_analysis import Maximum, maximise, n_noise
from estimator.likelihood.goodness_of_fit import (
    ModelTest,
    model_test,
    pool,
    rejected_below,
)
from estimator.median import median
from estimator.self_noise.coherency import Coherency, testable
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

CLEARLY = 10.0
"""p value of a band beside one sensor's matrix, over that of a band that fails, from which it
explains the band: motion that differs looks a little like it."""
ALIKE = 0.5
"""Correlation of the shared noise with the motion in the sensor, from which it is motion that
others do not share: what clocks, gaps and waves that differ leave."""
STEADY = 0.9
"""Mean of what channels share over its rms, from which it is that of one source."""
LINE, LINES = 6, 0.1
"""Frequencies of a band at most, or their share, of which lines of one sensor make it fail."""
STANDS_OUT = 1e-6
"""p value of a frequency below which it may be one of them."""
AMBIGUOUS = 3
"""Sensors of which a line of one looks like one that the two others share, but for its power."""
ALONE = 4.0
"""Excess of a line in spectra of a sensor over that in any other, from which it is its own."""
TONE = 1.0
"""The same from which others have the line, too: the motion of a machine."""
UNDECIDED = -2
LOOK = 16
"""Frequencies of a band at which sensors are tried first."""


def beside_matrices(
    model: ModelTest,
    part: Coherency,
    frequency: FloatArray,
    insides: Sequence[BoolArray],
    *,
    dims: tuple[int, ...],
    n_factors: int,
    n_effective: float,
    neighbours: FloatArray,
) -> tuple[ModelTest, BoolArray, IntArray]:
    """Return the test with the noise of one sensor as a matrix where that explains a failed band.

    Not of all sensors: motion that differs between three sensors fits matrices of all three. Also
    returns whether it is such a test, in each of the bands `insides`; and the sensor of lines, such
    as hum, which alone make a band fail, at each frequency: `UNDECIDED` where two sensors may have
    them, -1 elsewhere.
    """
    tests = [pool(model, inside, neighbours=neighbours) for inside in insides]
    rejected = rejected_below(tests)
    ones = [
        (*(1,) * sum(dims[:sensor]), d, *(1,) * sum(dims[sensor + 1 :]))
        for sensor, d in enumerate(dims)
        if d > 1
    ]
    ones = [each for each in ones if (sum(dims) - n_factors) ** 2 > n_noise(each)]
    widened = np.zeros(len(insides), np.bool_)
    found = [each.copy() for each in (model.statistic, model.degrees)]
    failed = [n for n, test in enumerate(tests if ones else ()) if test.p_value < rejected]
    lines = np.full(len(frequency), -1)
    if not failed:
        return model, widened, lines
    every = [np.flatnonzero(insides[number] & np.isfinite(model.statistic)) for number in failed]
    seen = [rows[:: -(-len(rows) // LOOK)] for rows in every]
    edges = np.cumsum([0, *map(len, seen)]).tolist()

    def fits(rows: IntArray, each: tuple[int, ...]) -> Maximum:
        return maximise(testable(part.block(rows), frequency[rows]), n_factors, dims=each)

    looks = [fits(np.concatenate(seen), each) for each in ones]  # of all bands together
    for number, rows, look, some in zip(
        failed, every, seen, map(slice, edges, edges[1:]), strict=False
    ):
        out = rows[ModelTest(model.statistic[rows], model.degrees[rows]).p_value < STANDS_OUT]
        if 0 < len(out) <= max(LINE, LINES * len(rows)) and len(out) < len(rows):
            others = insides[number].copy()
            others[out] = False
            of_each = [model_test(fits(out, each), n_effective=n_effective) for each in ones]
            best = int(np.argmin([np.nansum(each.statistic) for each in of_each]))
            both = pool(model, others, neighbours=neighbours), pool(of_each[best], out >= 0)
            first = int(np.argmax(np.array(ones[best]) > 1))
            own = int(np.searchsorted(np.cumsum(dims), first, side="right"))
            excess = _excess(part.psd, out, others, dims)
            most = float(np.delete(excess, own).max())  # a tone that all feel tells of responses
            if most < TONE and min(each.p_value for each in both) >= rejected:
                is_known = len(dims) > AMBIGUOUS or bool(excess[own] > ALONE * max(most, 0.0))
                lines[out] = own if is_known else UNDECIDED
                if is_known:
                    _put(found, of_each[best], out)
                continue
        least = [np.nansum(each.discrepancy[some]) for each in looks]
        best = int(np.argmin(least))
        fit = looks[best].take(some) if len(look) == len(rows) else fits(rows, ones[best])
        beside = model_test(fit, n_effective=n_effective)
        explained = pool(beside, rows >= 0, neighbours=neighbours).p_value >= CLEARLY * rejected
        if explained and _is_noise(fit, testable(part.block(rows), frequency[rows])):
            widened[number] = True
            _put(found, beside, rows)
    return ModelTest(*found), widened, lines


def _excess(psd: FloatArray, out: IntArray, others: BoolArray, dims: tuple[int, ...]) -> FloatArray:
    """Return by how much lines stand out in the spectra of each sensor, as a share."""
    more = psd[out].mean(axis=0) / median(psd[others]) - 1
    return np.asarray(np.maximum.reduceat(more, np.cumsum([0, *dims[:-1]])))


def _put(found: list[FloatArray], test: ModelTest, rows: IntArray) -> None:
    for each, values in zip(found, (test.statistic, test.degrees), strict=True):
        each[rows] = values


def _is_noise(fit: Maximum, matrix: ComplexArray) -> bool:
    """Return whether what channels of one sensor share is alike at all frequencies, and no motion.

    Clocks, gaps and waves that differ leave a part of the motion, at random from one frequency to
    the next.
    """
    at = np.flatnonzero(np.bincount(fit.sensor)[fit.sensor] > 1)
    i, j = (at[each] for each in np.triu_indices(len(at), 1))
    good = ~fit.singular
    scale = np.sqrt(fit.psi[good][:, i] * fit.psi[good][:, j])
    noise = fit.noise[good][:, i, j]
    motion = (matrix[good][:, i, j] - noise) / scale
    noise = noise / scale
    size, steady = float(np.linalg.norm(noise)), float(np.linalg.norm(noise.mean(axis=0)))
    like = float(np.vdot(motion, noise).real)
    return (
        like < ALIKE * size * float(np.linalg.norm(motion))
        and steady * len(noise) ** 0.5 > STEADY * size
    )
