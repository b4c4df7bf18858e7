"""Requests that no browser sends: of the right kind, with anything changed."""

from __future__ import annotations

import random
import socket
from collections import Counter
from urllib.parse import quote_from_bytes, urlsplit

from tests.tui.web.pages import Server
from tests.waiting import limit

METHODS = (b"GET",) * 12 + (b"POST",) * 5 + (b"HEAD", b"PUT", b"OPTIONS", b"TRACE", b"X-" * 20)
PATHS = (
    "/", "/now/curves", "/tests", "/tests/night.h5", "/tests/night.h5/curves",
    "/tests/night.h5/result.json", "/tests/night.h5/curves.csv", "/tests/night.h5/report.html",
    "/tests/night.h5/report.pdf", "/tests/night.h5/certificate/0", "/sensors", "/archive",
    "/archive/days.png", "/archive/density.png", "/login", "/logout", "/start", "/stop", "/mark",
    "/static/huddle.css", "/static/../access.py", "/tests/none.h5", "/tests/night.h5/certificate/",
)  # fmt: skip
NAMES = ("channel", "unit", "from", "to", "with", "first", "text", "verdict", "next", "method")
VALUES = (
    b"", b"0", b"1", b"-1", b"nan", b"inf", b"1e400", b"9" * 400, b"9" * 5000, b"night.h5",
    b"\xff\xfe", b"\0", b"..%2f", "²".encode(), "٣".encode(), b"<script>", b"//evil", b"%", b"a=b",
)  # fmt: skip
FIELDS = (
    b"Cookie", b"Authorization", b"Origin", b"Accept", b"Content-Type", b"X-Forwarded-For",
    b"X-Forwarded-Proto", b"Range", b"If-None-Match", b"If-Modified-Since", b"Expect", b"Upgrade",
    b"Transfer-Encoding", b"Content-Length", b"Host", b"Referer",
)  # fmt: skip
CONTENTS = (
    b"bytes=0-", b"bytes=9-1,-,x", b"http://[", b"null", b"Bearer x", b"Bearer", b"Basic \xff",
    b"websocket", b"chunked", b"text/html", b"100-continue", b"9" * 400, b"Mon, 99 Foo", b"a\tb",
    b"multipart/form-data; boundary=", b"huddle-PORT=e30.00", b"huddle-PORT=\xff; \xfe", b"",
)  # fmt: skip


def request(chance: random.Random, host: bytes, cookie: bytes) -> bytes:
    """Return a request, drawn by lot."""
    method, path = chance.choice(METHODS), chance.choice(PATHS).encode()
    if chance.random() < 0.2:
        at = chance.randrange(len(path))
        path = b"/" + path[1:at] + chance.choice(VALUES)[:400] + path[at:]
    path = quote_from_bytes(path, safe="/%").encode()
    if chance.random() < 0.5:
        pairs = (
            chance.choice(NAMES).encode() + b"=" + quote_from_bytes(chance.choice(VALUES)).encode()
            for _ in range(chance.randint(1, 4))
        )
        path += b"?" + b"&".join(pairs)
    lines = [method + b" " + path + b" HTTP/1.1", b"Connection: close"]
    if chance.random() < 0.95:
        lines.append(b"Host: " + host)
    if chance.random() < 0.7:
        lines.append(b"Cookie: " + cookie)
    for _ in range(chance.choice((0, 0, 1, 2))):
        content = chance.choice(CONTENTS).replace(b"PORT", host.rpartition(b":")[2])
        lines.append(chance.choice(FIELDS) + b": " + content)
    body = b""
    if method in {b"POST", b"PUT"}:
        names = (*NAMES, "name", "secret", "token", "operator", "duration")
        body = b"&".join(
            chance.choice(names).encode() + b"=" + chance.choice(VALUES)
            for _ in range(chance.randint(0, 5))
        )
        if chance.random() < 0.1:
            body = chance.randbytes(chance.choice((1, 100, 20_000)))
        if not any(line.startswith((b"Content-Length", b"Transfer-")) for line in lines):
            lines.append(b"Content-Length: %d" % len(body))
    return b"\r\n".join([*lines, b"", body])


def fuzzed(server: Server, cookie: str, n: int, *, seed: int) -> Counter[int]:
    """Send requests drawn by lot; return how often which status came, 0 for none."""
    place, chance = urlsplit(server.url), random.Random(seed)
    found: Counter[int] = Counter()
    for _ in range(n):
        sent = request(chance, place.netloc.encode(), cookie.encode())
        waits = b"\r\nExpect:" in sent or b"\r\nTransfer-" in sent or sent.count(b"-Length:") > 0
        with socket.create_connection((place.hostname, place.port), timeout=limit(60)) as asking:
            answer = b""
            try:
                asking.sendall(sent)
                if waits and b"Content-Length: 9" in sent:  # of a body that never comes
                    asking.shutdown(socket.SHUT_WR)
                while b"\r\n" not in answer and (part := asking.recv(1 << 16)):
                    answer += part
            except ConnectionError:
                pass
        status = answer.split(b" ", 2)[1] if answer.count(b" ") > 1 else b"0"
        found[int(status)] += 1
        if int(status) >= 500:
            print(sent[:2000], answer[:200])
    return found
