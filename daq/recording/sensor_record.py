"""One sensor of an open recording: its committed samples, blocks and gaps."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.errors import NotARecordingError, RecordingError
from daq.recording import file_format
from daq.recording.chunks.block_table import BlockTable
from daq.recording.chunks.checksums import intact_blocks
from daq.recording.chunks.chunk_reader import ChunkedRows
from daq.recording.storage.opening import refresh
from daq.recording.storage.refusals import check_length, dataset, number, text

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray

    from daq.bench.channel import Channel


class CommittedRows:
    """The committed rows of a table; each row is read once."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._parts: list[NDArray[np.void]] = []
        self.n_rows = 0

    def extend(self, n_rows: int) -> None:
        """Read further rows, up to ``n_rows`` in all."""
        if n_rows > self.n_rows:
            refresh(self._dataset)
            check_length(self._dataset)
            part = self._dataset[self.n_rows : n_rows]
            if len(part) < n_rows - self.n_rows:
                raise OSError(
                    f"{self._dataset.name} has {self.n_rows + len(part)} rows where {n_rows} were"
                    " committed"
                )
            self._parts.append(part)
            self.n_rows = n_rows

    def rows(self) -> NDArray[np.void]:
        """Return all rows."""
        if not self._parts:
            return np.zeros(0, self._dataset.dtype)
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0]


class SensorRecord:
    """The committed data of one sensor, extended when its recording is refreshed."""

    def __init__(self, group: h5py.Group) -> None:
        attributes = group.attrs
        self._group = group
        self.name: str = group.name.rpartition("/")[2]
        self.model = text(attributes, "model")
        self.serial_number = text(attributes, "serial_number")
        self.driver = text(attributes, "driver")
        self.port = text(attributes, "port")
        self.clock = text(attributes, "clock")
        """Name of the sampling clock; sensors with one clock share the name."""
        self.sampling_rate = float(number(attributes, "sampling_rate"))
        """In Hz, as reported by the device; otherwise nominal."""
        self.firmware = text(attributes, "firmware") if "firmware" in attributes else ""
        self.temperature = (
            float(number(attributes, "temperature")) if "temperature" in attributes else None
        )
        """In °C, as the device reported at the start; None if it reported none."""
        self._samples = dataset(group, "samples", in_parts=True)
        self._instants = dataset(group, "instants", np.dtype("<i8"), in_parts=True)
        self.channels: tuple[Channel, ...] = file_format.channels_of(self._samples.attrs)
        self.absent: NDArray[np.int64] = np.array(
            self._samples.attrs.get("absent", np.empty((0, 3))), np.int64
        )
        """Rows in which a channel has no sample: its column, first row, and one after the last."""
        self.dtype: np.dtype[Any] = self._samples.dtype
        self._check_shapes()
        self._sample_rows = ChunkedRows(self._samples)
        self._instant_rows = ChunkedRows(self._instants)
        self.blocks = BlockTable(dataset(group, "blocks", file_format.BLOCK_DTYPE))
        self.gap_rows = CommittedRows(dataset(group, "gaps", file_format.GAP_DTYPE))
        self._damaged: set[int] = set()
        self.n_samples = 0
        """Number of committed rows of samples."""

    def _check_shapes(self) -> None:
        n_channels = len(self.channels)
        if self._samples.ndim != 2 or self._samples.shape[1] != n_channels:
            raise ValueError(
                f"sensor {self.name!r}: samples of shape {self._samples.shape}; expected"
                f" {n_channels} columns"
            )
        if self.absent.ndim != 2 or self.absent.shape[1] != 3:
            raise ValueError(f"sensor {self.name!r}: absent of shape {self.absent.shape}")
        if not np.isin(self.absent[:, 0], np.arange(n_channels)).all():
            raise ValueError(f"sensor {self.name!r}: absent of other columns than its own")
        if self._instants.ndim != 1 or not self._samples.chunks or not self._instants.chunks:
            raise ValueError(f"sensor {self.name!r}: samples or instants are not in chunks")
        if self.sampling_rate <= 0:
            raise ValueError(f"sensor {self.name!r}: sampling_rate {self.sampling_rate}")

    @property
    def polled(self) -> bool:
        """Whether the time of every sample is recorded; False before the first sample."""
        return bool(self.n_samples > 0 and self._instants.shape[0] >= self.n_samples)

    @property
    def n_written(self) -> int:
        """Number of rows of samples in the file, including uncommitted ones."""
        return int(self._samples.shape[0])

    @property
    def gaps(self) -> NDArray[np.void]:
        """Committed gaps, dtype :data:`daq.recording.file_format.GAP_DTYPE`."""
        return self.gap_rows.rows()

    def counts(self, first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return raw counts.

        Parameters
        ----------
        first_row, last_row : int
            Rows, without ``last_row``; default: up to ``n_samples``.

        Returns
        -------
        ndarray, shape (last_row - first_row, n_channels)

        Raises
        ------
        IndexError
            If these rows are not committed.
        RecordingError
            If the file is damaged at these rows.
        """
        return self._read(self._sample_rows, first_row, last_row)

    def intact_counts(
        self, first_row: int, last_row: int
    ) -> tuple[NDArray[Any], list[tuple[int, int]]]:
        """Return raw counts, checked against the checksums of their blocks.

        Parameters
        ----------
        first_row, last_row : int
            Rows, without ``last_row``.

        Returns
        -------
        counts : ndarray, shape (last_row - first_row, n_channels)
            Zero in damaged blocks.
        damaged : list of (int, int)
            Rows of ``counts`` (first, last + 1) that are in damaged blocks.
        """
        blocks = self.blocks.covering(first_row, last_row)
        if not len(blocks):
            return self.counts(first_row, last_row), []
        low = int(blocks["first_row"][0])
        ends = blocks["first_row"] + blocks["n_samples"]
        try:
            counts = self.counts(low, int(ends[-1]))
        except RecordingError:  # a chunk is damaged: read the blocks of other chunks one by one
            counts = self._counts_block_by_block(blocks)
        bad = np.flatnonzero(~intact_blocks(blocks, counts))
        if len(bad):
            counts = counts.copy()
        damaged = []
        for at in bad.tolist():
            begin, end = int(blocks["first_row"][at]), int(ends[at])
            counts[begin - low : end - low] = 0
            damaged.append((max(0, begin - first_row), min(last_row, end) - first_row))
            self._damaged.add(begin)
        return counts[first_row - low : last_row - low], damaged

    @property
    def n_damaged(self) -> int:
        """Number of damaged blocks that `intact_counts` has found."""
        return len(self._damaged)

    @property
    def damaged_rows(self) -> list[int]:
        """First row of each of these blocks."""
        return sorted(self._damaged)

    def _counts_block_by_block(self, blocks: NDArray[np.void]) -> NDArray[Any]:
        low = int(blocks["first_row"][0])
        n_rows = int(blocks["n_samples"].sum())
        counts = np.zeros((n_rows, len(self.channels)), self.dtype)
        for block in blocks:
            first, n = int(block["first_row"]), int(block["n_samples"])
            with contextlib.suppress(RecordingError):
                counts[first - low : first - low + n] = self.counts(first, first + n)
        return counts

    def instants_ns(self, first_row: int = 0, last_row: int | None = None) -> NDArray[np.int64]:
        """Return the host monotonic time of each sample of a polled sensor, in ns.

        Raises
        ------
        IndexError
            If these rows are not committed.
        RecordingError
            If the sensor is not polled, or the file damaged.
        """
        if not self.polled:
            raise RecordingError(f"sensor {self.name!r} has no sample times")
        return self._read(self._instant_rows, first_row, last_row)

    def _read(self, rows: ChunkedRows, first_row: int, last_row: int | None) -> NDArray[Any]:
        last_row = self.n_samples if last_row is None else last_row
        if not 0 <= first_row <= last_row <= self.n_samples:
            raise IndexError(
                f"rows {first_row} to {last_row} of sensor {self.name!r}: {self.n_samples} are"
                " committed"
            )
        try:
            return rows.read(first_row, last_row, self.n_samples)
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self._samples.file.filename}: sensor {self.name!r} is damaged between rows"
                f" {first_row} and {last_row}: {error}"
            ) from error

    def extend(self, counts: NDArray[np.int64], *, closed: bool = False) -> bool:
        """Add the rows counted in a row of ``/committed``; return whether there are new ones.

        Raises
        ------
        NotARecordingError
            If a closed recording has other numbers of rows or blocks than were committed.
        RecordingError, OSError
            If rows are missing or cannot be read.
        """
        before = self.n_samples, self.gap_rows.n_rows
        n_rows = int(counts[file_format.ROWS])
        try:
            self.blocks.extend(int(counts[file_format.BLOCKS]), n_rows, closed=closed)
        except RecordingError as error:
            if not closed:
                raise
            lost = n_rows - self.blocks.n_samples
            raise NotARecordingError(
                f"{error}; sensor {self.name!r}: {lost} of {n_rows} samples are lost"
            ) from error
        self.gap_rows.extend(int(counts[file_format.GAPS]))
        if self.blocks.n_samples > self.n_samples:
            refresh(self._samples)
            if self.polled or not self.n_samples:
                refresh(self._instants)
            check_length(self._samples)
            if self._samples.shape[0] < self.blocks.n_samples:
                raise OSError(
                    f"sensor {self.name!r} has {self._samples.shape[0]} rows where"
                    f" {self.blocks.n_samples} were committed"
                )
            self.n_samples = self.blocks.n_samples
        if closed:
            self._check_lengths(counts)
            self._sample_rows.is_closed = self._instant_rows.is_closed = True
        return before != (self.n_samples, self.gap_rows.n_rows)

    def _check_lengths(self, counts: NDArray[np.int64]) -> None:
        """Check that the datasets of a closed recording end with the committed rows."""
        expected = {name: int(counts[file_format.ROWS]) for name in ("samples", "instants")}
        expected |= {"blocks": int(counts[file_format.BLOCKS])}
        for name, n_rows in expected.items():
            found = self._group[name].shape[0]
            if found != n_rows and (name != "instants" or found):
                raise NotARecordingError(
                    f"{self._samples.file.filename}: damaged: {self._group.name}/{name} has"
                    f" {found} rows; expected {n_rows}"
                )
