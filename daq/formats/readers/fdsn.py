"""Data and responses from centres that speak fdsnws-dataselect and fdsnws-station, by ObsPy.

``fdsn://CENTRE/NETWORK.STATION.LOCATION.CHANNEL``: the centre is a name that ObsPy knows, such as
EARTHSCOPE or GFZ, or a host with or without a port. Codes may have ``?`` and ``*``, and
alternatives in braces: ``IU.ANMO.{00,10}.BH?``. Data come by day into files, so memory does not
grow with them.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import NS_PER_S
from daq.formats.readers.waveforms import load_obspy

FDSN = "fdsn://"
_DAY_NS = 86_400 * NS_PER_S
_N_CODES = 4
_NO_DATA = 204
"""Status by which a service says that it has nothing of this kind."""


@dataclass(frozen=True, slots=True)
class Fetched:
    """What a centre had.

    Attributes
    ----------
    waveforms : list of Path
        miniSEED files, by day.
    responses : Path
        StationXML.
    """

    waveforms: list[Path]
    responses: Path


def fetch(url: str, start_ns: int | None, end_ns: int | None, folder: Path) -> Fetched:
    """Fetch samples and responses from `start_ns` to `end_ns` into a folder.

    Raises
    ------
    ImportFormatError
        The address or the span of time is not complete, or the centre does not answer or has no
        data.
    """
    centre, codes = _parsed(url)
    if start_ns is None or end_ns is None:
        raise ImportFormatError(f"{url}: from when to when? Expected --start and --end")
    client = _client(url, centre)
    time: Any = load_obspy().UTCDateTime
    waveforms = []
    for number, (begin, end) in enumerate(_days(start_ns, end_ns)):
        path = folder / f"{number:05d}.mseed"
        span = {"starttime": time(ns=begin), "endtime": time(ns=end)}
        if _asked(url, client.get_waveforms, path, **codes, **span):
            waveforms.append(path)
    if not waveforms:
        raise ImportFormatError(
            f"{url}: the centre has no data of these channels from {time(ns=start_ns)} to"
            f" {time(ns=end_ns)}"
        )
    responses = folder / f"{centre.replace('/', '-')}.xml"
    span = {"starttime": time(ns=start_ns), "endtime": time(ns=end_ns), "level": "response"}
    if not _asked(url, client.get_stations, responses, **codes, **span):
        raise ImportFormatError(f"{url}: the centre has no responses of these channels")
    return Fetched(waveforms, responses)


def _parsed(url: str) -> tuple[str, dict[str, str]]:
    """Return the centre and the codes of an address."""
    centre, slash, text = url.removeprefix(FDSN).partition("/")
    fields = re.sub(r"\{([^{}]*)\}", lambda found: found[1], text).split(".")
    if not centre or not slash or len(fields) != _N_CODES or not all((*fields[:2], fields[3])):
        raise ImportFormatError(
            f"{url}: expected {FDSN}CENTRE/NETWORK.STATION.LOCATION.CHANNEL, as in"
            f" {FDSN}EARTHSCOPE/IU.ANMO.00.BH?"
        )
    names = ("network", "station", "location", "channel")
    codes = dict(zip(names, fields, strict=True))
    return centre, codes | {"location": codes["location"] or "--"}


def _client(url: str, centre: str) -> Any:  # noqa: ANN401 - ObsPy has no types
    load_obspy()
    from obspy.clients.fdsn import Client  # noqa: PLC0415 - an extra
    from obspy.clients.fdsn.header import URL_MAPPINGS  # noqa: PLC0415 - see above

    is_host = "." in centre or ":" in centre or centre == "localhost"
    if not is_host and centre.upper() not in URL_MAPPINGS:
        raise ImportFormatError(
            f"{url}: unknown centre {centre!r}; expected a host, or one of"
            f" {', '.join(sorted(URL_MAPPINGS))}"
        )
    address = f"http://{centre}" if is_host else centre.upper()
    try:
        return Client(address, _discover_services=False)
    except Exception as error:
        raise ImportFormatError(f"{url}: {error}") from error


def _asked(url: str, ask: Any, path: Path, **query: Any) -> bool:  # noqa: ANN401 - see above
    """Write the answer to a query to a file; return whether there is one.

    Raises
    ------
    ImportFormatError
        The centre does not answer, or refuses.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ask(filename=str(path), **query)
    except Exception as error:
        if getattr(error, "status_code", None) == _NO_DATA:
            return False
        reason = " ".join(str(error).split())
        raise ImportFormatError(f"{url}: the centre gives no answer: {reason}") from error
    return path.is_file() and path.stat().st_size > 0


def _days(start_ns: int, end_ns: int) -> Iterator[tuple[int, int]]:
    while start_ns < end_ns:
        following = min(end_ns, (start_ns // _DAY_NS + 1) * _DAY_NS)
        yield start_ns, following
        start_ns = following
