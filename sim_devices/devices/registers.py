"""Simulated devices with readings in Modbus registers, one or several on a bus.

A device samples at its own rate and holds the latest reading, with counter and time if the map has
them. All its registers are writable, including WitMotion's unlock and rate registers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pymodbus.constants import ExcCodes

from daq.devices.modbus.registers_protocol import (
    PRESETS,
    WITMOTION_RATE,
    WITMOTION_UNLOCK,
    RegisterMap,
)
from sim_devices.devices.interface import Line
from sim_devices.devices.modbus import ModbusEndpoint

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sim_devices.devices.interface import DeviceSpec, Source

BEGINNING = np.datetime64("2026-11-21T00:00:00", "ns").astype(np.int64).item()
"""UTC of the device's clock at world time 0, in ns."""
AHEAD = 256
"""Number of samples simulated per call."""


class RegisterDevice:
    """One slave; see :class:`sim_devices.devices.modbus.Slave`."""

    def __init__(self, sensor: str, settings: Mapping[str, Any], source: Source) -> None:
        self._sensor = sensor
        self._source = source
        n_channels = len(source.device.channels[sensor])
        self._map = RegisterMap.of(settings, n_channels)
        self._main = [not channel.auxiliary for channel in source.device.channels[sensor]]
        self._at_first: dict[int, int] = {}
        if settings.get("preset") == "witmotion":
            self._at_first = {WITMOTION_RATE: 6, WITMOTION_UNLOCK[0]: 0}
        self._written = dict(self._at_first)
        self._first = 0
        self._times = np.empty(0)
        self._counts = np.empty((0, 0))

    def is_off(self, now: float) -> bool:
        """Return whether the fault script switches the device off; its settings are then lost."""
        off = self._source.is_silent(self._sensor, now)
        if off:
            self._written = dict(self._at_first)
        return off

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int] | ExcCodes:
        """Return registers of the latest reading."""
        held = dict(self._written) if function == 3 else {}
        if function == self._map.function:
            held |= self._latest(now)
        wanted = range(address, address + count)
        if not all(register in held for register in wanted):
            return ExcCodes.ILLEGAL_ADDRESS
        return [held[register] for register in wanted]

    def write(self, address: int, values: Sequence[int], now: float) -> ExcCodes | None:
        """Set configuration registers; writes to the time have no effect."""
        held = {**self._written, **self._latest(now)}
        if any(address + k not in held for k in range(len(values))):
            return ExcCodes.ILLEGAL_ADDRESS
        for k, value in enumerate(values):
            if address + k in self._written:
                self._written[address + k] = value
        return None

    def _latest(self, now: float) -> dict[int, int]:
        row = int(np.searchsorted(self._times, now, side="right")) - 1
        if not 0 <= row < self._times.size - 1:
            self._first = max(0, self._source.first_sample_after(self._sensor, now) - 1)
            self._times = self._source.times(self._sensor, self._first, AHEAD)
            self._counts = self._source.counts(self._sensor, self._first, AHEAD)
            row = max(0, int(np.searchsorted(self._times, now, side="right")) - 1)
        counts = np.zeros(len(self._main))
        counts[self._main] = self._counts[row]
        return self._map.encode(
            counts,
            counter=self._first + row,
            time_ns=BEGINNING + round(float(self._times[row]) * 1e9),
        )


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the one line of all sensors on the bus."""
    slaves: dict[int, RegisterDevice] = {}
    for sensor in device.sensors:
        settings = device.sensor_settings.get(sensor, device.settings)
        preset = PRESETS.get(settings.get("preset") or "", {})
        slave = int(settings.get("device_id", preset.get("device_id", 1)))
        slaves[slave] = RegisterDevice(sensor, settings, source)
    if device.port == "tcp":
        return [Line(ModbusEndpoint(slaves, "tcp"), "tcp", scheme="modbus-tcp")]
    return [Line(ModbusEndpoint(slaves, "rtu"), device.port)]
