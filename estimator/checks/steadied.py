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
difference c, squared, on average: ``c**2 / 3`` holds with few parts, too. Parts in which this is
far more than in others, as about a step, are left out. Where the response of a part has another
slope over frequency than the mean, more leaks at the edges of its segments (`edge_leakage`): a
third of the squared difference between neighbouring frequencies. All of it is measured at every
frequency, by the coefficients of the regression less what their scatter adds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from estimator.checks.steadiness import VALUES_AT_ONCE, Regression, regression
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum
from estimator.median import median
from estimator.records import dataclass
from estimator.spectra.parts import Parts, grouped
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

LEAST_BINS = 8
"""Frequencies at a time at least: each needs both neighbours."""
LEAST = 4
"""Averages of a part, per dimension of the motion: a quarter of them is spent."""
APART = 4.0
"""A part whose responses change so many times as much as those of the median is left out."""
LEAST_MOTION = 10.0
"""Motion over noise, in some band of each part."""
LEAST_KEPT = 0.4
"""Share of the motion, of all parts together, in those that are not left out."""
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
    within : float64, shape (n_bands, n_channels)
        By how much the noise may be too high, or too low where it is negative, for what responses
        do within parts: as a share of the noise.
    """

    csm: ComplexArray
    n_effective: float
    left_out: IntArray
    within: FloatArray


def steadied(
    parts: Parts,
    at: Maximum,
    psd: FloatArray,
    *,
    good: BoolArray,
    insides: Sequence[BoolArray],
) -> Steadied | None:
    """Return averages without the changes of responses between parts.

    None where a part has little motion, or most of it is in parts that would be left out: what the
    regression then takes off is noise.

    Parameters
    ----------
    parts : Parts
    at : Maximum
        For the averages of all segments, or for those of a steadied bench; all frequencies.
    psd : float64, shape (n_freqs, n_channels)
        Of these averages.
    good : bool, shape (n_freqs,)
        Frequencies by which changes are measured.
    insides : sequence of bool, shape (n_freqs,)
        Frequencies of each band.
    """
    n, q, p = parts.averages, at.n_factors, at.psi.shape[1]
    groups = grouped(n, LEAST * q)
    averages = np.array([n[some].sum() for some in groups])
    places = np.flatnonzero(parts.bins < len(good))
    places = places[(at.converged & ~at.singular)[parts.bins[places]]]
    kept, courses = np.ones(len(groups), np.bool_), {}
    apart, loud = np.zeros((2, len(groups)))
    for number, inside in enumerate(insides if len(groups) > 1 else ()):
        some = places[(good & inside)[parts.bins[places]]]
        if len(some):
            pieces = [
                _courses(found, parts.bins[its])
                for its, found in _regressions(parts, at, psd, some, groups)
            ]
            left, moved, squares, motion = (np.sum(e, axis=0) for e in zip(*pieces, strict=True))
            loud = np.maximum(loud, motion / (q * len(some)))
            courses[number] = left @ fisher.covariance(squares[None])[0]
            # of few frequencies, the scatter of coefficients alone is apart at times
            most = APART * (1 + APART / np.sqrt(q * len(some))) * median(moved)
            apart = np.maximum(apart, (moved / most).max(axis=1))
    for part in np.argsort(-apart).tolist():
        out = averages[~kept].sum() + averages[part]
        if apart[part] <= 1 or out > MOST_LEFT_OUT * averages.sum():
            break
        kept[part] = False
    if courses and (loud.min() < LEAST_MOTION or loud[kept].sum() < LEAST_KEPT * loud.sum()):
        return None
    out = [some for some, is_kept in zip(groups, kept, strict=True) if not is_kept]
    groups = [some for some, is_kept in zip(groups, kept, strict=True) if is_kept]
    averages = averages[kept]
    within = np.zeros((len(insides), p))
    for number, course in courses.items():
        within[number] = MARGIN * (averages / averages.sum()) @ course[kept]
    if courses:  # bands without a good frequency: as the worst of others
        most = within[np.abs(within).argmax(axis=0), np.arange(p)]
        within[[number not in courses for number in range(len(insides))]] = most
    csm = np.full((len(good), p, p), np.nan, np.complex128)
    more = float((averages - q).sum()) + q
    for some, found in _regressions(parts, at, psd, places, groups):
        U = found.directions
        motion = found.motion.sum(axis=0) / averages.sum()
        whole = U @ motion @ U.conj().swapaxes(1, 2)
        whole += np.tensordot(averages / more, found.left, axes=1)
        csm[parts.bins[some]] = whole / (found.scale[:, :, None] * found.scale[:, None, :])
    return Steadied(csm, more, np.concatenate([np.zeros(0, np.int64), *out]), within)


def _regressions(
    parts: Parts, at: Maximum, psd: FloatArray, places: IntArray, groups: Sequence[IntArray]
) -> Iterator[tuple[IntArray, Regression]]:
    """Yield few frequencies at a time, and the regressions of joined parts there."""
    at_once = max(LEAST_BINS, VALUES_AT_ONCE // (len(parts.each) * at.psi.shape[1] ** 2))
    for some in np.array_split(places, -(-len(places) // at_once)) if len(places) else ():
        bins = parts.bins[some]
        yield some, regression(parts.joined(some, groups), at.take(bins), psd[bins])


def _courses(
    found: Regression, bins: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what courses of responses leave within parts, and how much they change.

    Both of shape (n_parts, n_channels), beside the motion: sums over frequencies. The first is less
    what scatter adds. The second is any change beside both neighbours, with its scatter. Third are
    the squares of projectors, (n_channels, n_channels), from noise to what is beside the motion.
    Fourth is the motion of each part.
    """
    n = len(found.motion)
    each = np.eye(n)
    padded = np.concatenate([[2 * each[0] - each[1]], each, [2 * each[-1] - each[-2]]])
    slope, bend = (padded[2:] - padded[:-2]) / 2, np.diff(padded, n=2, axis=0)
    own = np.einsum("fpp->fp", found.projector).real
    totals = found.averages + found.motion.shape[-1]
    across = found.motion / totals[:, None, None, None]
    scatter = np.einsum("jfab,kfba->kjf", found.of_motion, across).real
    power, expected = [], []
    for course in (slope, bend):
        D = np.tensordot(course, found.coefficients, axes=1)
        power.append(((D @ across) * D.conj()).sum(axis=3).real)
        expected.append(np.einsum("kj,kjf->kf", course**2, scatter)[..., None] * own)
    left = (power[0] - expected[0] + ROUGH * (power[1] - expected[1])) / 12
    U = found.directions
    G = found.coefficients @ U.conj().swapaxes(1, 2)
    D = (G[:, 2:] - G[:, :-2]) @ U[1:-1]
    edges = ((D @ across[:, 1:-1]) * D.conj()).sum(axis=3).real
    spread = np.einsum("kfab,kfba->kf", found.of_motion, across).real[..., None] * own
    # kept bins may lie apart; the first and last of a piece have one neighbour
    nearer = (2 / (bins[2:] - bins[:-2])) ** 2 * len(bins) / max(1, len(bins) - 2)
    left[:, 1:-1] += (edges - 2 * spread[:, 1:-1]) / 12 * nearer[:, None]
    squares = (np.abs(found.projector) ** 2).sum(axis=0)
    loud = np.einsum("kfaa->k", across).real
    return left.sum(axis=1), (power[0] + power[1]).sum(axis=1), squares, loud
