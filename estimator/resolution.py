"""As many dimensions of motion as the averages can tell from scatter, frequency by frequency.

Factors that the averages cannot find are fitted to scatter, and what is fitted is missing from the
noise: without motion 17 to 30 % at n = 20, 6 to 15 % still at n = 1080. A model without these
factors has no such bias. So the weakest factor counts only where it improves the fit by more than
scatter would, then the next. Motion left out with it stays in the noise: `docs/decisions/0033`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.factor_analysis import maximise
from estimator.model_test import model_test

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.arrays import BoolArray, ComplexArray, FloatArray, IntArray
    from estimator.factor_analysis import Maximum

SCATTER = 1.2
"""Standard deviations by which a factor must lower the test statistic beyond its own number of
parameters. With more, motion is left in the noise, with less, scatter is taken from it: at 1.2 the
mean error for three to five sensors of one to three channels, n = 20 to 1080, is least."""
CERTAIN = 8.0
"""A factor whose strength exceeds this times the root of channels over averages is not tested."""
CAPTURED = 0.15
"""Share of a channel outside the factors' space, below which these are tested, strong or not."""


def resolved(
    csm: ComplexArray, maximum: Maximum, *, n_effective: float
) -> Iterator[tuple[IntArray, Maximum]]:
    """Leave out the factors that cannot be told from scatter, the weakest first.

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
