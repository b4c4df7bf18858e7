"""miniSEED 2 and 3, read by libmseed (pymseed).

A sensor is ``network.station.location``, its channels are the channel codes. A file is read in
parts of a megabyte, at the boundaries of its records, so files of any size take little memory.
libmseed joins records that continue each other within half a sample, and gives the times that the
first and the last record state: the clock of the digitizer is in them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from daq.errors import ImportFormatError
from daq.formats.readers.packages import load
from daq.formats.traces import Trace, TracePart

_PART_BYTES = 1 << 20
_HEADER_BYTES = 40
_QUALITIES = b"DRQM"
_NUMERIC = {"i", "f", "d"}


def is_miniseed(path: Path) -> bool:
    """Tell by its first bytes whether a file is miniSEED 2 or 3."""
    with path.open("rb") as file:
        return _is_header(file.read(_HEADER_BYTES))


def _is_header(head: bytes) -> bool:
    if head[:3] == b"MS\x03":
        return True
    return len(head) >= _HEADER_BYTES and head[6] in _QUALITIES and head[:6].strip().isdigit()


@dataclass(frozen=True, slots=True, eq=False)
class MiniSeedPart(TracePart):
    """Records of a file, from one byte to another; `record_length` is 0 if it varies."""

    offset: int
    end: int
    record_length: int

    def load(self) -> Sequence[Trace]:
        """Return the traces in these records; text, such as a log, is left out."""
        pymseed = load("pymseed", reads="miniSEED is", extra="miniseed")
        pymseed.clear_error_messages()
        try:
            found = self._listed(pymseed, unpack_data=True)
            traces = [
                _trace(pymseed, trace.sourceid, segment, self.path, number)
                for number, trace in enumerate(found, start=1)
                for segment in trace
                if segment.sampletype in _NUMERIC and segment.numsamples
            ]
            n_records = sum(s.recordlist.recordcnt for trace in found for s in trace)
        except (pymseed.MiniSEEDError, ValueError, OverflowError) as error:
            raise self._damaged(str(error)) from error
        for message in pymseed.get_error_messages():  # samples do not end where they should
            if "integrity" in message:
                raise self._damaged(message)
        if n_records < self._n_records:  # libmseed passes over what is no record
            raise self._damaged(f"{n_records} of {self._n_records} records can be read")
        return traces

    def _listed(self, pymseed: Any, **options: bool) -> Any:  # noqa: ANN401 - see above
        """Return what libmseed finds in these bytes."""
        with self.path.open("rb") as file:
            file.seek(self.offset)
            content = file.read(self.end - self.offset)
        return pymseed.MS3TraceList.from_buffer(content, record_list=True, **options)

    @property
    def _n_records(self) -> int:
        """Records that it must have: one at least, where their lengths vary."""
        return -(-(self.end - self.offset) // self.record_length) if self.record_length else 1

    def reaches(self, start_ns: int | None, end_ns: int | None) -> bool:
        """Whether a record has samples between two instants, by headers; a damaged part may."""
        if start_ns is None and end_ns is None:
            return True
        pymseed = load("pymseed", reads="miniSEED is", extra="miniseed")
        try:
            segments = [segment for trace in self._listed(pymseed) for segment in trace]
        except (pymseed.MiniSEEDError, ValueError, OverflowError):
            return True
        n_records = sum(segment.recordlist.recordcnt for segment in segments)
        return n_records < self._n_records or any(
            (end_ns is None or segment.starttime < end_ns)
            and (start_ns is None or segment.endtime >= start_ns)
            for segment in segments
        )

    def split(self) -> Sequence[MiniSeedPart]:
        """Return both halves of a part that is damaged somewhere; nothing if it is one record."""
        if self._n_records < 2:
            return ()
        middle = self.offset + self._n_records // 2 * self.record_length
        return (
            MiniSeedPart(self.path, self.offset, middle, self.record_length),
            MiniSeedPart(self.path, middle, self.end, self.record_length),
        )

    def _damaged(self, reason: str) -> ImportFormatError:
        where = f"bytes {self.offset} to {self.end}"
        return ImportFormatError(f"{self.path}: {where} are not sound miniSEED: {reason}")


def _codes(pymseed: Any, sourceid: str, path: Path, number: int) -> tuple[str, str, bool]:  # noqa: ANN401 - see above
    """Return sensor, channel, and whether a source has codes; else a file and a number name it."""
    *codes, channel = pymseed.sourceid2nslc(sourceid)
    sensor = ".".join(code for code in codes if code)
    return sensor or path.stem, channel.strip("_") or str(number), bool(sensor)


def contents(path: Path) -> list[tuple[str, str, int, int]]:
    """Return sensor, channel, and the times of first and last sample of each stretch of a file.

    Times are UTC in ns. Headers are read, and no sample.

    Raises
    ------
    ImportFormatError
        pymseed is not installed, or the file cannot be read.
    """
    pymseed = load("pymseed", reads="miniSEED is", extra="miniseed")
    try:
        return [
            (
                *_codes(pymseed, trace.sourceid, path, number)[:2],
                int(segment.starttime),
                int(segment.endtime),
            )
            for number, trace in enumerate(pymseed.MS3TraceList.from_file(str(path)), start=1)
            for segment in trace
            if segment.samprate and segment.samplecnt
        ]
    except (pymseed.MiniSEEDError, ValueError, OverflowError) as error:
        raise ImportFormatError(f"{path}: not sound miniSEED: {error}") from error


def _trace(pymseed: Any, sourceid: str, segment: Any, path: Path, number: int) -> Trace:  # noqa: ANN401 - see above
    sensor, channel, is_coded = _codes(pymseed, sourceid, path, number)
    rate = float(segment.samprate)
    return Trace(
        sensor=sensor,
        channel=channel,
        start_ns=int(segment.starttime),
        sampling_rate=rate if rate >= 0 else -1.0 / rate,
        samples=segment.take_np_datasamples(),
        end_ns=int(segment.endtime),
        fdsn=is_coded,
    )


def miniseed_parts(path: Path) -> Iterator[MiniSeedPart]:
    """Yield the parts of a file, in its order.

    Records are as long as the first one, as in nearly all files, if there is a header wherever a
    part would begin; otherwise they are walked through.

    Raises
    ------
    ImportFormatError
        pymseed is not installed, or the file begins with no record.
    """
    pymseed = load("pymseed", reads="miniSEED is", extra="miniseed")
    size = path.stat().st_size
    with path.open("rb") as file:
        try:
            length = int(pymseed.MS3Record.parse(file.read(_PART_BYTES)).reclen)
        except (pymseed.MiniSEEDError, ValueError) as error:
            raise ImportFormatError(f"{path}: not sound miniSEED: {error}") from error
        whole = size // length * length
        step = max(1, _PART_BYTES // length) * length
        bounds = [*range(0, whole, step), whole]
        for offset in bounds[1:-1]:
            file.seek(offset)
            if not _is_header(file.read(_HEADER_BYTES)):
                bounds, length = _walked(pymseed, path), 0
                break
    for offset, end in pairwise(bounds if bounds[-1] == size else [*bounds, size]):
        yield MiniSeedPart(path, offset, end, length)


def _walked(pymseed: Any, path: Path) -> list[int]:  # noqa: ANN401 - see above
    """Return where parts begin, from record to record; the last one where no record follows."""
    bounds, at = [0], 0
    with (
        contextlib.suppress(pymseed.MiniSEEDError, ValueError),
        pymseed.MS3RecordReader(str(path)) as records,
    ):
        for record in records:
            at += record.reclen
            if at - bounds[-1] >= _PART_BYTES:
                bounds.append(at)
    return bounds if bounds[-1] == at else [*bounds, at]
