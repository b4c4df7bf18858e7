"""Finds devices that repeat their readings for long, while a run goes on.

Rows are kept for some seconds at intervals, and judged as in a check list
(``estimator.checks.count_limits.share_of_repeats``, which who runs the recorder gives: the recorder
knows no estimator). Readings that repeat three times in a row
are repeated for good: a quiet channel is not named by chance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from numpy.typing import NDArray

ShareOfRepeats: TypeAlias = "Callable[[NDArray[Any]], float]"

ROWS = 1000
"""Rows that are judged together."""
INTERVAL = 20.0
"""Seconds of the sensor's time from one judgment to the next."""
_TIMES = 3


class RepeatedRows:
    """Judges the rows of one sensor now and then.

    Parameters
    ----------
    sampling_rate : float
        In Hz.
    share_of_repeats : callable
        Returns the share of rows, shape (n_samples, n_channels), that repeat the row before.
    """

    def __init__(self, sampling_rate: float, share_of_repeats: ShareOfRepeats) -> None:
        self._rate = sampling_rate
        self._share_of_repeats = share_of_repeats
        self._kept: list[NDArray[Any]] = []
        self._n_kept = self._n_waited = self._n_times = 0

    def refresh_rate(self, counts: NDArray[Any]) -> float | None:
        """Take rows; return the rate in Hz of new readings, once, when they repeat for long."""
        if self._n_waited > 0:
            self._n_waited -= len(counts)
            return None
        self._kept.append(counts)
        self._n_kept += len(counts)
        if self._n_kept < ROWS:
            return None
        share = self._share_of_repeats(np.concatenate(self._kept))
        self._kept.clear()
        self._n_kept, self._n_waited = 0, round(INTERVAL * self._rate)
        self._n_times = self._n_times + 1 if share else 0
        return (1 - share) * self._rate if self._n_times == _TIMES else None
