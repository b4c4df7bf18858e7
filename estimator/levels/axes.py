"""Motion across the axes of sensors with one or two channels, in their noise.

Channel i feels motion outside of its axis through its lean a (a vector across the axis, in radians;
in two-channel sensors out of the plane). Beside channels j and k, motion of PSD S there changes its
noise by

    ``S (a_i - a_j) . (a_i - a_k)``,

too high or too low. The model test of three sensors cannot see it. For leans of rms θ its mean is
``S θ**2`` and its standard deviation ``1.6 S θ**2``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimator.types import FloatArray

_WIDEST = 1.15


def across(tolerances: Sequence[float]) -> FloatArray:
    """Return the share of the motion's PSD by which the noise of each sensor may be off.

    Parameters
    ----------
    tolerances : sequence of float, length n_sensors
        Lean of each sensor, rms, in radians; 0 where it is known, or changes nothing.

    Returns
    -------
    float64, shape (n_sensors,)
        ``(2.3 θ)**2`` for equal tolerances θ, which 97.5 % of normal leans do not exceed; 0 where
        the own tolerance is 0.
    """
    own = np.asarray(tolerances, np.float64)
    n_others = max(len(own) - 1, 1)
    others = np.sqrt(np.maximum(np.sum(own**2) - own**2, 0.0) / n_others)
    return np.where(own > 0, (_WIDEST * (own + others)) ** 2, 0.0)
