"""The simulated motion and sensors: the table `[simulation]` of a bench file.

A scenario describes one common motion and its sensors. All processes with the same table simulate
the same world: every quantity is the same function of time.

Example from a bench file (SI units, angles in degrees, spectra one-sided)::

    [simulation]
    seed = 7

    [simulation.motion]                     # three directions: x, y, z (upwards)
    spectra = [
        {shape = "white", level = 1e-9},
        {shape = "white", level = 1.5e-9},
        {shape = "sum", terms = [
            {shape = "white", level = 1e-9},
            {shape = "resonance", level = 1e-7, frequency = 8, damping = 0.02}]},
    ]

    [simulation.sensors.A]                  # the sensor's name in the bench file
    noise = {shape = "mixed", level = 1e-13}            # one for all channels, or one per channel

    [simulation.sensors.B]
    rotation = 10.0                         # about z; or [about z, about y, about x]
    gain = [1.0, 1.01, 0.99]
    delay = 0.0005                          # measures the motion half a millisecond late
    noise = {shape = "white", level = 1e-13}
    clock = {offset = 0.3, ppm = 15.0, wander = 0.05}

    [simulation.sensors.C]
    directions = [[1, 0, 0], [1, 2, 0], [0, 0, 1]]      # one row per channel, at any angles
    noise = [{shape = "white", level = 1e-13}, {shape = "pink", level = 1e-13},
             {shape = "white", level = 2e-13}]
    seed = 3                                # of this sensor's noise and clock

A field of plane waves instead of one common motion; distant sensors are not coherent::

    [simulation.motion]
    kind = "plane-waves"
    spectrum = {shape = "white", level = 1e-9}
    speed = 150.0

    [simulation.sensors.A]
    position = [0.12, 0.0, 0.0]             # metres
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, NonNegativeInt, ValidationError, model_validator

from sim_devices.arrays import FloatArray
from sim_devices.errors import ScenarioError
from sim_devices.world.spectrum import Spectrum
from sim_devices.world.tables import MAX_BLOCK, USABLE, MotionModel, ScenarioTable, SensorModel

OTHER_KEYS = frozenset({"speed", "clock", "devices", "faults"})
"""Keys of the `[simulation]` table that other modules read."""


class Scenario(ScenarioTable):
    """A motion and its sensors."""

    seed: NonNegativeInt = 0
    motion: MotionModel
    sensors: dict[str, SensorModel] = Field(min_length=1)
    longest_block: Literal[4096, 65536] = MAX_BLOCK
    """Grid samples computed at once; 4096, for smooth spectra, is quicker to begin."""

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], *, sampling_rate: float | None = None) -> Scenario:
        """Read a table such as `[simulation]` of a bench file.

        Parameters
        ----------
        table
            The schema of this module; `speed`, `clock`, `devices` and `faults` are ignored.
        sampling_rate
            Sampling rate in Hz of sensors without their own.

        Raises
        ------
        ScenarioError
            With key, value and expectation of every error.
        """
        own: dict[str, Any] = {key: value for key, value in table.items() if key not in OTHER_KEYS}
        motion = own.get("motion")
        if isinstance(motion, dict):
            own["motion"] = {"kind": "common", **motion}
        sensors = own.get("sensors")
        if sampling_rate is not None and isinstance(sensors, dict):
            own["sensors"] = {
                name: {"sampling_rate": sampling_rate, **sensor}
                if isinstance(sensor, dict)
                else sensor
                for name, sensor in sensors.items()
            }
        try:
            return cls.model_validate(own)
        except ValidationError as error:
            raise ScenarioError(*_problems(error, own)) from error

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as a table of TOML and JSON values, without `None`."""
        return self.model_dump(mode="json", exclude_none=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors, in order."""
        return tuple(self.sensors)

    def n_channels(self, sensor: str) -> int:
        """Return the number of channels of a sensor."""
        directions = self.sensor(sensor).directions
        return self.motion.n_dims if directions is None else len(directions)

    def noise_spectra(self, sensor: str) -> tuple[Spectrum, ...]:
        """Return the noise of every channel of a sensor."""
        noise = self.sensor(sensor).noise
        return noise if isinstance(noise, tuple) else (noise,) * self.n_channels(sensor)

    def gains(self, sensor: str) -> FloatArray:
        """Return the gain of every channel, shape (n_channels,)."""
        return np.broadcast_to(
            np.asarray(self.sensor(sensor).gain, dtype=float), self.n_channels(sensor)
        )

    def directions(self, sensor: str) -> FloatArray:
        """Return the direction cosines of the channels, shape (n_channels, n_dims): R of (16)."""
        model, d = self.sensor(sensor), self.motion.n_dims
        rows = np.eye(d) if model.directions is None else np.array(model.directions)
        rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        return np.asarray(rows @ _rotation(model.rotation)[:d, :d].T)

    @property
    def bandwidth(self) -> float:
        """Return the bandwidth of the motion in Hz: complete up to it, zero from 10/9 of it on."""
        if self.motion.bandwidth is not None:
            return self.motion.bandwidth
        return USABLE * min(sensor.sampling_rate for sensor in self.sensors.values()) / 2

    def true_noise_psd(self, sensor: str, channel: int, frequency: FloatArray) -> FloatArray:
        """Return the one-sided noise PSD of a channel in (m/s²)²/Hz at `frequency` (Hz)."""
        return self.noise_spectra(sensor)[channel].psd(np.asarray(frequency, dtype=float))

    def sensor(self, name: str) -> SensorModel:
        """Return the table of one sensor.

        Raises
        ------
        ScenarioError
            If no sensor has this name; the message lists all names.
        """
        try:
            return self.sensors[name]
        except KeyError:
            raise ScenarioError(
                f"no sensor {name!r} in the simulation; it has {', '.join(self.sensors)}"
            ) from None

    @model_validator(mode="after")
    def _fits(self) -> Self:
        d = self.motion.n_dims
        faults = []
        for name, sensor in self.sensors.items():
            n_channels = self.n_channels(name)
            if sensor.directions is not None:
                faults += [
                    f"sensors.{name}.directions: {list(row)} has {len(row)} values;"
                    f" expected {d}, like the motion, not all zero"
                    for row in sensor.directions
                    if len(row) != d or not any(row)
                ]
            for key, value in (("gain", sensor.gain), ("noise", sensor.noise)):
                if isinstance(value, tuple) and len(value) != n_channels:
                    faults.append(
                        f"sensors.{name}.{key}: {len(value)} values;"
                        f" expected one, or {n_channels}, one per channel"
                    )
            turned = np.flatnonzero(np.atleast_1d(sensor.rotation)).tolist()
            if d < 3 and any(axis > 0 or d == 1 for axis in turned):
                faults.append(
                    f"sensors.{name}.rotation: {sensor.rotation} leaves the {d} directions"
                    f" of the motion; expected {'one angle' if d == 2 else 'none'}"
                )
        if faults:
            raise ValueError("; ".join(faults))
        return self


def _rotation(angles: float | tuple[float, float, float]) -> FloatArray:
    """Return the rotation (3, 3) about z, then the new y, then the new x, by angles in degrees."""
    yaw, pitch, roll = np.radians(angles if isinstance(angles, tuple) else (angles, 0.0, 0.0))
    (cz, cy, cx), (sz, sy, sx) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.asarray(about_z @ about_y @ about_x)


def _problems(error: ValidationError, table: Mapping[str, Any]) -> list[str]:
    """Return all errors: key = value, and the expectation."""
    expected: dict[str, list[str]] = {}
    for fault in error.errors(include_url=False):
        key = "simulation"
        given: Any = table
        for part in fault["loc"]:  # a path also has names of alternatives, which are no keys
            if isinstance(given, dict) and part in given:
                key, given = f"{key}.{part}", given[part]
            elif isinstance(given, list | tuple) and isinstance(part, int):
                key, given = f"{key}[{part}]", given[part]
        if fault["type"] == "missing":
            key = f"{key}.{fault['loc'][-1]}"
        elif not isinstance(given, dict):
            key = f"{key} = {given!r}"
        expected.setdefault(key, []).append(fault["msg"])
    return [f"{key}: {', or '.join(messages)}" for key, messages in expected.items()]
