"""A data centre: fdsnws-dataselect and fdsnws-station of one folder, over HTTP.

``python -m tests.peers.fdsn_server FOLDER`` serves ``*.mseed`` and ``*.xml``, prints its port, and
ends when standard input does. It filters by code and time as the services are specified, with
ObsPy, and shares no code with the client.
"""

from __future__ import annotations

import io
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import obspy  # an extra, without types

_SHORT = {
    "net": "network",
    "sta": "station",
    "loc": "location",
    "cha": "channel",
    "start": "starttime",
    "end": "endtime",
}


class Centre(BaseHTTPRequestHandler):
    """Answers queries from the files of `folder`."""

    folder: Path

    def do_GET(self) -> None:
        """Answer a query; 204 where there is nothing."""
        address = urlsplit(self.path)
        query = {key: values[-1] for key, values in parse_qs(address.query).items()}
        query = {_SHORT.get(key, key): value for key, value in query.items()}
        if address.path == "/fdsnws/dataselect/1/query":
            self._answer(self._samples(query), "application/vnd.fdsn.mseed")
        elif address.path == "/fdsnws/station/1/query":
            self._answer(self._stations(query), "application/xml")
        else:
            self.send_error(404)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401 - as http.server has it
        """Say nothing."""

    def _answer(self, body: bytes, kind: str) -> None:
        self.send_response(200 if body else 204)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _samples(self, query: dict[str, str]) -> bytes:
        found: Any = obspy.Stream()
        for path in sorted(self.folder.glob("*.mseed")):
            stream = obspy.read(str(path), format="MSEED")
            for network in query["network"].split(","):
                for location in query["location"].replace("--", "").split(","):
                    for channel in query["channel"].split(","):
                        found += stream.select(
                            network=network,
                            station=query["station"],
                            location=location,
                            channel=channel,
                        )
        found = found.slice(
            obspy.UTCDateTime(query["starttime"]), obspy.UTCDateTime(query["endtime"])
        )
        if not found:
            return b""
        body = io.BytesIO()
        found.write(body, format="MSEED")
        return body.getvalue()

    def _stations(self, query: dict[str, str]) -> bytes:
        if query.get("level") != "response":
            return b""
        whole: Any = None
        for path in sorted(self.folder.glob("*.xml")):
            inventory = obspy.read_inventory(str(path), format="STATIONXML")
            whole = inventory if whole is None else whole + inventory
        if whole is None:
            return b""
        found: Any = None
        for location in query["location"].replace("--", "").split(","):
            part = whole.select(
                network=query["network"],
                station=query["station"],
                location=location,
                channel=query["channel"],
            )
            found = part if found is None else found + part
        if not len(found):
            return b""
        body = io.BytesIO()
        found.write(body, format="STATIONXML")
        return body.getvalue()


def main(folder: Path) -> None:
    """Serve a folder until standard input ends."""
    Centre.folder = folder
    with ThreadingHTTPServer(("127.0.0.1", 0), Centre) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(server.server_address[1], flush=True)
        sys.stdin.read()
        server.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
