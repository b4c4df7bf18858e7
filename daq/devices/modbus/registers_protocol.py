"""Samples in Modbus registers: addresses, data types, and times.

Theory of operation
-------------------
The host polls the registers that hold all channels and, if the device has them, a counter and a
time. One request keeps the values consistent; several are needed if one reply cannot hold them, or
if the device refuses the registers between them. Each poll is one *reading*, that is one sample.
Its instant is the device's time if the device sends one, else halfway between first request and
last reply. Readings are collected and decoded together. Index and nominal rate only number the
samples; the instants are their times. Samples are missing between two instants more than ``GAP``
periods apart. A reading with the counter or time of the reading before repeats it, and is dropped.

The simulated device encodes with the same map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daq.protocols.block import Block, BlockFlag, CountsArray, Event, EventKind, HostTime
from daq.protocols.errors import DeviceSettingError, RemoteProtocolError, several

DataType: TypeAlias = Literal[
    "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"
]
WordOrder: TypeAlias = Literal["big", "little"]
TimeFormat: TypeAlias = Literal["witmotion", "uint32-s", "uint32-ms", "uint32-us", "uint64-ns"]

MAX_REGISTERS = 125
"""Maximum number of registers in one Modbus reply."""
N_ADDRESSES = 65536
BLOCK_DURATION = 0.25
"""Host time per block, s."""
GAP = 2.5
"""Minimum gap, in sample periods: polls jitter, so that one reading may be late."""
JUMP_NS = 100_000_000
"""Step of the device's time, in ns; a gateway may keep readings for less."""
_STALE_NS = 1e9  # age of the first reading at most
_FAR_NS = 1 << 62
DRIFT = 200e-6
"""Largest relative rate error of a device's time."""

_TICK_NS = {"uint32-s": 10**9, "uint32-ms": 10**6, "uint32-us": 10**3, "uint64-ns": 1}
_TIME_WORDS = {"witmotion": 4, "uint64-ns": 4}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "witmotion": {
        "device_id": 0x50,
        "function": 3,
        "address": 0x34,
        "data_type": "int16",
        "time_address": 0x30,
        "time_format": "witmotion",
    },
    "labjack-ain": {"device_id": 1, "function": 4, "address": 0, "data_type": "float32"},
}
"""Settings of each preset; explicit settings override them."""

WITMOTION_UNLOCK = (0x69, 0xB588)
WITMOTION_RATE = 0x03
WITMOTION_RATES = {10.0: 6, 50.0: 8, 100.0: 9, 200.0: 0x0B}
"""Sampling rate in Hz → RRATE."""


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """Addresses and data types of the readings of one sensor.

    ``word_order`` is the order of the registers of one value: most significant word first
    (``"big"``) or last. Within a register the bytes are big-endian.
    """

    function: int
    addresses: tuple[int, ...]
    data_type: DataType = "int16"
    word_order: WordOrder = "big"
    counter_address: int | None = None
    """Address of a 16-bit counter that changes with each sample of the device."""
    time_address: int | None = None
    time_format: TimeFormat = "uint32-ms"

    @classmethod
    def of(cls, settings: Mapping[str, Any], n_channels: int) -> RegisterMap:
        """Return the map for settings of a bench file.

        Parameters
        ----------
        settings
            ``preset`` and keys of this class; ``address`` of the first channel if the channels
            are contiguous, or ``addresses``.
        n_channels
            Number of channels of the sensor.

        Raises
        ------
        DeviceSettingError
            If a setting is wrong.
        """
        given = {key: value for key, value in settings.items() if value is not None}
        chosen = {**PRESETS.get(given.get("preset", ""), {}), **given}
        words = np.dtype(chosen.get("data_type", "int16")).itemsize // 2
        if "addresses" in chosen:
            addresses = tuple(chosen["addresses"])
        elif "address" in chosen:
            addresses = tuple(chosen["address"] + words * k for k in range(n_channels))
        else:
            raise DeviceSettingError("address", "is missing; expected the first channel's address")
        if len(addresses) != n_channels:
            raise DeviceSettingError(
                "addresses", f"{len(addresses)} given; expected {n_channels}, one a channel"
            )
        if "time_format" in chosen and "time_address" not in chosen:
            raise DeviceSettingError("time_format", "expected with time_address only")
        names = {field.name for field in fields(cls)}
        own = {key: value for key, value in chosen.items() if key in names}
        found = cls(**{"function": 3, **own, "addresses": addresses})
        end = max(address + words for address, words in found._extents)
        if end > N_ADDRESSES:
            raise DeviceSettingError(
                "", f"registers up to {end - 1}; expected at most {N_ADDRESSES - 1}, the last one"
            )
        return found

    @property
    def resolution_ns(self) -> int:
        """Resolution of the device's time, in ns."""
        return _TICK_NS.get(self.time_format, 10**6)

    @property
    def _extents(self) -> list[tuple[int, int]]:
        words = self.dtype.itemsize // 2
        extents = [(address, words) for address in self.addresses]
        if self.counter_address is not None:
            extents.append((self.counter_address, 1))
        if self.time_address is not None:
            extents.append((self.time_address, _TIME_WORDS.get(self.time_format, 2)))
        return extents

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the counts."""
        return np.dtype(self.data_type)

    @property
    def needed(self) -> tuple[int, ...]:
        """Addresses of all used registers, ascending: the columns of a reading."""
        return tuple(sorted({a + k for a, words in self._extents for k in range(words)}))

    def reads(self, *, apart: bool = False) -> tuple[tuple[int, int], ...]:
        """Return first address and number of registers of each request.

        The requests are as few as possible, of at most ``MAX_REGISTERS`` each, and split no value.
        With ``apart`` they also contain no unused register.
        """
        reads: list[tuple[int, int]] = []
        for address, words in sorted(self._extents):
            first, count = reads[-1] if reads else (address, 0)
            end = max(first + count, address + words)
            joins = address <= first + count or not apart
            if reads and joins and end - first <= MAX_REGISTERS:
                reads[-1] = (first, end - first)
            else:
                reads.append((address, words))
        return tuple(reads)

    def __str__(self) -> str:
        """Return the ranges of registers to read."""
        return ", ".join(
            f"{first} to {first + count - 1} ({first:#06x} to {first + count - 1:#06x})"
            for first, count in self.reads()
        )

    def counts(self, registers: NDArray[np.uint16]) -> CountsArray:
        """Decode readings: registers (n, n_needed) → counts (n, n_channels) of :attr:`dtype`."""
        start = np.searchsorted(self.needed, self.addresses)
        return self._values(registers, start, self.dtype)

    def counters(self, registers: NDArray[np.uint16]) -> NDArray[np.int64] | None:
        """Return the counter of each reading, (n,)."""
        if self.counter_address is None:
            return None
        return registers[:, self.needed.index(self.counter_address)].astype(np.int64)

    def times_ns(self, registers: NDArray[np.uint16]) -> NDArray[np.int64] | None:
        """Return the device's time of each reading in ns since a device-specific epoch, (n,)."""
        if self.time_address is None:
            return None
        start = self.needed.index(self.time_address)
        if self.time_format == "witmotion":
            return _witmotion_ns(registers[:, start : start + 4].astype(np.int64))
        kind = np.dtype(self.time_format.partition("-")[0])
        ticks = self._values(registers, np.array([start]), kind)[:, 0].astype(np.int64)
        return ticks * _TICK_NS[self.time_format]

    def _values(
        self, registers: NDArray[np.uint16], start: NDArray[np.int64], kind: np.dtype[Any]
    ) -> CountsArray:
        within = np.arange(kind.itemsize // 2)
        columns = start[:, None] + (within if self.word_order == "big" else within[::-1])
        words = np.ascontiguousarray(registers[:, columns].astype(">u2"))
        values: CountsArray = words.view(kind.newbyteorder(">"))[:, :, 0].astype(kind)
        return values

    def encode(self, counts: NDArray[Any], *, counter: int = 0, time_ns: int = 0) -> dict[int, int]:
        """Return the registers of one reading by address.

        Counts beyond the range of the data type are clipped to its ends.
        """
        kind = self.dtype
        if kind.kind != "f":
            ends = np.iinfo(kind)
            counts = np.clip(np.rint(counts), ends.min, ends.max)
        held: dict[int, int] = {}
        for address, value in zip(self.addresses, counts.astype(kind), strict=True):
            held |= self._words(address, value, kind)
        if self.counter_address is not None:
            held[self.counter_address] = counter & 0xFFFF
        if self.time_address is not None and self.time_format == "witmotion":
            held |= dict(enumerate(_witmotion_words(time_ns), self.time_address))
        elif self.time_address is not None:
            kind = np.dtype(self.time_format.partition("-")[0])
            ticks = time_ns // _TICK_NS[self.time_format] % (1 << 8 * kind.itemsize)
            held |= self._words(self.time_address, kind.type(ticks), kind)
        return held

    def _words(self, address: int, value: Any, kind: np.dtype[Any]) -> dict[int, int]:  # noqa: ANN401 -- a numpy scalar
        words = np.array([value], kind.newbyteorder(">")).view(">u2").tolist()
        return dict(enumerate(words if self.word_order == "big" else words[::-1], address))


def _witmotion_ns(words: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return UTC in ns from words YYMM, DDHH, MMSS, ms; YY, DD and MM are low bytes."""
    low, high = words & 0xFF, words >> 8
    months = (low[:, 0] + 30) * 12 + high[:, 0] - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + low[:, 1] - 1
    seconds = ((days * 24 + high[:, 1]) * 60 + low[:, 2]) * 60 + high[:, 2]
    nanoseconds: NDArray[np.int64] = (seconds * 1000 + words[:, 3]) * 10**6
    return nanoseconds


def _witmotion_words(time_ns: int) -> list[int]:
    at = np.datetime64(time_ns // 10**6, "ms").item()
    return [
        at.month << 8 | at.year % 100,
        at.hour << 8 | at.day,
        at.second << 8 | at.minute,
        at.microsecond // 1000,
    ]


class _DeviceTime:
    """Host time of readings by the device's time.

    A new reading was taken after the poll before it was sent, and before its reply arrived. So no
    latency hides that the device's time was set.
    """

    def __init__(self, resolution_ns: int) -> None:
        self._step = JUMP_NS + resolution_ns
        self._least, self._largest = -_FAR_NS, _FAR_NS  # host time minus device time
        self._at = 0

    def placed(
        self, times: NDArray[np.int64], before: NDArray[np.int64], received: NDArray[np.int64]
    ) -> NDArray[np.int64] | None:
        """Return the host times of readings, in ns; None where the device's time jumped.

        ``before``: when the polls before were sent.
        """
        at, least, largest = int(received[-1]), before - times, received - times
        leak = round(DRIFT * (at - self._at))
        low = max(int(least.max()), self._least - leak)
        high = min(int(largest.min()), self._largest + leak)
        has_jumped = low > high + self._step
        if has_jumped:  # before the last of these readings
            low, high = int(least[-1]), int(largest[-1])
        self._least, self._largest, self._at = low, high, at
        return None if has_jumped else times + high


class RegisterDecoder:
    """Decoder: readings in, blocks out.

    Parameters
    ----------
    sensor : str
        Name for the blocks and events.
    registers : RegisterMap
        Map of the readings.
    sampling_rate : float
        Nominal poll rate, in Hz.
    """

    def __init__(self, sensor: str, registers: RegisterMap, *, sampling_rate: float) -> None:
        self._sensor = sensor
        self._map = registers
        self._period_ns = 1e9 / sampling_rate
        self._gather = max(1, round(BLOCK_DURATION * sampling_rate))
        self._rows: list[Sequence[int]] = []
        self._sent: list[int] = []
        self._received: list[int] = []
        self._at: HostTime | None = None  # arrival of the last reading
        self._next = 0
        self._last_instant: int | None = None
        self._last_key: int | None = None
        self._sent_before: int | None = None
        self._device_time = _DeviceTime(registers.resolution_ns)

    def receive(
        self, registers: Sequence[int], sent: HostTime, at: HostTime
    ) -> list[Block | Event]:
        """Add one reading: the registers of `RegisterMap.needed`; ``sent`` is the first request.

        Raises
        ------
        RemoteProtocolError
            If the number of registers is wrong.
        """
        n_needed = len(self._map.needed)
        if len(registers) != n_needed:
            raise RemoteProtocolError(f"{len(registers)} registers; expected {n_needed}")
        self._rows.append(registers)
        self._sent.append(sent.monotonic_ns)
        self._received.append(at.monotonic_ns)
        self._at = at
        return self.flush() if len(self._rows) >= self._gather else []

    def flush(self) -> list[Block | Event]:
        """Decode the collected readings."""
        at = self._at
        if not self._rows or at is None:
            return []
        registers = np.array(self._rows, np.uint16)
        sent, received = np.array(self._sent, np.int64), np.array(self._received, np.int64)
        self._rows, self._sent, self._received = [], [], []
        if self._sent_before is None:
            self._sent_before = int(sent[0] - max(self._period_ns, _STALE_NS))
        before = np.concatenate([[self._sent_before], sent[:-1]])
        self._sent_before = int(sent[-1])
        times = self._map.times_ns(registers)
        keys = self._map.counters(registers) if times is None else times
        new = np.ones(len(sent), bool)
        if keys is not None:
            new = np.diff(keys, prepend=-1 if self._last_key is None else self._last_key) != 0
            self._last_key, keys = int(keys[-1]), keys[new]
            registers, sent, received = registers[new], sent[new], received[new]
        if not len(registers):
            return []
        found: list[Block | Event] = []
        instants = sent + (received - sent) // 2
        restarted = self._last_instant is None
        if times is not None:
            placed = self._device_time.placed(times[new], before[new], received)
            if placed is not None:
                instants = placed
            else:
                restarted = True
                found.append(Event(self._sensor, EventKind.RESET, "the device's time jumped", at))
        counts = self._map.counts(registers)
        return found + self._blocks(counts, instants, keys, restarted=restarted, at=at)

    def _blocks(
        self,
        counts: CountsArray,
        instants: NDArray[np.int64],
        keys: NDArray[np.int64] | None,
        *,
        restarted: bool,
        at: HostTime,
    ) -> list[Block | Event]:
        before = instants[0] - round(self._period_ns)
        if self._last_instant is not None:  # on host time, also if the clock restarts
            before = np.int64(self._last_instant)
        steps = np.diff(instants, prepend=before) / self._period_ns
        missing = np.where(steps > GAP, np.rint(steps) - 1, 0).astype(np.int64)
        starts = np.flatnonzero(missing)
        edges = np.unique(np.concatenate([[0], starts, [len(instants)]]))
        found: list[Block | Event] = []
        for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            flags, reason = BlockFlag.NONE, ""
            if restarted and start == 0:
                flags |= BlockFlag.CLOCK_RESTART
            if missing[start]:
                flags |= BlockFlag.MISSING_ESTIMATED
                reason = several(int(missing[start]), "poll", "without a reading")
            part = counts[start:stop]
            if part.dtype.kind != "f":
                ends = np.iinfo(self._map.dtype)
                if (part == ends.max).any() or (part == ends.min).any():
                    flags |= BlockFlag.CLIPPED
            first = self._next + int(missing[start])
            counter = None if keys is None else int(keys[start])
            found.append(
                Block(self._sensor, first, part, at, counter, flags, reason, instants[start:stop])
            )
            self._next = first + stop - start
        self._last_instant = int(instants[-1])
        return found
