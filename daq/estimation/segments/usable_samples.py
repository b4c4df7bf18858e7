"""Which samples and segments have no gap around or in them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def surrounded(usable: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return which samples, `reach` from either end, have usable ones as far as that around."""
    return whole_segments(usable, np.arange(len(usable) - 2 * reach), 2 * reach + 1)


def whole_segments(
    usable: NDArray[np.bool_], starts: NDArray[np.int64], length: int
) -> NDArray[np.bool_]:
    """Return which segments have usable samples only."""
    missing = np.concatenate([[0], np.cumsum(~usable)])
    return np.asarray(missing[starts + length] == missing[starts])
