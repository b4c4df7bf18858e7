"""A running test in the browser: started, seen, marked and stopped there, by simulated devices."""

from __future__ import annotations

import re
import signal
import socket
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from daq.recording.reader import Recording
from tests.tui.demo_bench import demo_devices
from tests.tui.web.conftest import SIZES, opened
from tests.tui.web.pages import READER, SECRETS, STEERER, Server, serving
from tests.waiting import limit, wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from playwright.sync_api import Browser, Page

    from tests.tui.web.conftest import Barriers

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals"),
]
VIEWERS = 20


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Path]:
    """Yield a bench file with secrets that reaches three simulated accelerometers."""
    with demo_devices(tmp_path, speed=1.0, more=SECRETS) as path:
        yield path


def test_a_test_is_started_seen_marked_and_stopped(
    bench: Path, browser: Browser, wrong: list[str], barriers: Barriers
) -> None:
    with serving(bench) as server:
        looks = server.visit(READER)
        page = opened(browser, wrong)
        _log_in(page, server)
        assert "No test is running." in page.locator("#state").inner_text()
        page.locator("a:text('Start a test')").click()
        assert barriers(page) == []
        page.locator("input[name=operator]").fill("Ada <i>")
        page.locator("input[name=duration]").fill("")
        page.locator("main button").click()
        page.wait_for_selector("#state:has-text('running')")
        page.wait_for_selector("#sensors >> text=live")
        page.wait_for_selector("#chart[data-drawn*=three-sensor]")
        page.wait_for_selector("#noise >> text=A.X")
        assert "Hz, dB re 1 (m/s²)²/Hz" in page.locator("#noise h2").inner_text()
        assert page.locator(".traces li").count() == 9
        assert page.locator("#state >> text=SIMULATED").is_visible()
        assert barriers(page) == []
        page.set_viewport_size({"width": SIZES["phone"][0], "height": SIZES["phone"][1]})
        wait_until(
            lambda: page.evaluate("document.documentElement.scrollWidth") <= SIZES["phone"][0],
            "the chart has the width of a phone",
        )
        assert barriers(page) == []
        before = page.locator("#at").inner_text()
        wait_until(lambda: page.locator("#at").inner_text() != before, "the page goes on")

        _look(server, looks.headers["Cookie"])

        page.locator("input[name=text]").fill("door <b>slammed</b>")
        page.locator("button:text('Mark')").click()
        page.wait_for_selector("#events >> text=door <b>slammed</b> (Ada, 127.0.0.1)")
        page.locator("a:text('Stop the test')").click()
        assert barriers(page) == []
        page.locator("main button").click()
        page.wait_for_selector("#state >> text=its result")
        page.locator("#state a").click()
        page.wait_for_selector("#chart[data-drawn*=three-sensor]")
        log = server.log.read_text()
        page.goto(f"{server.url}tests")
        assert page.locator("td:text-is('demo, simulated')").is_visible()
        assert re.search(r"Ada \(127\.0\.0\.1\) started \S+\.h5 in the browser", log)
        assert re.search(r"Ada \(127\.0\.0\.1\) stopped \S+\.h5 in the browser", log)
    (path,) = (bench.parent / "recordings").glob("*.h5")
    with Recording.open(path) as recording:
        assert recording.closed
        assert recording.operator == "Ada <i>"
        marks = [event.text.split(" (")[0] for event in recording.events if event.kind == "mark"]
        assert "web" not in recording.bench_text
    assert marks == [
        "started in the browser by Ada",
        "door <b>slammed</b>",
        "stopped in the browser by Ada",
    ]


def _log_in(page: Page, server: Server) -> None:
    page.goto(server.url)
    page.locator("input[name=name]").fill("Ada")
    page.locator("input[name=secret]").fill(STEERER)
    page.locator("main button").click()
    page.wait_for_selector("#live")


def _look(server: Server, cookie: str) -> None:
    """Look with many at once: all get the whole page, and then what changes."""
    place = urlsplit(server.url)
    asked = f"GET /events HTTP/1.1\r\nHost: {place.netloc}\r\nCookie: {cookie}\r\n\r\n"
    with ExitStack() as stack:
        viewers = [
            stack.enter_context(
                socket.create_connection((place.hostname, place.port), timeout=limit())
            )
            for _ in range(VIEWERS)
        ]
        for viewer in viewers:
            viewer.sendall(asked.encode())
        for viewer in viewers:
            found = b""
            while found.count(b"data: {") < 4:
                part = viewer.recv(1 << 16)
                assert part
                found += part
            assert found.startswith(b"HTTP/1.1 200")
            assert b"sensors" in found


def test_a_lost_server_is_named_and_found_again(
    bench: Path, browser: Browser, wrong: list[str]
) -> None:
    with serving(bench) as server:
        page = opened(browser, wrong)
        _log_in(page, server)
        page.wait_for_selector("#service >> text=disk")
        port = int(server.url.rsplit(":", 1)[1].strip("/"))
        server.process.send_signal(signal.SIGKILL)
        server.process.wait()
        page.wait_for_selector("#lost >> text=connection lost since")
        lost = page.locator("#lost").inner_text()
        assert re.fullmatch(r", connection lost since \d\d:\d\d", lost)
        assert page.locator("#live.stale").count() == 1
    with serving(bench, port=port):
        wait_until(lambda: page.locator("#lost").inner_text() == "", "the page is back")
        assert page.locator("#live.stale").count() == 0
        assert "Ada, may start and stop" in page.locator("header").inner_text()
