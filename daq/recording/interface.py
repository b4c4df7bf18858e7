"""Interface of recordings that can be estimated: files, and arrays in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.bench.outline import BenchOutline
from daq.caveats import Caveats
from daq.protocols.block import Event, HostTime, Reading

FIRST_DATE_NS = 10**17
"""Times before March 1973 are those of files without a date."""


class ReadableBlocks(Protocol):
    """Blocks of one sensor, dtype `daq.recording.file_format.BLOCK_DTYPE`; indexed as an array."""

    def __len__(self) -> int: ...

    def __getitem__(self, which: Any) -> NDArray[Any]: ...  # noqa: ANN401 - as arrays take it

    @property
    def clipped(self) -> NDArray[np.int64]:
        """First sample, and the one after the last, of each clipped stretch; shape (n, 2)."""


class ReadableSensor(Protocol):
    """One sensor of a recording."""

    sampling_rate: float
    """In Hz, as reported by the device; otherwise nominal."""

    @property
    def name(self) -> str:
        """Name of the sensor."""

    @property
    def clock(self) -> str:
        """Name of the sampling clock; sensors with one clock share the name."""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels, in the order of the columns of the counts."""

    @property
    def polled(self) -> bool:
        """Whether the time of every sample is recorded."""

    @property
    def n_samples(self) -> int:
        """Number of committed rows of samples."""

    @property
    def blocks(self) -> ReadableBlocks:
        """Committed blocks."""

    @property
    def gaps(self) -> NDArray[np.void]:
        """Gaps, dtype `daq.recording.file_format.GAP_DTYPE`."""

    @property
    def absent(self) -> NDArray[np.int64]:
        """Rows in which a channel has no sample: column, first row, one after the last; (n, 3)."""

    def counts(self, first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return raw counts, shape (last_row - first_row, n_channels)."""

    def intact_counts(
        self, first_row: int, last_row: int
    ) -> tuple[NDArray[Any], list[tuple[int, int]]]:
        """Return raw counts, and the ranges (first, last + 1) of damaged rows, which are zero."""

    def locate(self) -> None:
        """Look up where all samples are in the file: all are about to be read."""

    @property
    def n_damaged(self) -> int:
        """Number of damaged blocks read so far."""

    def instants_ns(self, first_row: int = 0, last_row: int | None = None) -> NDArray[np.int64]:
        """Return the host monotonic time of each sample of a polled sensor, in ns."""


def absences(
    absent: NDArray[np.int64], first_row: int, last_row: int
) -> Iterator[tuple[int, slice]]:
    """Yield columns without samples, with the rows, counted from `first_row`, that lack them.

    `absent` is that of a `ReadableSensor`.
    """
    begins, ends = np.maximum(absent[:, 1], first_row), np.minimum(absent[:, 2], last_row)
    for at in np.flatnonzero(begins < ends).tolist():
        yield int(absent[at, 0]), slice(int(begins[at]) - first_row, int(ends[at]) - first_row)


class ReadableRecording(Protocol):
    """A recording, growing or complete."""

    @property
    def path(self) -> Path:
        """Name of the recording in messages."""

    @property
    def run_id(self) -> str:
        """Unique identifier of the recording."""

    @property
    def created_at(self) -> HostTime:
        """Start of the recording."""

    @property
    def outline(self) -> BenchOutline | None:
        """The bench that was recorded in outline, if there is one."""

    @property
    def caveats(self) -> Caveats:
        """What must be read before its numbers."""

    @property
    def closed(self) -> bool:
        """Whether the recording is complete."""

    @property
    def sensors(self) -> tuple[ReadableSensor, ...]:
        """In the order of the bench."""

    @property
    def events(self) -> tuple[Event, ...]:
        """Events of the recording."""

    @property
    def readings(self) -> tuple[Reading, ...]:
        """What devices and the host stated of themselves."""

    def refresh(self) -> bool:
        """Read newly committed rows; return whether there were any."""

    def close(self) -> None:
        """Close the file, if there is one."""


class _With:
    """An object with some attributes of its own."""

    def __init__(self, of: object, **own: object) -> None:
        self.__dict__.update(own)
        self._of = of

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - as the object has it
        return getattr(self._of, name)


def created_at(recording: ReadableRecording) -> datetime:
    """Return the start of a recording, by the clock of the computer."""
    return datetime.fromtimestamp(recording.created_at.utc_ns * 1e-9, UTC)


def at_rates(recording: ReadableRecording, rates: Mapping[str, float]) -> ReadableRecording:
    """Return a recording some of whose sensors have other sampling rates, in Hz, by name."""
    if not rates:
        return recording
    sensors = tuple(
        _With(each, sampling_rate=rates.get(each.name, each.sampling_rate))
        for each in recording.sensors
    )
    return cast("ReadableRecording", _With(recording, sensors=sensors))
