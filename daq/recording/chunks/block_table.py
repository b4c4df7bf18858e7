"""The committed blocks of a sensor; a long recording has millions.

Rows stay in the file and are read on demand. Only the newest rows and the clipped stretches are
kept in memory, since they are needed repeatedly.
"""

from __future__ import annotations

import bisect
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.errors import RecordingError
from daq.protocols.block import BlockFlag
from daq.recording.storage.opening import refresh

if TYPE_CHECKING:
    from collections.abc import Iterator

    import h5py
    from numpy.typing import NDArray

    IntArray = NDArray[np.int64]

_ROWS_PER_READ = 1 << 14  # 900 kB
_ROWS_PER_MARK = 1 << 8
_NEWEST_ROWS = 1 << 10  # 57 kB; who follows a recording asks for them again and again


class BlockTable:
    """Committed blocks, dtype :data:`daq.recording.file_format.BLOCK_DTYPE`, indexed like an array.

    A slice reads only its rows; the name of a field reads only that field.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._n_rows = 0
        self._clipped: list[IntArray] = []
        self._marks: list[int] = []
        self._newest = np.empty(0, dataset.dtype)
        self._covering: tuple[int, int, NDArray[np.void]] = (0, 0, self._newest)
        self.n_samples = 0
        """Number of rows of samples in these blocks."""

    def __len__(self) -> int:
        return self._n_rows

    def __getitem__(self, which: Any) -> NDArray[Any]:  # noqa: ANN401 - any index of an array
        if isinstance(which, str):
            return self._read(0, self._n_rows, which)
        if isinstance(which, slice) and which.step is None:
            first, last, _ = which.indices(self._n_rows)
            return self._read(first, max(first, last))
        return np.asarray(self._read(0, self._n_rows)[which])

    def __iter__(self) -> Iterator[NDArray[np.void]]:
        for first in range(0, self._n_rows, _ROWS_PER_READ):
            yield from self[first : first + _ROWS_PER_READ]

    @property
    def clipped(self) -> IntArray:
        """First sample, and the one after the last, of each clipped stretch; shape (n, 2)."""
        if len(self._clipped) > 1:
            self._clipped = [np.concatenate(self._clipped)]
        return self._clipped[0] if self._clipped else np.empty((0, 2), np.int64)

    def extend(self, n_rows: int, n_samples: int, *, closed: bool = False) -> None:
        """Add blocks up to row ``n_rows``, without those that end beyond ``n_samples``.

        A crash may leave one of the two numbers older than the other. Blocks and samples are cut to
        end together. A closed recording was completed, so it has exactly these numbers.

        Raises
        ------
        RecordingError
            If the blocks are not contiguous, or those of a closed recording have another number of
            samples.
        """
        if n_rows > self._n_rows:
            refresh(self._dataset)
        for first in range(self._n_rows, n_rows, _ROWS_PER_READ):
            blocks = self._read(first, min(first + _ROWS_PER_READ, n_rows))
            ends = blocks["first_row"] + blocks["n_samples"]
            if closed:
                self._check_contiguous(blocks)  # `ends` of damaged blocks are not in order
            n_whole = int(np.searchsorted(ends, n_samples, side="right"))
            self._check_contiguous(blocks[:n_whole])
            if n_whole:
                self._mark(blocks[:n_whole])
                self._n_rows, self.n_samples = first + n_whole, int(ends[n_whole - 1])
                self._note_clipped(blocks[:n_whole])
                self._keep_newest(blocks[:n_whole])
            if n_whole < len(blocks):
                break
        if closed and self.n_samples != n_samples:
            raise RecordingError(
                f"{self._where}: damaged: its blocks have {self.n_samples} samples; expected"
                f" {n_samples}"
            )

    def covering(self, first_row: int, last_row: int) -> NDArray[np.void]:
        """Return the blocks with rows ``first_row`` to ``last_row`` (not included) of samples."""
        marks = self._marks
        begin = (bisect.bisect_right(marks, first_row) - 1) * _ROWS_PER_MARK
        end = bisect.bisect_left(marks, last_row) * _ROWS_PER_MARK
        first, last, _ = slice(max(0, begin), end).indices(self._n_rows)
        known_first, known_last, blocks = self._covering
        if not known_first <= first <= last <= known_last:
            known_first, blocks = first, self._read(first, max(first, last))
            self._covering = first, first + len(blocks), blocks
        blocks = blocks[first - known_first : last - known_first]
        ends = blocks["first_row"] + blocks["n_samples"]
        return np.asarray(blocks[(ends > first_row) & (blocks["first_row"] < last_row)])

    def _check_contiguous(self, blocks: NDArray[np.void]) -> None:
        """Check that each block begins at the row where the previous one ends.

        If not, ``n_samples`` becomes the number of samples whose blocks are certain.

        Raises
        ------
        RecordingError
            With the first wrong row of the table.
        """
        ends = blocks["first_row"] + blocks["n_samples"]
        expected = np.append(self.n_samples, ends[:-1]) if len(blocks) else ends
        wrong = np.flatnonzero((blocks["first_row"] != expected) | (blocks["n_samples"] <= 0))
        if len(wrong):
            at = int(wrong[0])
            # Either this row is wrong, or the number of samples of the row before.
            self.n_samples = int(expected[max(at - 1, 0)])
            raise RecordingError(
                f"{self._where}: damaged: row {self._n_rows + at} has its samples at row"
                f" {blocks['first_row'][at]}; expected {expected[at]}"
            )

    def _mark(self, blocks: NDArray[np.void]) -> None:
        """Store the first row of samples of every ``_ROWS_PER_READ``-th block."""
        first = -self._n_rows % _ROWS_PER_MARK
        self._marks += blocks["first_row"][first::_ROWS_PER_MARK].tolist()

    def _keep_newest(self, blocks: NDArray[np.void]) -> None:
        self._newest = np.concatenate([self._newest, blocks])[-_NEWEST_ROWS:].copy()

    def _note_clipped(self, blocks: NDArray[np.void]) -> None:
        blocks = blocks[(blocks["flags"] & int(BlockFlag.CLIPPED)) != 0]
        if len(blocks):
            first, end = blocks["first_sample"], blocks["first_sample"] + blocks["n_samples"]
            apart = first[1:] != end[:-1]
            begins, ends = first[np.append(True, apart)], end[np.append(apart, True)]
            self._clipped.append(np.column_stack([begins, ends]))

    def _read(self, first: int, last: int, field: str | None = None) -> NDArray[Any]:
        begin = self._n_rows - len(self._newest)
        if begin <= first < last <= self._n_rows:
            newest = self._newest[first - begin : last - begin]
            return newest if field is None else np.asarray(newest[field])
        dataset = self._dataset if field is None else self._dataset.fields(field)
        try:
            rows = np.asarray(dataset[first:last])
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self._where}: damaged between rows {first} and {last}: {error}"
            ) from error
        if len(rows) < last - first:
            raise RecordingError(
                f"{self._where} has {first + len(rows)} rows where {last} were committed"
            )
        return rows

    @property
    def _where(self) -> str:
        return f"{self._dataset.file.filename}: {self._dataset.name}"
