"""Folders of the SeisComP Data Structure (SDS): a file for each channel and day.

``ROOT/YEAR/NET/STA/CHAN.D/NET.STA.LOC.CHAN.D.YEAR.DAY``, miniSEED. Samples of a day may be at the
end of the file of the day before, so that is read as well.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from daq.errors import ImportFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator

SCHEME = "sds://"
_N_FIELDS = 7
_NS_PER_S = 1_000_000_000


class Codes(Protocol):
    """Which files are wanted; patterns of codes, and UTC in ns."""

    @property
    def networks(self) -> str:
        """Pattern of network codes."""

    @property
    def stations(self) -> str:
        """Pattern of station codes."""

    @property
    def locations(self) -> str:
        """Pattern of location codes."""

    @property
    def start_ns(self) -> int | None:
        """UTC of the start, if there is one."""

    @property
    def end_ns(self) -> int | None:
        """UTC of the end, if there is one."""


def sds_files(url: str, codes: Codes) -> Iterator[Path]:
    """Yield the waveform files of an archive by channel and day.

    Raises
    ------
    ImportFormatError
        There is no such folder.
    """
    root = Path(url.removeprefix(SCHEME)).expanduser()
    if not root.is_dir():
        raise ImportFormatError(f"{url}: no such folder; expected sds://ROOT, with a folder a year")
    first = None if codes.start_ns is None else _day(codes.start_ns) - timedelta(days=1)
    last = None if codes.end_ns is None else _day(codes.end_ns - 1)
    pattern = f"[0-9][0-9][0-9][0-9]/{codes.networks}/{codes.stations}/*.D/*"
    found: list[tuple[str, datetime, Path]] = []
    for path in root.glob(pattern):
        fields = path.name.split(".")
        if len(fields) != _N_FIELDS or not (fields[5].isdigit() and fields[6].isdigit()):
            continue
        if codes.locations != "*" and not Path(fields[2] or "--").match(codes.locations):
            continue
        day = datetime(int(fields[5]), 1, 1, tzinfo=UTC) + timedelta(days=int(fields[6]) - 1)
        if (first is None or day >= first) and (last is None or day <= last):
            found.append((".".join(fields[:4]), day, path))
    yield from (path for *_, path in sorted(found))


def _day(instant_ns: int) -> datetime:
    when = datetime.fromtimestamp(instant_ns // _NS_PER_S, tz=UTC)
    return when.replace(hour=0, minute=0, second=0)
