"""What waves across the bench do to the noise, for ``huddle plan``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator import planning
from estimator.likelihood.dimension import MIN_DETERMINED_SENSORS
from estimator.likelihood.gradients import MIN_SENSORS
from estimator.methods import self_noise

if TYPE_CHECKING:
    from estimator.types import FloatArray

WAVES = 150.0  # m/s, of a floor; the ground is faster
ASSUMED_RADIUS = 0.12  # m, of a bench of unknown positions
_AT = 20.0  # Hz, where precision is compared
_SIX = (
    "five on a circle of {radius:.0f} cm and one in its centre, each rotated by a different angle,"
    " none of them a multiple of 90°"
)


@dataclass(frozen=True, slots=True)
class Waves:
    """What waves across the bench do to the noise, and what gradients of the motion cost.

    Attributes
    ----------
    n_sensors : int
    radius : float
        Metres, of the sensors about their centre.
    is_known : bool
        Whether positions are known; else sensors are taken to stand on a circle.
    one_percent : float
        Frequency in Hz at which the three-sensor estimate of the worst channel is biased by 1 % of
        the noise; the bias grows with the square of the frequency.
    cost, cost_of_six : float
        c.o.v. of one frequency at 20 Hz times the root of the averages, with gradients of the
        motion, with these and with six sensors; infinite where gradients cannot be told from noise.
    """

    n_sensors: int
    radius: float
    is_known: bool
    one_percent: float
    cost: float
    cost_of_six: float

    @property
    def sentences(self) -> str:
        """What to expect, and what to do."""
        where = (
            "at their positions" if self.is_known else f"on a circle of {100 * self.radius:.0f} cm"
        )
        text = (
            f"Waves of {WAVES:g} m/s across the sensors, {where}, bias the three-sensor estimate by"
            f" 1 % of the noise at {self.one_percent:.2g} Hz and by 100 % at"
            f" {10 * self.one_percent:.2g} Hz."
        )
        six = _SIX.format(radius=100 * self.radius)
        if self.n_sensors < MIN_SENSORS:
            text += (
                f" {self.n_sensors} sensors cannot tell gradients of the motion from noise; the"
                " model test can only warn. Put them closer together, or use six sensors:"
            )
        elif not math.isfinite(self.cost) or self.n_sensors < MIN_DETERMINED_SENSORS:
            text += (
                f" {self.n_sensors} sensors tell gradients of the motion from noise only if"
                " corresponding channels have equal noise, and no band is accepted. Put them closer"
                " together, or use six sensors:"
            )
        else:
            text += (
                f" --dimension auto takes gradients of the motion into account: the c.o.v. of one"
                f" frequency is then {self.cost:.2g}/√n at {_AT:g} Hz, for n averages."
            )
            if self.cost <= 1.1 * self.cost_of_six:
                return text
            text += " Six sensors are better:"
        return (
            f"{text} {six}. With them the c.o.v. of one frequency is {self.cost_of_six:.2g}/√n at"
            f" {_AT:g} Hz, for n averages."
        )


def waves_across(
    directions: FloatArray, dims: tuple[int, ...], positions: FloatArray | None, *, snr: float
) -> Waves | None:
    """Return what waves do to triaxial sensors; None for others.

    Parameters
    ----------
    directions : float64, shape (n_channels, 3)
        Direction cosines.
    dims : tuple of int
    positions : float64, shape (n_sensors, 3), optional
        Metres.
    snr : float
    """
    if set(dims) != {3} or len(dims) < 3 or directions.shape[1] != 3:
        return None
    n_sensors = len(dims)
    where = _ring(n_sensors, ASSUMED_RADIUS) if positions is None else positions[:, :2]
    where = where - where.mean(axis=0)
    radius = float(np.linalg.norm(where, axis=1).max())
    if not radius > 0:
        return None
    low = 0.01 * WAVES / radius  # Hz: long waves, where the bias grows with the square
    csm, _ = planning.crossed_csm(directions, where, snr=snr, wavelength=WAVES / low)
    found = self_noise("three-sensor", csm, dims=dims, n_effective=planning.REFERENCE)
    bias = float(np.nanmax(np.abs(found.noise_psd - 1)))
    turns = np.random.default_rng(6).standard_normal((6, 3, 3))
    six = np.vstack([np.linalg.qr(turn)[0] for turn in turns])
    around = np.concatenate([_ring(5, radius), np.zeros((1, 2))])

    def cost(of: FloatArray, stand: FloatArray) -> float:
        scene = planning.crossed_csm(of, stand, snr=snr, wavelength=WAVES / _AT)
        return planning.gradient_cost(*scene)

    return Waves(
        n_sensors=n_sensors,
        radius=radius,
        is_known=positions is not None,
        one_percent=low * math.sqrt(0.01 / bias),
        cost=cost(directions, where) if n_sensors >= MIN_DETERMINED_SENSORS else math.inf,
        cost_of_six=cost(six, around),
    )


def _ring(n_sensors: int, radius: float) -> FloatArray:
    bearing = 2 * np.pi * np.arange(n_sensors) / n_sensors
    return np.asarray(radius * np.column_stack([np.cos(bearing), np.sin(bearing)]))
