"""Averages of a recording as if its responses had been steady.

Theory of operation
-------------------
In every part of time the residual beside the motion is regressed on the motion of that part
(`estimator.checks.steadiness`). What the regression explains is what responses, as they are in the
part, differ by from their mean; it is taken off. What is left has ``n_k - q`` degrees of freedom.
Together with the motion it makes a matrix

    ``U (mean of U* S_k U) U* + sum_k n_k L_k / n'``,   ``n' = sum_k (n_k - q) + q``,

that is distributed like one of n' averages of a bench whose responses are steady. So every method
estimates *within* parts, by being given this matrix.

Within a part responses change, too. A course of slope s, between the means of the part's
neighbours, leaves ``s**2 / 12`` of the motion. One that wanders leaves a sixth of its second
difference c, squared, on average: ``c**2 / 3`` holds with few parts, too. Parts in which this
is far more than in others, as about a step, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.checks.steadiness import VALUES_AT_ONCE, ResponseScores, regression
from estimator.median import median
from estimator.spectra.parts import grouped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimator.likelihood.factor_analysis import Maximum
    from estimator.spectra.parts import Parts
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

LEAST = 4
"""Averages of a part, per dimension of the motion: a quarter of them is spent."""
APART = 4.0
"""A part whose responses change so many times as much as those of the median is left out."""
MOST_LEFT_OUT = 0.4
"""Share of the averages, at most."""
ROUGH = 4.0
"""Weight of squares of second differences, beside those of slopes."""
MARGIN = 2.0
"""By which what responses leave within parts is bounded: of few parts, it is not better known."""


@dataclass(frozen=True, slots=True, eq=False)
class Steadied:
    """Averages without the changes of responses between parts.

    Attributes
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        NaN where no parts are kept.
    n_effective : float
    left_out : int64, shape (n_left_out,)
        Numbers of the parts that do not count: about a step.
    below, above : float64, shape (n_channels,)
        By how much the noise may be too high, or too low, for what responses do within parts: as a
        fraction of the PSD of the motion.
    """

    csm: ComplexArray
    n_effective: float
    left_out: IntArray
    below: FloatArray
    above: FloatArray


def steadied(
    parts: Parts,
    at: Maximum,
    *,
    dims: tuple[int, ...],
    good: BoolArray,
    changed: Sequence[int],
) -> Steadied:
    """Return averages without the changes of responses between parts.

    Parameters
    ----------
    parts : Parts
    at : Maximum
        For the averages of all segments, or for those of a steadied bench; all frequencies.
    dims : tuple of int
    good : bool, shape (n_freqs,)
        Frequencies by which changes are measured.
    changed : sequence of int
        Sensors whose responses change.
    """
    n, q, p = parts.averages, at.n_factors, at.psi.shape[1]
    groups = grouped(n, LEAST * q)
    fitted = at.converged & ~at.singular
    places = np.flatnonzero(parts.bins < len(good))
    places = places[fitted[parts.bins[places]]]
    scores = ResponseScores(dims, len(groups))
    n_values = len(parts.each) * p**2
    for some in _pieces(places[good[parts.bins[places]]], n_values):
        found = regression(parts.joined(some, groups), at.take(parts.bins[some]))
        scores.add(found, np.eye(len(some)))
    left, kept = _within(scores, dims, changed, np.array([n[some].sum() for some in groups]))
    out = [some for some, is_kept in zip(groups, kept, strict=True) if not is_kept]
    left_out = np.concatenate([np.zeros(0, np.int64), *out])
    groups = [some for some, is_kept in zip(groups, kept, strict=True) if is_kept]
    csm = np.full((len(good), p, p), np.nan, np.complex128)
    averages = np.array([n[some].sum() for some in groups])
    more = float((averages - q).sum()) + q
    for some in _pieces(places, n_values):
        found = regression(parts.joined(some, groups), at.take(parts.bins[some]))
        U = found.directions
        motion = found.motion.sum(axis=0) / averages.sum()
        whole = U @ motion @ U.conj().swapaxes(1, 2)
        whole += np.tensordot(averages / more, found.left, axes=1)
        csm[parts.bins[some]] = whole / (found.scale[:, :, None] * found.scale[:, None, :])
    below, above = bounds(MARGIN * left, len(changed))
    return Steadied(csm, more, left_out, np.repeat(below, dims), np.repeat(above, dims))


def _pieces(places: IntArray, n_values: int) -> list[IntArray]:
    """Return frequencies that are regressed together, of so many values each."""
    at_once = max(1, VALUES_AT_ONCE // n_values)
    return np.array_split(places, -(-len(places) // at_once)) if len(places) else []


def _within(
    scores: ResponseScores, dims: tuple[int, ...], changed: Sequence[int], averages: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the variance of each sensor's response within parts, and the parts that are kept."""
    found = np.zeros((len(averages), len(dims)))
    if len(averages) > 1:
        for sensor in changed:
            others = [each for each in changed if each != sensor]
            score, information = scores.without(others).sensor(sensor)
            inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
            course = (inverse @ score[:, :, None])[:, :, 0]
            padded = np.concatenate(
                [2 * course[:1] - course[1:2], course, 2 * course[-1:] - course[-2:-1]]
            )
            slope, bend = (padded[2:] - padded[:-2]) / 2, np.diff(padded, n=2, axis=0)
            square = (slope**2 + ROUGH * bend**2) / 12
            of_rows = square.reshape(len(averages), dims[sensor], -1).sum(axis=2)
            found[:, sensor] = of_rows.max(axis=1)
    most, kept = found.max(axis=1), np.ones(len(averages), np.bool_)
    for part in np.argsort(-most).tolist():
        out = averages[~kept].sum() + averages[part]
        if most[part] <= APART * median(most) or out > MOST_LEFT_OUT * averages.sum():
            break
        kept[part] = False
    weight = averages[kept] / averages[kept].sum()
    return weight @ found[kept], kept


def bounds(variance: FloatArray, n_changed: int) -> tuple[FloatArray, FloatArray]:
    """Return what variances of responses, shape (n_sensors,), add to the noise and take at most.

    Beside sensors j and k, the noise of i changes by the mean of ``(g_i - g_j) (g_i - g_k)``: only
    its own variance, where the others are steady.
    """
    if n_changed < 2:
        return variance, np.zeros_like(variance)
    deviation = np.sqrt(variance)
    below, above = np.zeros((2, len(variance)))
    for i, own in enumerate(deviation):
        k, j = np.sort(np.delete(deviation, i))[-2:]
        below[i] = (own + j) * (own + k)
        above[i] = below[i] - own**2
    return below, above
