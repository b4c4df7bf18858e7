"""Whether a host's clock has stood still, as some do while their computer sleeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    BoolArray = NDArray[np.bool_]
    IntArray = NDArray[np.int64]

_EARLY = 0.05  # seconds that a block comes too early at least
_RATE_OFF = 0.02  # share by which a rate may be off
_HELD_UP = 120.0  # seconds that a host may be held up, all its blocks late, and not have slept
_STARTING = 10.0  # seconds in which all blocks may be late at first


@dataclass(slots=True)
class HostSleep:
    """Finds blocks that arrive far too early after those before: the host's clock stood still.

    Parameters
    ----------
    sampling_rate : float
        Nominal, in Hz.
    """

    sampling_rate: float
    _stretch: int = -1
    _lowest: tuple[float, float] = (np.inf, np.inf)
    _since: int = -1
    _previous: int = 0

    def breaks(self, index: IntArray, late: FloatArray, restarts: BoolArray) -> BoolArray:
        """Return which blocks are the first after a restart or a sleep, shape (n_blocks,).

        A block is the first after a sleep if its lateness is lower than that of all earlier blocks
        in its own and the previous stretch of `_HELD_UP` seconds, even if the rate is off. So late
        blocks do not make the next one early, unless all before it are late. In the first
        `_STARTING` seconds after a restart they may be: a sleep there is not found.

        Parameters
        ----------
        index : int64, shape (n_blocks,)
            Of the last sample of each block that follows those given before.
        late : float64, shape (n_blocks,)
            Lateness in s.
        restarts : bool, shape (n_blocks,)
            Whether the device's clock restarted with this block. The lateness of earlier blocks is
            then not comparable.
        """
        raised = late + _RATE_OFF * index / self.sampling_rate
        stretch = index // round(_HELD_UP * self.sampling_rate)
        before_it = np.append(self._previous, index[:-1])
        cuts = np.flatnonzero((np.diff(stretch) != 0) | restarts[1:]) + 1
        early = np.zeros(len(index), dtype=bool)
        for rows in np.split(np.arange(len(index)), cuts):
            if restarts[rows[0]] or self._since < 0:
                self._lowest, self._since = (np.inf, np.inf), int(index[rows[0]])
            before, lowest = self._lowest
            if stretch[rows[0]] != self._stretch:
                self._stretch, before, lowest = int(stretch[rows[0]]), lowest, np.inf
            so_far = np.minimum.accumulate(np.append(lowest, raised[rows]))
            early[rows] = raised[rows] < np.minimum(before, so_far[:-1]) - _EARLY
            early[rows] &= before_it[rows] >= self._since + _STARTING * self.sampling_rate
            self._lowest = before, float(so_far[-1])
        self._previous = int(index[-1])
        return restarts | early
