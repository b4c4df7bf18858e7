"""Writes a recording from arrays of samples: imported, simulated, or computed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self, TypeAlias

import numpy as np

from daq.protocols import block
from daq.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

    from daq.bench.model import Bench
    from daq.recording.file_format import SensorLayout

    Times: TypeAlias = Sequence[int] | NDArray[np.int64]

BLOCK_ROWS = 4096
"""Default number of samples in a block."""
CHUNK_SECONDS = 10.0
_NS_PER_S = 1_000_000_000
_COMMIT_BYTES = 1 << 24
"""Number of bytes after which samples are committed, to bound memory."""


class ArrayWriter:
    """Writes a recording from arrays; a context manager.

    The recording gets its name when the context ends without an exception; otherwise the file is
    removed. Samples may be added in pieces of any length, so memory is bounded.
    All times are in ns after `created`.

    Parameters
    ----------
    path : path
        Must not exist; its directory is made.
    bench : Bench, optional
        Stored in the recording.
    sensors : sequence of SensorLayout
    created : HostTime
        Start of the recording.
    attributes : dict, optional
        More attributes of the file, such as its origin.
    chunk_seconds : float
        Length of a chunk. Longer chunks are read faster.

    Raises
    ------
    RecordingError
        If the file exists or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        bench: Bench | None = None,
        *,
        sensors: Sequence[SensorLayout],
        created: block.HostTime,
        attributes: dict[str, str | float] | None = None,
        chunk_seconds: float = CHUNK_SECONDS,
    ) -> None:
        self.created = created
        self._uncommitted = 0
        self._rates = {sensor.name: sensor.sampling_rate for sensor in sensors}
        self._writer = RecordingWriter.create(
            path,
            bench,
            sensors=sensors,
            created=created,
            attributes=attributes,
            chunk_seconds=chunk_seconds,
            hidden=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self._writer.close()
        else:
            self._writer.abandon()

    def samples(
        self,
        sensor: str,
        counts: block.CountsArray,
        *,
        first_sample: int = 0,
        block_rows: int = BLOCK_ROWS,
        received_ns: Times | None = None,
        utc_ns: Times | None = None,
        instants_ns: Times | None = None,
        restart: bool | None = None,
    ) -> None:
        """Add consecutive samples of a sensor, cut into blocks.

        Parameters
        ----------
        sensor : str
        counts : ndarray, shape (n_samples, n_channels)
            With the dtype of the sensor's layout. Sliced block by block, so a lazily read array is
            never completely in memory.
        first_sample : int
            Index of the first sample, counted from the sensor's first sample.
        block_rows : int
            Number of samples per block; the last block has the remaining ones.
        received_ns : int, shape (n_blocks,), optional
            Arrival of each block. Default: one sampling interval after its last sample at the
            nominal rate.
        utc_ns : int, shape (n_blocks,), optional
            Time of the first sample of each block, if the device sends UTC.
        instants_ns : int64, shape (n_samples,), optional
            Time of each sample, if known.
        restart : bool, optional
            Whether the sampling clock restarts at the first sample; default: only at index 0.
        """
        rate, n_samples = self._rates[sensor], len(counts)
        flags = block.BlockFlag.NONE if utc_ns is None else block.BlockFlag.DEVICE_UTC
        for number, row in enumerate(range(0, n_samples, block_rows)):
            end = min(row + block_rows, n_samples)
            received = (
                round((first_sample + end) * _NS_PER_S / rate)
                if received_ns is None
                else int(received_ns[number])
            )
            starts_anew = number == 0 and (first_sample == 0 if restart is None else restart)
            samples = counts[row:end]
            self._uncommitted += samples.nbytes
            if self._uncommitted > _COMMIT_BYTES:
                self._writer.commit()
                self._uncommitted = 0
            self._writer.append(
                block.Block(
                    sensor=sensor,
                    first_sample=first_sample + row,
                    counts=samples,
                    received=self._at(received),
                    device_counter=(
                        None if utc_ns is None else self.created.utc_ns + int(utc_ns[number])
                    ),
                    flags=flags | block.BlockFlag.CLOCK_RESTART if starts_anew else flags,
                    instants_ns=(
                        None
                        if instants_ns is None
                        else self.created.monotonic_ns + np.asarray(instants_ns[row:end])
                    ),
                )
            )

    def gap(self, sensor: str, first_sample: int, missing: int, *, reason: str) -> None:
        """Record that samples from `first_sample` on are missing."""
        self._writer.gap(sensor, first_sample, missing, reason=reason)

    def event(
        self, kind: block.EventKind | str, text: str, *, at_ns: int = 0, sensor: str = ""
    ) -> None:
        """Record an event."""
        self._writer.event(block.Event(sensor, kind, text, self._at(at_ns)))

    def reading(
        self, quantity: block.Quantity | str, value: float, *, at_ns: int = 0, sensor: str = ""
    ) -> None:
        """Record a reading."""
        self._writer.reading(block.Reading(sensor, quantity, value, self._at(at_ns)))

    def _at(self, ns: int) -> block.HostTime:
        return block.HostTime(self.created.monotonic_ns + ns, self.created.utc_ns + ns)
