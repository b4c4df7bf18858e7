"""Interface between a simulated device and the line it is served on.

A family module (``sim_devices/devices/<family>.py``) has ``create(spec, source) -> list[Line]``. An
endpoint is sans-IO and uses world time in seconds. :mod:`sim_devices.server.serve` puts each on a
pseudo-terminal or a port, calls it for received bytes and at due times, and writes the returned
bytes. Bytes are returned in units of the device (a frame, a packet, a datagram), so that a fault
can affect exactly one. The samples of its sensors are simulated in stretches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sim_devices.arrays import FloatArray
from sim_devices.faults import SampleFaults
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World

Kind: TypeAlias = Literal["pty", "tcp", "udp", "udp-server"]
"""Kind of a line; "udp" only sends, "udp-server" sends to the last client."""

NEVER = math.inf


class Endpoint:
    """One end of a line: bytes in, bytes out; ``now`` is world time in seconds.

    By default it sends nothing by itself, and nothing belongs to a client.
    """

    def connected(self, now: float) -> Sequence[bytes]:
        """Handle a client that opened the line."""
        self.disconnected(now)
        return ()

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process received bytes; return the reply."""
        del received
        return self.due(now)

    def due(self, now: float) -> Sequence[bytes]:
        """Return the units that the device has sent by itself since the last call."""
        del now
        return ()

    def next_due(self) -> float:
        """Return the world time of the next unit of :meth:`due`; ``NEVER`` before a request."""
        return NEVER

    def disconnected(self, now: float) -> None:
        """Handle the last client that closed the line."""

    def fault(self, kind: str, now: float, duration: float) -> None:
        """Perform a fault of the device's own: "reset" or "overflow"."""
        if kind == "reset":
            self.reset(now)
        elif kind == "overflow":
            self.overflow(now + duration)

    def reset(self, now: float) -> None:
        """Simulate a power failure."""

    def overflow(self, until: float) -> None:
        """Lose what is sampled until then; a device without buffer loses nothing."""


@dataclass(frozen=True, slots=True)
class Line:
    """An endpoint and the kind of line to serve it on.

    ``scheme`` is the start of the printed address of a TCP or UDP line. The first line of a device
    is its port; for others, ``setting`` is the driver's setting for the port number.
    """

    endpoint: Endpoint
    kind: Kind
    scheme: str = "socket"
    setting: str = ""
    carries_samples: bool = True
    """Whether faults of the script affect this line; a pulled cable affects all lines."""
    tls: bool = False
    """Whether a TCP line is encrypted."""


@dataclass(frozen=True, slots=True)
class ChannelSpec:
    """One channel of a sensor, as in the bench file; ``sensitivity`` in counts per unit."""

    name: str
    sensitivity: float
    auxiliary: bool = False


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """One device of a specification (see :mod:`sim_devices.server.serve`)."""

    sensors: tuple[str, ...]
    driver: str
    port: Kind
    sampling_rate: float
    channels: Mapping[str, tuple[ChannelSpec, ...]]
    settings: Mapping[str, Any] = field(default_factory=dict)
    sensor_settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings by sensor, if the sensors of one port differ (slaves on one bus)."""
    utc_ns: int = 0
    """UTC at world time 0 in ns, for devices with UTC."""
    model: str = ""
    serial_number: str = ""


class Source:
    """Readings of a device's sensors in counts, and their times.

    Parameters
    ----------
    scenario
        The world in the specification.
    device
        The device with the sensors.
    sampling_rate
        In Hz; default: the device's rate. The simulated motion does not depend on the rate.
    faults
        Faults that change samples.
    """

    def __init__(
        self,
        scenario: Scenario,
        device: DeviceSpec,
        sampling_rate: float | None = None,
        *,
        faults: SampleFaults | None = None,
    ) -> None:
        self._faults = faults
        self.sampling_rate = sampling_rate or device.sampling_rate
        self.device = device
        self._scenario = scenario
        table = scenario.to_dict()
        table["motion"]["bandwidth"] = scenario.bandwidth
        for sensor in device.sensors:
            table["sensors"][sensor]["sampling_rate"] = self.sampling_rate
        self._simulated = Scenario.from_dict(table)
        self._world = World(self._simulated)
        self._slips: dict[str, _Slips] = {}

    def at_rate(self, sampling_rate: float) -> Source:
        """Return a source with the same world and another sampling rate."""
        return Source(self._scenario, self.device, sampling_rate, faults=self._faults)

    def disciplined(self, offset: float) -> Source:
        """Return a source sampled without drift, from ``offset`` s after world time 0 on."""
        table = self._scenario.to_dict()
        for sensor in self.device.sensors:
            table["sensors"][sensor]["clock"] = {"offset": offset}
        scenario = Scenario.from_dict(table)
        return Source(scenario, self.device, self.sampling_rate, faults=self._faults)

    def counts(self, sensor: str, first_sample: int, n: int) -> NDArray[np.float64]:
        """Return the main channels in counts, neither rounded nor clipped, (n, n_channels)."""
        if not n:
            return self._world.samples(sensor, first_sample, n) * self._sensitivities[sensor]
        index, _ = self._counted(sensor, first_sample, n)
        first, rows = int(index.min()), index - index.min()
        samples: FloatArray = self._world.samples(sensor, first, int(rows.max()) + 1)[rows]
        if self._faults is None:
            return samples * self._sensitivities[sensor]
        times = self.times(sensor, first_sample, n)
        moved = self._faults.is_moved(sensor, times)
        if moved.any():
            other = self._other_floor.samples(sensor, first, int(rows.max()) + 1)[rows]
            samples[moved] = other[moved]
        return self._faults.apply(sensor, samples * self._sensitivities[sensor], times)

    def times(self, sensor: str, first_sample: int, n: int) -> FloatArray:
        """Return the world time of each sample in s, shape (n,)."""
        if not n:
            return np.empty(0)
        _, index = self._counted(sensor, first_sample, n)
        first = int(index.min())
        times = self._world.sample_times(sensor, first, int(index.max()) - first + 1)
        at: FloatArray = times[index - first]
        return at

    def temperature(self, sensor: str, times: FloatArray | float) -> FloatArray:
        """Return the temperature of a sensor's device in °C at world times in s."""
        return self._simulated.sensors[sensor].temperature.at(times)

    def stated_ns(self, sensor: str, utc_ns: int) -> int:
        """Return what the device states where UTC is ``utc_ns``."""
        return utc_ns if self._faults is None else self._faults.stated_ns(sensor, utc_ns)

    def _counted(
        self, sensor: str, first_sample: int, n: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return which samples of the sensor the device counts as these.

        The second array is for their times: a sample that is counted again comes without delay.
        """
        index = first_sample + np.arange(n)
        if self._faults is None:
            return index, index
        slips = self._slips.setdefault(sensor, _Slips(self._faults.slips(sensor)))
        return slips.counted(index, lambda at: self._first_taken_after(sensor, at))

    def is_silent(self, sensor: str, now: float) -> bool:
        """Return whether a fault switches this unit of a shared line off at ``now``."""
        return self._faults is not None and self._faults.is_silent(sensor, now)

    def first_sample_after(self, sensor: str, now: float) -> int:
        """Return the index of the first sample taken at or after world time ``now``."""
        return self._first_after(now, partial(self.times, sensor))

    def _first_taken_after(self, sensor: str, now: float) -> int:
        """Return :meth:`first_sample_after` without slips of the device's counter."""
        return self._first_after(now, partial(self._world.sample_times, sensor))

    def _first_after(self, now: float, times: Callable[[int, int], FloatArray]) -> int:
        guess = max(0, math.floor((now - float(times(0, 1)[0])) * self.sampling_rate))
        while guess > 0 and float(times(guess, 1)[0]) >= now:
            guess = max(0, guess - max(1, round(guess * 1e-4)))
        while True:
            later = np.flatnonzero(times(guess, 256) >= now)
            if later.size:
                return guess + int(later[0])
            guess += 256

    @cached_property
    def _other_floor(self) -> World:
        return World(self._simulated, floor=1)

    @cached_property
    def _sensitivities(self) -> dict[str, FloatArray]:
        return {
            sensor: np.array([c.sensitivity for c in channels if not c.auxiliary])
            for sensor, channels in self.device.channels.items()
        }


class _Slips:
    """Where a device's counter skips or repeats samples of its sensor without saying so."""

    def __init__(self, planned: Iterator[tuple[float, int]]) -> None:
        self._planned = planned
        self._next = next(planned, None)
        self._starts, self._shifts, self._repeats = [0], [0], [0]

    def counted(
        self, index: NDArray[np.int64], first_taken_after: Callable[[float], int]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the samples counted as ``index``, and those at whose times they come."""
        while self._next is not None:
            at, skipped = self._next
            taken = first_taken_after(at)
            start = taken - self._shifts[-1]
            if start > index[-1]:
                break
            self._starts.append(max(start, self._starts[-1]))
            self._shifts.append(self._shifts[-1] + max(skipped, -taken))
            self._repeats.append(min(max(0, -skipped), taken))
            self._next = next(self._planned, None)
        which = np.searchsorted(self._starts, index, side="right") - 1
        starts, repeats = np.array(self._starts)[which], np.array(self._repeats)[which]
        counted = index + np.array(self._shifts)[which]
        held = starts + np.array(self._shifts)[which] + repeats - 1
        return counted, np.where(index - starts < repeats, held, counted)


AHEAD = 1.0
"""Duration of a stretch, s of world time."""


class Samples:
    """Samples of sensors with one clock, by index; the columns are the channels of all sensors.

    Times and counts are cached separately, because a device with a buffer needs the times of new
    samples and the counts of older ones.

    Parameters
    ----------
    source
        Readings of the sensors. Sample times are those of the first sensor.
    sensors
        Names of the sensors, in the order of the columns.
    """

    def __init__(self, source: Source, sensors: Sequence[str]) -> None:
        self._source = source
        self._sensors = tuple(sensors)
        self._length = max(16, math.ceil(AHEAD * source.sampling_rate))
        self._first_time = self._first_count = 0
        self._times: FloatArray = np.empty(0)
        self._counts: NDArray[np.float64] = np.empty((0, 0))

    @property
    def n_channels(self) -> int:
        """Number of columns."""
        return int(self.counts(0, 1).shape[1])

    def first_after(self, now: float) -> int:
        """Return the index of the first sample taken at or after world time ``now``."""
        return self._source.first_sample_after(self._sensors[0], now)

    def time(self, index: int) -> float:
        """Return the world time of a sample, s."""
        self._hold_times(index)
        return float(self._times[index - self._first_time])

    def end_before(self, now: float, start: int) -> int:
        """Return the index after the last sample taken by ``now``; at least ``start``."""
        self._hold_times(start)
        if self._times[-1] <= now:  # skip stretches: the last call may have been hours ago
            self._hold_times(self.first_after(now))
        return self._first_time + int(np.searchsorted(self._times, now, side="right"))

    def counts(self, first: int, n: int) -> NDArray[np.float64]:
        """Return samples in counts, neither rounded nor clipped, shape (n, n_channels)."""
        pieces: list[NDArray[np.float64]] = []
        while n > 0:
            self._hold_counts(first)
            row = first - self._first_count
            pieces.append(self._counts[row : row + n])
            first += len(pieces[-1])
            n -= len(pieces[-1])
        return np.concatenate(pieces) if pieces else self._counts[:0]

    def _hold_times(self, index: int) -> None:
        """Compute the times of the stretch with a sample."""
        if not 0 <= index - self._first_time < len(self._times):
            self._first_time = index // self._length * self._length
            self._times = self._source.times(self._sensors[0], self._first_time, self._length)

    def _hold_counts(self, index: int) -> None:
        """Simulate the stretch with a sample."""
        if not 0 <= index - self._first_count < len(self._counts):
            first = self._first_count = index // self._length * self._length
            columns = [self._source.counts(s, first, self._length) for s in self._sensors]
            self._counts = np.concatenate(columns, axis=1)


def whole(counts: NDArray[np.float64], low: int, high: int) -> NDArray[np.int64]:
    """Round counts to integers and clip them to ``low`` and ``high``."""
    return np.clip(np.rint(counts), low, high).astype(np.int64)
