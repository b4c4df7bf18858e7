"""The dimensions of motion that the averages resolve, at each frequency.

Factors that the averages do not resolve are fitted to scatter, which removes noise: without motion
17 to 30 % at n = 20, and 6 to 15 % at n = 1080. A model without these factors has no such bias. So
the weakest factor is kept only if it improves the fit by more than scatter does; then the next is
tested. Motion of an excluded factor counts as noise: `docs/decisions/0010`.

This concerns motion that several sensors measure. Motion measured by only one channel is
indistinguishable from its noise: `alone` finds these channels (`docs/decisions/0011`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood.factor_analysis import max_factors, maximise
from estimator.likelihood.goodness_of_fit import model_test
from estimator.self_noise.coherency import inverse

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

SCATTER = 1.2
"""Standard deviations by which a factor must lower the test statistic beyond its number of
parameters. A higher value leaves motion in the noise, a lower one removes scatter from it: 1.2
minimises the mean error for three to five sensors of one to three channels, n = 20 to 1080."""
BEATS_PER_WINDOW = 3.0
"""The same threshold in `alone`, where an error removes all motion of a channel: wrong for at most
one in 500 frequencies."""
CERTAIN = 8.0
"""A factor is not tested if its strength exceeds this times the root of channels over averages."""
CAPTURED = 0.15
"""Factors are always tested if the share of a channel outside their space is below this."""


def resolved(
    csm: ComplexArray, maximum: Maximum, *, n_effective: float
) -> Iterator[tuple[IntArray, Maximum]]:
    """Exclude the factors that the averages do not resolve, the weakest first.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        The matrices of `maximum`.
    maximum : Maximum
        Fit with the maximum number of factors.
    n_effective : float
        Number of independent averages; all factors are kept, without a test, if it does not exceed
        the number of channels.

    Yields
    ------
    rows : int64, shape (n,)
        Indices of frequencies with the same number of factors; each frequency occurs once.
    maximum : Maximum
        Fit at these frequencies.
    """
    rows = np.arange(len(csm))
    while maximum.n_factors > 0 and n_effective > csm.shape[1]:
        doubtful = np.flatnonzero(_doubtful(maximum, n_effective))
        fewer = maximise(csm[rows[doubtful]], maximum.n_factors - 1)
        misfit, degrees = _misfit(fewer, n_effective)
        before, degrees_before = _misfit(maximum.take(doubtful), n_effective)
        parameters = degrees - degrees_before
        enough = misfit - before < parameters + SCATTER * np.sqrt(2 * parameters)
        stays = np.ones(len(rows), np.bool_)
        stays[doubtful[enough]] = False
        yield rows[stays], maximum.take(stays)
        rows, maximum = rows[~stays], fewer.take(enough)
    yield rows, maximum


def alone(
    csm: ComplexArray, absent: BoolArray, *, dims: tuple[int, ...], n_effective: float
) -> BoolArray:
    """Find channels whose noise cannot be distinguished from motion that no other sensor measures.

    Only the sensor with most channels can have such channels: as many as it has more than any
    other. The candidates are those that the other sensors predict least. A channel is alone if a
    model in which it has no noise fits the averages as well as one with noise, within scatter.
    Sensors in other orientations may measure the motion of a channel obliquely; it is then not
    alone. A channel that is alone at most frequencies is alone at all.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Coherency, channels grouped by sensor.
    absent : bool, shape (n_freqs, n_channels)
        Dead channels and copies.
    dims : tuple of int
        Number of channels of each sensor.
    n_effective : float
        Number of independent averages; no test if it does not exceed the number of channels.

    Returns
    -------
    bool, shape (n_freqs, n_channels)
    """
    found = np.zeros(absent.shape, np.bool_)
    sensor = np.repeat(np.arange(len(dims)), dims)
    place = np.concatenate([np.arange(d) for d in dims])
    for pattern in np.unique(absent, axis=0):
        present = np.flatnonzero(~pattern)
        count = np.bincount(sensor[present], minlength=len(dims))
        excess = int(np.diff(np.sort(count)[-2:])[0])
        if excess == 0:
            continue
        largest = sensor[present] == count.argmax()
        own, others = present[largest], present[~largest]
        rows = np.flatnonzero((absent == pattern).all(axis=1))
        cross = csm[np.ix_(rows, own, others)]
        among, _ = inverse(csm[np.ix_(rows, others, others)])
        left = 1 - np.einsum("fio,fop,fip->fi", cross, among, cross.conj()).real
        # With little prediction, the channel without a counterpart is the most likely.
        left *= np.where(np.isin(place[own], place[others]), 1, 2)
        least = own[np.argsort(-left, axis=1)[:, :excess]]
        candidate = (least[:, :, None] == own).any(axis=1)
        p, q = len(present), min(int(count.max()), int(max_factors(len(present))))
        if q and n_effective > p:
            matrix = csm[np.ix_(rows, present, present)]
            parameters = 2 * (p - q) + 1
            explained, _ = _misfit(maximise(matrix, q), n_effective)
            explained += parameters + BEATS_PER_WINDOW * np.sqrt(2 * parameters)
            for here, channel in zip(candidate.T, np.searchsorted(present, own), strict=True):
                misfit = _misfit_without_noise(matrix[here], int(channel), q, n_effective)
                here[here] = misfit < explained[here]
        found[np.ix_(rows, own)] = candidate
        # A single missed frequency would dominate the whole band.
        mostly = found[rows].mean(axis=0) > 0.5
        found[np.ix_(rows, np.flatnonzero(mostly))] = True
    return found


def _misfit_without_noise(
    csm: ComplexArray, channel: int, q: int, n_effective: float
) -> FloatArray:
    """Return the statistic of the model test without noise in a channel, shape (n_freqs,).

    The channel is regressed out of the others, which then have one factor and one average less.
    """
    rest = np.delete(np.arange(csm.shape[1]), channel)
    seen = csm[:, rest, channel]
    taken_off = csm[:, rest][:, :, rest] - seen[:, :, None] * seen[:, None].conj()
    misfit, _ = _misfit(maximise(taken_off, q - 1), n_effective - 1)
    return misfit


def _misfit(maximum: Maximum, n_effective: float) -> tuple[FloatArray, FloatArray]:
    """Return statistic and degrees of freedom of the model test; zero without any freedom."""
    n_freqs, p = maximum.psi.shape
    if (p - maximum.n_factors) ** 2 <= p:
        return np.zeros(n_freqs), np.zeros(n_freqs)
    test = model_test(maximum, n_effective=n_effective)
    return test.statistic, test.degrees


def _doubtful(maximum: Maximum, n_effective: float) -> BoolArray:
    """Return whether a factor may be scatter: it is weak, or explains nearly all of a channel.

    A factor fitted to the noise of one channel has a large strength in it: its strength is computed
    without its largest channel.
    """
    q, p = maximum.n_factors, maximum.psi.shape[1]
    share = np.abs(maximum.eigenvectors[:, :, :q]) ** 2
    strength = ((maximum.eigenvalues[:, :q] - 1) * (1 - share.max(axis=1))).min(axis=1)
    weak = strength < CERTAIN * np.sqrt(p / n_effective)
    captured = 1 - share.sum(axis=2).max(axis=1) < CAPTURED
    return np.asarray(~maximum.singular & (weak | captured))
