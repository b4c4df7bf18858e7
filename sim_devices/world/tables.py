"""The tables inside `[simulation]`: the motion, and each sensor's model, clock and response."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self, TypeAlias

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from sim_devices.arrays import FloatArray
from sim_devices.world.spectrum import Spectrum, White

USABLE = 0.9
"""The motion ends at this fraction of the lowest Nyquist frequency."""
MAX_BLOCK: Final = 65536
"""Grid samples computed at once by default: spectra are as wanted at the resolution of half."""


class ScenarioTable(BaseModel):
    """Base of all tables: frozen, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class TemperatureStep(ScenarioTable):
    """Exponential change of the rate by `ppm` from `time` (s) on, with `time_constant` (s)."""

    time: float
    ppm: float
    time_constant: NonNegativeFloat = 60.0


class TemperatureRamp(ScenarioTable):
    """Linear change of the rate by `ppm`, from `time` (s) on, within `duration` (s)."""

    time: float
    ppm: float
    duration: PositiveFloat = 180.0


class TemperatureCycle(ScenarioTable):
    """Change of the rate by `ppm` times the sine of a cycle of `period` (s), from sample 0 on."""

    ppm: float
    period: PositiveFloat = 1200.0


class SensorClock(ScenarioTable):
    """Clock of a sensor.

    Sample n is taken at world time `offset + n / (sampling_rate (1 + ppm 1e-6))` in s, plus the
    effects of `wander` (a random walk of the rate; standard deviation in ppm after one hour) and of
    the temperature: a step, a ramp and a cycle.
    """

    offset: float = 0.0
    ppm: float = Field(default=0.0, ge=-1000.0, le=1000.0)  # as far off as estimates accept
    wander: NonNegativeFloat = 0.0
    step: TemperatureStep | None = None
    ramp: TemperatureRamp | None = None
    cycle: TemperatureCycle | None = None


class SensorResponse(ScenarioTable):
    """Poles and zeros in rad/s as pairs [real, imaginary], of unit gain at `normalised_at` (Hz)."""

    poles: tuple[tuple[float, float], ...]
    zeros: tuple[tuple[float, float], ...] = ()
    normalised_at: PositiveFloat = 1.0


class DeviceTemperature(ScenarioTable):
    """Temperature in °C that a device states of itself.

    `mean` plus the sine of a cycle of `period` (s) with `amplitude`, plus `drift` (K/h). Neither
    noise nor clock follow it.
    """

    mean: float = 25.0
    amplitude: float = 0.5
    period: PositiveFloat = 3600.0
    drift: float = 0.0

    def at(self, times: FloatArray | float) -> FloatArray:
        """Return the temperature at world times in s."""
        hours = np.asarray(times) / 3600.0
        cycle = np.sin(2 * np.pi * np.asarray(times) / self.period)
        found: FloatArray = self.mean + self.amplitude * cycle + self.drift * hours
        return found


class SensorModel(ScenarioTable):
    """One sensor: orientation, gain, delay, response, noise, clock and temperature.

    Channel r reads ``gain[r] · direction[r] · motion(t − delay, position) + noise[r]`` in m/s².
    """

    sampling_rate: PositiveFloat
    rotation: float | tuple[float, float, float] = 0.0
    directions: tuple[tuple[float, ...], ...] | None = None
    gain: float | tuple[float, ...] = 1.0
    delay: float = 0.0
    response: SensorResponse | None = None
    noise: Spectrum | tuple[Spectrum, ...] = White(level=0.0)
    seed: NonNegativeInt | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock: SensorClock = SensorClock()
    temperature: DeviceTemperature = DeviceTemperature()


class ChangingLevel(ScenarioTable):
    """Level of the motion in dB: normal with this `deviation` every `period` in s, and linear."""

    deviation: NonNegativeFloat
    period: PositiveFloat = 60.0


class CommonMotion(ScenarioTable):
    """One motion for all sensors: independent components with these PSDs, then mixed.

    With `mixing` (one row per direction of the world, one column per spectrum) the directions are
    correlated: their cross-PSD matrix is mixing · diag(spectra) · mixingᵀ. The spectra are those at
    a level of 0 dB, where the level changes.
    """

    kind: Literal["common"] = "common"
    spectra: tuple[Spectrum, ...] = Field(min_length=1)
    mixing: tuple[tuple[float, ...], ...] | None = None
    bandwidth: PositiveFloat | None = None
    level: ChangingLevel | None = None

    @property
    def n_dims(self) -> int:
        """Number of directions of the motion."""
        return len(self.spectra if self.mixing is None else self.mixing)

    @model_validator(mode="after")
    def _mixing_fits(self) -> Self:
        if self.n_dims > 3:
            raise ValueError(f"{self.n_dims} directions of motion; the world has at most 3")
        if self.mixing is not None and any(len(row) != len(self.spectra) for row in self.mixing):
            raise ValueError(
                f"each row of mixing must have {len(self.spectra)} values, one per spectrum"
            )
        return self


class PlaneWaves(ScenarioTable):
    """Rayleigh, Love and vertically arriving waves from all directions at one finite speed.

    `spectrum` is the PSD of each direction (x, y, z). A share `from_below` of it arrives
    vertically, equal at all sensors on a level floor. The rest are Rayleigh waves, with
    `ellipticity` the ratio of their horizontal to their vertical axis, and Love waves.
    """

    kind: Literal["plane-waves"] = "plane-waves"
    spectrum: Spectrum
    speed: PositiveFloat = 150.0
    n_directions: PositiveInt = 16
    ellipticity: float = Field(default=0.7, gt=0, le=1)
    from_below: float = Field(default=1 / 3, ge=0, le=1)
    bandwidth: PositiveFloat | None = None

    @property
    def n_dims(self) -> int:
        """Number of directions of the motion."""
        return 3


MotionModel: TypeAlias = Annotated[CommonMotion | PlaneWaves, Field(discriminator="kind")]
