"""The dimensions of motion that the averages resolve, frequency by frequency.

Factors that the averages do not resolve are fitted to scatter, which removes noise: without motion
17 to 30 % at n = 20, and 6 to 15 % at n = 1080. A model without these factors has no such bias. So
the weakest factor counts only if it improves the fit by more than scatter would; then the next is
tested. Motion of an excluded factor counts as noise: `docs/decisions/0010`.

This concerns motion that several sensors measure. Motion that one channel alone measures looks like
its noise: `alone` finds these channels (`docs/decisions/0011`).
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
"""Standard deviations by which a factor must lower the test statistic beyond its own number of
parameters. With more, motion is left in the noise, with less, scatter is taken from it: at 1.2 the
mean error for three to five sensors of one to three channels, n = 20 to 1080, is least."""
BEATS_PER_WINDOW = 3.0
"""The same where a wrong answer is all of a channel's motion: at most one in 500 frequencies."""
CERTAIN = 8.0
"""A factor whose strength exceeds this times the root of channels over averages is not tested."""
CAPTURED = 0.15
"""Share of a channel outside the factors' space, below which these are tested, strong or not."""


def resolved(
    csm: ComplexArray, maximum: Maximum, *, n_effective: float
) -> Iterator[tuple[IntArray, Maximum]]:
    """Exclude the factors that the averages do not resolve, the weakest first.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        What `maximum` is of.
    maximum : Maximum
        With as many factors as the motion may have dimensions.
    n_effective : float
        Averages; with no more than channels there is no test, and all factors stay.

    Yields
    ------
    rows : int64, shape (n,)
        Frequencies that have the same number of factors; every frequency comes once.
    maximum : Maximum
        At these.
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
    """Find channels whose noise could equally be motion that no other sensor measures.

    Only the sensor with most channels can have such: as many as it has more than any other. They
    are those that the other sensors predict least. All of such a channel is taken for motion, and
    it is alone where that fits the averages as well as any noise does, but for scatter. So a
    channel that others reach from the side, by sensors that point in many directions, is not. What
    is alone at most frequencies is so at all.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Coherency, channels grouped by sensor.
    absent : bool, shape (n_freqs, n_channels)
        Channels that are dead or copies.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Averages; with no more than channels nothing is told apart.

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
        # Where little is predicted, the channel that has no like one is the likeliest.
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
        # One frequency that slips through would stand for the whole band.
        mostly = found[rows].mean(axis=0) > 0.5
        found[np.ix_(rows, np.flatnonzero(mostly))] = True
    return found


def _misfit_without_noise(
    csm: ComplexArray, channel: int, q: int, n_effective: float
) -> FloatArray:
    """Statistic of the model test with q factors and no noise in a channel, shape (n_freqs,).

    The others, that channel taken off, then have a factor less, and an average.
    """
    rest = np.delete(np.arange(csm.shape[1]), channel)
    seen = csm[:, rest, channel]
    taken_off = csm[:, rest][:, :, rest] - seen[:, :, None] * seen[:, None].conj()
    misfit, _ = _misfit(maximise(taken_off, q - 1), n_effective - 1)
    return misfit


def _misfit(maximum: Maximum, n_effective: float) -> tuple[FloatArray, FloatArray]:
    """Statistic and degrees of freedom of the model test; zero where nothing is left for it."""
    n_freqs, p = maximum.psi.shape
    if (p - maximum.n_factors) ** 2 <= p:
        return np.zeros(n_freqs), np.zeros(n_freqs)
    test = model_test(maximum, n_effective=n_effective)
    return test.statistic, test.degrees


def _doubtful(maximum: Maximum, n_effective: float) -> BoolArray:
    """Where a factor may be scatter: it is weak, or takes up nearly all of a channel.

    A factor that is fitted to one channel's noise looks strong there: its strength is taken
    without the foremost channel.
    """
    q, p = maximum.n_factors, maximum.psi.shape[1]
    share = np.abs(maximum.eigenvectors[:, :, :q]) ** 2
    strength = ((maximum.eigenvalues[:, :q] - 1) * (1 - share.max(axis=1))).min(axis=1)
    weak = strength < CERTAIN * np.sqrt(p / n_effective)
    captured = 1 - share.sum(axis=2).max(axis=1) < CAPTURED
    return np.asarray(~maximum.singular & (weak | captured))
