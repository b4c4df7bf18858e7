"""What an estimate reads: a recording in a file, or one made of arrays in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from daq.bench.model import Bench, Channel
    from daq.protocols.block import HostTime


class ReadableBlocks(Protocol):
    """Blocks of one sensor, dtype `daq.recording.file_format.BLOCK_DTYPE`; indexed as an array."""

    def __len__(self) -> int: ...

    def __getitem__(self, which: Any) -> NDArray[Any]: ...  # noqa: ANN401 - as arrays take it

    @property
    def clipped(self) -> NDArray[np.int64]:
        """First sample and the one after the last of what is clipped, shape (n, 2); rising."""


class ReadableSensor(Protocol):
    """One sensor of a recording."""

    @property
    def name(self) -> str:
        """Name of the sensor."""

    @property
    def clock(self) -> str:
        """Sensors of one clock name are sampled by one clock."""

    @property
    def sampling_rate(self) -> float:
        """In Hz, as the device says; nominal where it does not."""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What each column of the counts is."""

    @property
    def polled(self) -> bool:
        """Whether the instant of every sample is known."""

    @property
    def n_samples(self) -> int:
        """Number of committed rows of samples."""

    @property
    def blocks(self) -> ReadableBlocks:
        """Committed blocks."""

    @property
    def gaps(self) -> NDArray[np.void]:
        """Gaps, dtype `daq.recording.file_format.GAP_DTYPE`."""

    def counts(self, first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return raw counts, shape (last_row - first_row, n_channels)."""

    def instants_ns(self, first_row: int = 0, last_row: int | None = None) -> NDArray[np.int64]:
        """Return the host monotonic instants of samples, in ns, of a polled sensor."""


class ReadableRecording(Protocol):
    """A recording, growing or complete."""

    @property
    def path(self) -> Path:
        """Its name in messages."""

    @property
    def run_id(self) -> str:
        """What tells this recording from every other."""

    @property
    def created_at(self) -> HostTime:
        """When the recording was begun."""

    @property
    def bench(self) -> Bench | None:
        """The bench it was recorded with, if there is one."""

    @property
    def closed(self) -> bool:
        """Whether nothing more will come."""

    @property
    def sensors(self) -> tuple[ReadableSensor, ...]:
        """In the order of the bench."""

    def refresh(self) -> bool:
        """Take over what was committed since; return whether there was anything."""

    def close(self) -> None:
        """Close the file, if there is one."""
