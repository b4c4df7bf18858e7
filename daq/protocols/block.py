"""What every protocol yields: blocks of samples, and events.

Theory of operation
-------------------
A protocol is fed received bytes together with the host time at which they came, and returns
finished :class:`Block` and :class:`Event` objects in order. It owns no clock and no wire.

``first_sample`` counts on the device's own sampling grid, from 0 at the start of a *session* (one
connection). A block that does not start where the one before ended is a **gap**: the samples
between were taken by the device, or should have been, and were not received. Where the protocol
carries a counter the length of a gap is exact; where it does not, the block says
``BlockFlag.MISSING_ESTIMATED``. Gaps are never filled.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag, StrEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

CountsArray: TypeAlias = NDArray[np.integer[Any]] | NDArray[np.floating[Any]]


class BlockFlag(IntFlag):
    """What is known about a block beyond its samples (stored in the recording as int32)."""

    NONE = 0
    CLIPPED = 1
    """At least one sample is at the end of its range."""
    CLOCK_RESTART = 2
    """The device's sampling clock starts anew here: first block, reset, reconnection."""
    MISSING_ESTIMATED = 4
    """How many samples are missing before this block was estimated from host time."""
    DEVICE_UTC = 8
    """``device_counter`` is the UTC of the first sample in ns, from the device (GPS or NTP)."""


@dataclass(frozen=True, slots=True)
class HostTime:
    """One instant as the host saw it.

    ``monotonic_ns`` is never stepped and is what clock models use; ``utc_ns`` (since 1970) names
    the instant for people.
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
        Index of the first sample on the device's sampling grid, from the start of the session.
    counts : ndarray, shape (n_samples, n_channels)
        Raw values as the device sent them (integers, or floats where registers hold floats).
    received : HostTime
        When the last byte of the block had been received.
    device_counter : int or None
        The device's own counter (unwrapped) or time of the first sample, where there is one.
    flags : BlockFlag
        See there.
    reason : str
        Why samples are missing before this block; empty where none are.
    instants_ns : int64 ndarray, shape (n_samples,), or None
        For polled devices: host monotonic instant of each sample, in ns.
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
    """What kind of event happened; the values are the strings that a recording holds."""

    STARTED = "started"
    """The run began."""
    STOPPED = "stopped"
    """The run ended, or a server announced that it shuts down."""
    MARK = "mark"
    """A person's remark, with the time at which it was made."""
    CONNECTED = "connected"
    """A device was connected, or answers again."""
    DISCONNECTED = "disconnected"
    """The connection to a device ended."""
    LATE = "late"
    """No block arrived for two block periods. Recorded only if the sensor is lost afterwards."""
    STALLED = "stalled"
    """The port is open, but no samples or no replies arrive."""
    REFUSED = "refused"
    """A device, a stream or a reply is not the one that the bench file names, or says no."""
    RESYNCHRONISED = "resynchronised"
    """Bytes or packets were skipped, lost or repeated; decoding continued after them."""
    CHECKSUM = "checksum"
    """A wrong checksum, or data that cannot be read."""
    RESET = "reset"
    """The device's counter or clock started again."""
    OVERFLOW = "overflow"
    """A buffer in the device overflowed and samples were lost there."""
    STATUS = "status"
    """The device, its driver or the recorder reports its condition."""

    @classmethod
    def of(cls, text: str) -> EventKind | str:
        """Return the kind of this name; the text itself where no kind has it.

        Newer programs and drivers from elsewhere may record kinds that this program does not know.
        """
        try:
            return cls(text)
        except ValueError:
            return text


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to a sensor (or, with an empty name, to the run).

    Attributes
    ----------
    sensor : str
    kind : EventKind or str
        A text only where it is none of `EventKind`: newer programs and drivers from elsewhere have
        their own.
    text : str
        For people, at most 200 bytes. Programs decide by `kind`, never by this text.
    received : HostTime
    """

    sensor: str
    kind: EventKind | str
    text: str
    received: HostTime
