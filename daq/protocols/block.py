"""Blocks of samples, events and readings: the output of every protocol.

Theory of operation
-------------------
A protocol takes received bytes and the host time at which they arrived, and returns complete
:class:`Block`, :class:`Event` and :class:`Reading` objects in order. It reads no clock and opens no
port.

``first_sample`` counts the device's own samples, from 0 at the start of a *session* (one
connection). A **gap** separates two blocks if the second does not begin at the end of the first:
the samples between them were not received. If the protocol has a counter, the length of a gap is
exact; otherwise the block has the flag ``BlockFlag.MISSING_ESTIMATED``. Gaps are never filled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import IntFlag, StrEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daq.protocols.errors import several

UNCOUNTED_CHECK = "check the buffers and the cable of the logger, and the load of its computer"
"""What to do about samples that are not counted."""

CountsArray: TypeAlias = NDArray[np.integer[Any]] | NDArray[np.floating[Any]]


class BlockFlag(IntFlag):
    """Properties of a block (stored in the recording as int32)."""

    NONE = 0
    CLIPPED = 1
    """At least one sample reached the end of the range."""
    CLOCK_RESTART = 2
    """The device's sampling clock restarts at this block: first block, reset or reconnection."""
    MISSING_ESTIMATED = 4
    """The number of samples missing before this block is an estimate from host time."""
    DEVICE_UTC = 8
    """``device_counter`` is the device's UTC (GPS or NTP) of the first sample, in ns."""


@dataclass(frozen=True, slots=True)
class HostTime:
    """One instant on the clocks of the host.

    Clock models use ``monotonic_ns``, which is never stepped. ``utc_ns``, in ns since 1970, is for
    display only.
    """

    monotonic_ns: int
    utc_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Contiguous samples of one device read.

    Attributes
    ----------
    sensor : str
        Name of the sensor in the bench file.
    first_sample : int
        Index of the first sample, from 0 at the start of the session.
    counts : ndarray, shape (n_samples, n_channels)
        Raw values as sent by the device (integers, or floats where registers hold floats).
    received : HostTime
        When the last byte of the block was received.
    device_counter : int or None
        The device's counter (unwrapped) or time of the first sample; None if it sends neither.
    flags : BlockFlag
    reason : str
        Why samples are missing before this block, as text for display; empty if none are missing.
    instants_ns : int64 ndarray, shape (n_samples,), or None
        Host monotonic time of each sample in ns, for polled devices.
    """

    sensor: str
    first_sample: int
    counts: CountsArray
    received: HostTime
    device_counter: int | None = None
    flags: BlockFlag = BlockFlag.NONE
    reason: str = ""
    instants_ns: NDArray[np.int64] | None = None

    @property
    def n_samples(self) -> int:
        """Number of samples in the block."""
        return int(self.counts.shape[0])

    @property
    def end_sample(self) -> int:
        """Index of the sample after the last one."""
        return self.first_sample + self.n_samples


class EventKind(StrEnum):
    """Kind of an event; recordings store these strings."""

    STARTED = "started"
    """The run began."""
    STOPPED = "stopped"
    """The run ended, or a server announced that it shuts down."""
    MARK = "mark"
    """A user's remark and its time."""
    CONNECTED = "connected"
    """A device was connected, or replies again."""
    DISCONNECTED = "disconnected"
    """The connection to a device ended."""
    LATE = "late"
    """No block arrived for two block periods. Recorded only if the sensor is lost afterwards."""
    STALLED = "stalled"
    """The port is open, but no samples or no replies arrive."""
    REFUSED = "refused"
    """A device refused a request, or a device, stream or reply contradicts the bench file."""
    RESYNCHRONISED = "resynchronised"
    """Bytes or packets were skipped, lost or repeated; decoding continued after them."""
    CHECKSUM = "checksum"
    """A wrong checksum, or data that cannot be read."""
    RESET = "reset"
    """The device's counter or clock restarted."""
    OVERFLOW = "overflow"
    """A buffer in the device overflowed and lost samples."""
    UNCOUNTED = "uncounted"
    """Samples were lost, or repeated, without being counted, as measured delays show later."""
    CLOCK = "clock"
    """State of the computer's clock: at the start, hourly, and when it was set."""
    STATUS = "status"
    """The device, its driver or the recorder reports its condition."""

    @classmethod
    def of(cls, text: str) -> EventKind | str:
        """Return the kind with this value, or the text itself if no kind has it.

        Newer versions and third-party drivers may record kinds that this version does not know.
        """
        try:
            return cls(text)
        except ValueError:
            return text


@dataclass(frozen=True, slots=True)
class Uncounted:
    """Samples that a sensor lost, or repeated, without counting them.

    Attributes
    ----------
    utc_ns : int
        When, in ns since 1970: the middle of what is known.
    within : float
        By how much that may be wrong, in seconds.
    n_samples : int
        Lost samples; negative: samples that were counted twice.
    """

    utc_ns: int
    within: float = field(metadata={"key": "within_s"})
    n_samples: int = field(metadata={"key": "samples", "minimum": None})

    def is_that(self, other: Uncounted) -> bool:
        """Whether both may be one, found twice."""
        apart = abs(self.utc_ns - other.utc_ns) * 1e-9
        return self.n_samples == other.n_samples and apart <= self.within + other.within

    @property
    def in_words(self) -> str:
        """What happened, when, and what to check."""
        count = abs(self.n_samples)
        return (
            f"{'lost' if self.n_samples > 0 else 'repeated'} {several(count, 'sample')} at"
            f" {datetime.fromtimestamp(self.utc_ns * 1e-9, UTC):%H:%M:%S} UTC"
            f" (±{math.ceil(self.within)} s) without counting {'it' if count == 1 else 'them'};"
            f" {UNCOUNTED_CHECK}"
        )


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to a sensor (or, with an empty name, to the run).

    Attributes
    ----------
    sensor : str
    kind : EventKind or str
        A str only if the kind is none of `EventKind`; see `EventKind.of`.
    text : str
        For display, at most 200 bytes. Programs decide by `kind`, never by this text.
    received : HostTime
    """

    sensor: str
    kind: EventKind | str
    text: str
    received: HostTime


class Quantity(StrEnum):
    """What a reading measures; recordings store these strings."""

    TEMPERATURE = "temperature"
    """In °C."""
    SUPPLY = "supply"
    """Supply voltage in V."""

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return "°C" if self is Quantity.TEMPERATURE else "V"

    @classmethod
    def of(cls, text: str) -> Quantity | str:
        """Return the quantity with this value, or the text itself if none has it."""
        try:
            return cls(text)
        except ValueError:
            return text


READING_INTERVAL_NS = 60_000_000_000
"""Time in ns between the recorded readings of one quantity of one sensor."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A slow quantity that a device (or, with an empty name, the host) states of itself.

    Attributes
    ----------
    sensor : str
    quantity : Quantity or str
        A str only if it is none of `Quantity`.
    value : float
    received : HostTime
    """

    sensor: str
    quantity: Quantity | str
    value: float
    received: HostTime


DeviceItem: TypeAlias = Block | Event | Reading
"""What a driver yields."""


class ReadingTimes:
    """Tells when to read, or to record, a quantity again: once in each minute of the host's clock.

    Drivers and the recorder take the same minutes, so what a driver reads is recorded.
    """

    def __init__(self) -> None:
        self._last: int | None = None

    def is_due(self, at: HostTime) -> bool:
        """Whether this is the first call in its minute."""
        minute = at.monotonic_ns // READING_INTERVAL_NS
        due, self._last = minute != self._last, minute
        return due
