"""Validates the items of drivers, so that an error in one driver does not affect other devices.

Drivers may come from any package. A block that the file cannot hold would end the whole recording.
Validation ends only the session of its port, with an error that names the fault.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.errors import DeviceError
from daq.protocols.block import Block, Event, Reading

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.bench.model import Sensor
    from daq.devices.interface import AnyDriver
    from daq.protocols.block import DeviceItem, HostTime

_MIN_INT64, _MAX_INT64 = -(1 << 63), (1 << 63) - 1
_MAX_FLAGS = (1 << 31) - 1
_MAX_FIRST_SAMPLE = _MAX_INT64 // 4
_TIMES = "expected a HostTime with two integers of 64 bits"


class FaultyDriverError(DeviceError, TypeError):
    """A driver yielded something other than a valid block, event or reading of its sensors."""


class BlockValidator:
    """Validates the items of one session.

    Parameters
    ----------
    driver : AnyDriver
    sensors : sequence of Sensor
        All sensors on the port.
    """

    def __init__(self, driver: AnyDriver, sensors: Sequence[Sensor]) -> None:
        self._driver = driver.name
        self._port = sensors[0].port
        self._n_channels = {sensor.name: len(sensor.channels) for sensor in sensors}
        self._dtypes = {sensor.name: driver.counts_dtype(sensor) for sensor in sensors}
        self._polled: dict[str, bool] = {}

    def validated(self, item: object) -> DeviceItem:
        """Return the item if it is valid.

        Raises
        ------
        FaultyDriverError
            If it is not; the message has the yielded and the expected item.
        """
        if isinstance(item, Block):
            problem = self._block_problem(item)
        elif isinstance(item, Event):
            problem = self._event_problem(item)
        elif isinstance(item, Reading):
            problem = self._reading_problem(item)
        else:
            problem = f"{type(item).__name__}; expected a Block, an Event or a Reading"
        if not problem and isinstance(item, (Block, Event, Reading)):
            return item
        raise FaultyDriverError(f"{self._port}: driver {self._driver!r} yielded {problem}")

    def _block_problem(self, block: Block) -> str:
        if block.sensor not in self._n_channels:
            return f"a block of {block.sensor!r}; expected {self._expected_names()}"
        wanted = self._n_channels[block.sensor]
        shape = _shape(block.counts)
        if shape is None or len(shape) != 2 or shape[1] != wanted:
            return f"counts of shape {shape}; expected an array (n_samples, {wanted})"
        if not shape[0]:
            return "a block without samples"
        return (
            self._counts_problem(block) or _number_problem(block) or self._instants_problem(block)
        )

    def _counts_problem(self, block: Block) -> str:
        counts, expected = block.counts, self._dtypes[block.sensor]
        if np.can_cast(counts.dtype, expected, "safe"):
            return ""
        with np.errstate(invalid="ignore"):
            fits = counts.dtype.kind in "iuf" and np.array_equal(counts.astype(expected), counts)
        return "" if fits else f"counts of type {counts.dtype} that do not fit {expected}"

    def _instants_problem(self, block: Block) -> str:
        instants = block.instants_ns
        polled = self._polled.setdefault(block.sensor, instants is not None)
        if polled != (instants is not None):
            return "blocks with sample times and others without; expected one kind"
        if instants is None:
            return ""
        if _shape(instants) != (block.n_samples,) or instants.dtype != np.int64:
            return f"sample times of shape {_shape(instants)}; expected int64 ({block.n_samples},)"
        return ""

    def _event_problem(self, event: Event) -> str:
        if event.sensor and event.sensor not in self._n_channels:
            return f"an event of {event.sensor!r}; expected {self._expected_names()}"
        if not _are_texts(event.kind, event.text):
            return f"an event {event.kind!r}, {event.text!r}; expected text"
        return (
            ""
            if _are_times(event.received)
            else f"an event received at {event.received!r}; {_TIMES}"
        )

    def _reading_problem(self, reading: Reading) -> str:
        if reading.sensor not in self._n_channels:
            return f"a reading of {reading.sensor!r}; expected {self._expected_names()}"
        if not _are_texts(reading.quantity) or not _is_finite(reading.value):
            return f"a reading {reading.quantity!r}, {reading.value!r}; expected text and a number"
        return (
            ""
            if _are_times(reading.received)
            else f"a reading received at {reading.received!r}; {_TIMES}"
        )

    def _expected_names(self) -> str:
        return " or ".join(map(repr, self._n_channels))


def _number_problem(block: Block) -> str:
    if not _is_int64(block.first_sample) or not 0 <= block.first_sample <= _MAX_FIRST_SAMPLE:
        return f"a block with first_sample {block.first_sample!r}; expected 0 or more"
    if block.device_counter is not None and not _is_int64(block.device_counter):
        return (
            f"a block with device_counter {block.device_counter!r}; expected an integer of 64 bits"
        )
    if not _is_int64(block.flags) or not 0 <= block.flags <= _MAX_FLAGS:
        return f"a block with flags {block.flags!r}; expected 0 to {_MAX_FLAGS}"
    if not _are_texts(block.reason):
        return f"a block with reason {block.reason!r}; expected text"
    return "" if _are_times(block.received) else f"a block received at {block.received!r}; {_TIMES}"


def _shape(array: object) -> tuple[int, ...] | None:
    return array.shape if isinstance(array, np.ndarray) else None


def _are_texts(*values: object) -> bool:
    return all(isinstance(value, str) for value in values)


def _are_times(at: HostTime) -> bool:
    return all(_is_int64(getattr(at, name, None)) for name in ("monotonic_ns", "utc_ns"))


def _is_finite(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)


def _is_int64(value: Any) -> bool:  # noqa: ANN401 -- a driver may yield anything
    return isinstance(value, (int, np.integer)) and _MIN_INT64 <= int(value) <= _MAX_INT64
