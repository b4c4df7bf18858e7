"""miniSEED 2 and 3, read by libmseed (pymseed).

A sensor is ``network.station.location``, its channels are the channel codes. A file is read in
parts of a megabyte, at the boundaries of its records, so files of any size take little memory.
libmseed joins records that continue each other within half a sample, and gives the times that the
first and the last record state: the clock of the digitizer is in them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from daq.errors import ImportFormatError
from daq.formats.traces import Trace

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

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


def _pymseed() -> Any:  # noqa: ANN401 - its classes are made at run time
    try:
        import pymseed  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ImportFormatError(
            "miniSEED is read by pymseed, which is not installed; run: pip install"
            " 'huddle-bench[formats]'"
        ) from error
    return pymseed


@dataclass(frozen=True, slots=True, eq=False)
class MiniSeedPart:
    """Records of a file, from one byte to another."""

    path: Path
    offset: int
    end: int

    @property
    def source(self) -> str:
        """The file, in messages."""
        return str(self.path)

    def load(self) -> Sequence[Trace]:
        """Return the traces in these records; text, such as a log, is left out."""
        pymseed = _pymseed()
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset)
                content = file.read(self.end - self.offset)
            found = pymseed.MS3TraceList.from_buffer(content, unpack_data=True)
            traces = [
                _trace(pymseed, trace.sourceid, segment)
                for trace in found
                for segment in trace
                if segment.sampletype in _NUMERIC and segment.samprate and segment.numsamples
            ]
            n_channels = len(found)
        except (pymseed.MiniSEEDError, ValueError, OverflowError) as error:
            raise self._damaged(str(error)) from error
        if n_channels == 0:
            raise self._damaged("an incomplete record")
        return traces

    def _damaged(self, reason: str) -> ImportFormatError:
        where = f"bytes {self.offset} to {self.end}"
        return ImportFormatError(f"{self.path}: {where} are not sound miniSEED: {reason}")


def _trace(pymseed: Any, sourceid: str, segment: Any) -> Trace:  # noqa: ANN401 - see above
    network, station, location, channel = pymseed.sourceid2nslc(sourceid)
    rate = float(segment.samprate)
    return Trace(
        sensor=".".join(code for code in (network, station, location) if code),
        channel=channel,
        start_ns=int(segment.starttime),
        sampling_rate=rate if rate > 0 else -1.0 / rate,
        samples=segment.take_np_datasamples(),
        end_ns=int(segment.endtime),
        fdsn=True,
    )


def miniseed_parts(path: Path) -> Iterator[MiniSeedPart]:
    """Yield the parts of a file, in its order.

    Raises
    ------
    ImportFormatError
        pymseed is not installed, or the file begins with no record.
    """
    bounds = _bounds(path)
    for offset, end in pairwise(bounds):
        yield MiniSeedPart(path, offset, end)


def _bounds(path: Path) -> list[int]:
    """Return where parts begin, and the end of the file.

    Records are as long as the first one, as in nearly all files, if there is a header wherever a
    part would begin; otherwise they are walked through.
    """
    pymseed = _pymseed()
    size = path.stat().st_size
    with path.open("rb") as file:
        try:
            length = int(pymseed.MS3Record.parse(file.read(_PART_BYTES)).reclen)
        except (pymseed.MiniSEEDError, ValueError) as error:
            raise ImportFormatError(f"{path}: not sound miniSEED: {error}") from error
        step = max(1, _PART_BYTES // length) * length
        whole = size // length * length
        bounds = sorted({*range(0, whole, step), whole, size})
        for offset in bounds[1:-1]:
            file.seek(offset)
            if not _is_header(file.read(_HEADER_BYTES)):
                return _walked(pymseed, path)
    return bounds


def _walked(pymseed: Any, path: Path) -> list[int]:  # noqa: ANN401 - see above
    bounds, at = [0], 0
    try:
        with pymseed.MS3RecordReader(str(path)) as records:
            for record in records:
                at += record.reclen
                if at - bounds[-1] >= _PART_BYTES:
                    bounds.append(at)
    except (pymseed.MiniSEEDError, ValueError) as error:
        raise ImportFormatError(f"{path}: from byte {at} not sound miniSEED: {error}") from error
    return bounds if bounds[-1] == at else [*bounds, at]
