"""A server of pages as a process of its own, and who asks it."""

from __future__ import annotations

import http.client
import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from daq.python_process import python_command
from tests.tui.night_recording import record
from tests.waiting import limit, wait_until
from tui.web.access import token_hash

READER, STEERER = "a token of who looks at pages", "a password of who steers"
STEERER_HASH = (
    "scrypt:19477e2e6b908813dd60db9391fc17b8"
    ":5b72f738381982fe7d7e85598d6554049c9685fc959bde4fdad7539835f95dc9"
)
"""What `password_hash` made of it once: to hash it takes time in all who collect tests."""
BENCH = """
name = "cellar <b>"
sampling_rate = 100.0
{tables}
"""
SENSOR = """
[[sensors]]
name = "{name}"
driver = "text"
port = "/dev/tty{name}"
channels = [{{name = "X", sensitivity = 1e6}}]
"""
SECRETS = f"""
[web]
read = "{token_hash(READER)}"
steer = "{STEERER_HASH}"
"""


def bench_file(folder: Path, web: str = "") -> Path:
    """Write a bench file with one test beside it; return it."""
    path = folder / "cellar.toml"
    path.write_text(BENCH.format(tables="".join(SENSOR.format(name=n) for n in "ABC") + web))
    (folder / "recordings").mkdir(exist_ok=True)
    recording = folder / "recordings" / "night.h5"
    if not recording.exists():
        record(recording)
    return path


@dataclass
class Answer:
    """What a server answered."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def text(self) -> str:
        """The content as text."""
        return self.content.decode()


@dataclass
class Visit:
    """Somebody who asks a server, with the cookie that they were given."""

    url: str
    headers: dict[str, str] = field(default_factory=dict)

    def get(self, path: str, **headers: str) -> Answer:
        """Ask for a page."""
        return self._ask("GET", path, None, headers)

    def post(self, path: str, form: Mapping[str, str], **headers: str) -> Answer:
        """Send a form."""
        sent = {"Content-Type": "application/x-www-form-urlencoded", **headers}
        return self._ask("POST", path, urlencode(form), sent)

    def log_in(self, secret: str, name: str = "Ada") -> Answer:
        """Log in, and keep the cookie."""
        answer = self.post("/login", {"name": name, "secret": secret, "next": "/tests"})
        if cookie := answer.headers.get("set-cookie"):
            self.headers["Cookie"] = cookie.partition(";")[0]
        return answer

    def _ask(self, method: str, path: str, body: str | None, headers: Mapping[str, str]) -> Answer:
        connection = http.client.HTTPConnection(urlsplit(self.url).netloc, timeout=limit(60))
        try:
            sent = {"Accept": "text/html", **self.headers, **headers}
            connection.request(method, path, body, sent)
            answer = connection.getresponse()
            known = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(answer.status, known, answer.read())
        finally:
            connection.close()


@dataclass
class Server:
    """A running server."""

    url: str
    process: subprocess.Popen[bytes]
    log: Path

    def descriptors(self) -> int | None:
        """Return how many descriptors the server has open; None where that cannot be seen."""
        try:
            return len(os.listdir(f"/proc/{self.process.pid}/fd"))  # noqa: PTH208 - all that counts
        except FileNotFoundError:
            return None

    def visit(self, secret: str = "", name: str = "Ada") -> Visit:
        """Return somebody new, who logs in with a secret if one is given."""
        found = Visit(self.url.rstrip("/"))
        if secret:
            found.log_in(secret, name)
        return found


@contextmanager
def serving(bench: Path, *, port: int = 0, descriptors: int = 0) -> Iterator[Server]:
    """Serve the pages of a bench until the context ends, with so many descriptors."""
    log = bench.with_suffix(".log")
    out = bench.with_suffix(".out")
    command = [*python_command("tui", "web", str(bench), "--port", str(port))]
    if descriptors:
        command = ["sh", "-c", f'ulimit -n {descriptors}; exec "$@"', "sh", *command]
    with out.open("wb") as stdout, log.open("ab") as stderr:
        process = subprocess.Popen(
            command,
            stdout=stdout,
            stderr=stderr,
            env=os.environ
            | {"PYTHONUNBUFFERED": "1", "XDG_STATE_HOME": str(bench.parent / "state")},
        )
    try:

        def is_ready() -> bool:
            assert process.poll() is None, log.read_text()
            return "http" in out.read_text()

        wait_until(is_ready, "the server has its port")
        yield Server(out.read_text().split()[-1], process, log)
    finally:
        process.terminate()
        process.wait(limit(60))
