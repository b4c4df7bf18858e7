"""A simulated vibration unit: samples into a FIFO, read in blocks over Modbus RTU.

Simulated functions, according to public clients: slave 1; function 6 on register 1 for the sampling
rate; function 4 on register 2 for the level and at most 123 words, in complete samples of all
channels; a full FIFO drops new samples. The setting ``header`` is the meaning of the first
register, ``capacity`` the size of the FIFO in words. A reply is returned when its last byte has
been transmitted at the line's rate, after a turnaround of 1 ms.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from daq.devices.modbus import rtu
from daq.devices.modbus.fifo_protocol import FIFO_REGISTER, MAX_WORDS, RATE_REGISTER
from daq.devices.modbus.rtu import RequestFinder, RtuRequest
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Samples, Source, whole

TURNAROUND = 0.001
CAPACITY = 24_576
LOWEST_RATE, HIGHEST_RATE = 1, 20_000


class FifoDevice(Endpoint):
    """One unit on a serial line; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        settings = device.settings
        self._source = source
        self._sensors = device.sensors
        self._unit = int(settings.get("unit", 1))
        self._left = settings.get("header", "size") == "left"
        self._byte_time = 10 / float(settings.get("baud_rate", 3_000_000))
        self._requests = RequestFinder(self._unit)
        self._rate = round(device.sampling_rate)
        self._samples = Samples(source, device.sensors)
        self._n_channels = self._samples.n_channels
        self._capacity = int(settings.get("capacity") or CAPACITY) // self._n_channels
        self._next = self._samples.first_after(0.0)
        self._first = self._end = self._next  # the FIFO holds samples _first to _end, except
        self._holes: deque[tuple[int, int]] = deque()  # the dropped samples
        self._to_send: deque[tuple[float, bytes]] = deque()

    # --- Endpoint ----------------------------------------------------------------------------

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Discard unsent replies."""
        self._to_send.clear()

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process requests to this unit."""
        for request in self._requests.receive(received):
            self._advance(now)
            reply = self._answer(request)
            ready = max(now, self._to_send[-1][0] if self._to_send else now)
            self._to_send.append((ready + TURNAROUND + len(reply) * self._byte_time, reply))
        return self.due(now)

    def reset(self, now: float) -> None:
        """Simulate a power failure: the content of the FIFO is lost."""
        self._advance(now)
        self._first = self._end = self._next
        self._holes.clear()

    def due(self, now: float) -> Sequence[bytes]:
        """Return the completely transmitted replies."""
        sent: list[bytes] = []
        while self._to_send and self._to_send[0][0] <= now:
            sent.append(self._to_send.popleft()[1])
        return sent

    def next_due(self) -> float:
        """Return the world time at which the next reply is completely transmitted."""
        return self._to_send[0][0] if self._to_send else NEVER

    # --- registers ---------------------------------------------------------------------------

    def _answer(self, request: RtuRequest) -> bytes:
        function = request.function
        if function == rtu.WRITE_SINGLE and request.address == RATE_REGISTER:
            if not LOWEST_RATE <= request.value <= HIGHEST_RATE:
                return rtu.encode_exception(self._unit, function, 3)
            self._set_rate(request.value)
            return rtu.write_request(self._unit, request.address, request.value)
        if function not in (rtu.READ_HOLDING, rtu.READ_INPUT):
            return rtu.encode_exception(self._unit, function, 1)
        if request.address == RATE_REGISTER and request.value == 1:
            return rtu.encode_registers(self._unit, function, np.array([self._rate], np.uint16))
        n_samples, odd = divmod(request.value - 1, self._n_channels)
        if request.address != FIFO_REGISTER or odd or not 0 <= request.value - 1 <= MAX_WORDS:
            return rtu.encode_exception(self._unit, function, 2)
        return self._read(function, n_samples)

    def _set_rate(self, rate: int) -> None:
        if rate != self._rate:
            self._rate = rate
            self._samples = Samples(self._source.at_rate(float(rate)), self._sensors)
            self._next = 0  # set again from the clock
            self._holes.clear()
            self._first = self._end = -1

    def _advance(self, now: float) -> None:
        """Take the samples up to ``now``; drop them if the FIFO is full."""
        if self._end < 0:
            self._first = self._end = self._next = self._samples.first_after(now)
        end = self._samples.end_before(now, self._next)
        room = max(0, self._capacity - self._waiting)
        taken = min(room, end - self._next)
        if taken and self._next > self._end:  # samples were dropped before these
            self._holes.append((self._end, self._next))
        if taken:
            self._end = self._next + taken
        self._next = end

    @property
    def _waiting(self) -> int:
        """Number of samples in the FIFO."""
        return self._end - self._first - sum(stop - start for start, stop in self._holes)

    def _read(self, function: int, n_samples: int) -> bytes:
        waiting = self._waiting
        rows = []
        left = min(n_samples, waiting)
        while left:
            stop = self._holes[0][0] if self._holes else self._end
            n = min(left, stop - self._first)
            rows.append(whole(self._samples.counts(self._first, n), -32768, 32767))
            self._first += n
            left -= n
            if self._holes and self._first == self._holes[0][0]:
                self._first = self._holes.popleft()[1]
        words = np.concatenate(rows).ravel() if rows else np.empty(0, np.int64)
        words = np.concatenate((words, np.zeros(n_samples * self._n_channels - len(words), int)))
        level = (self._waiting if self._left else waiting) * self._n_channels
        registers = np.concatenate(([min(level, 65535)], words)).astype(np.int64)
        return rtu.encode_registers(self._unit, function, (registers & 0xFFFF).astype(np.uint16))


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the unit's one line."""
    return [Line(FifoDevice(device, source), device.port)]
