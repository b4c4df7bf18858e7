"""A real browser, and a bench that it looks at."""

from __future__ import annotations

import os
import shutil
from importlib.util import find_spec
from typing import TYPE_CHECKING, TypeAlias

import pytest

from tests.tui.web.pages import SECRETS, Server, bench_file, serving

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from playwright.sync_api import Browser, Page

    Barriers: TypeAlias = Callable[[Page], list[tuple[str, str]]]

CHROMIUM = os.environ.get("HUDDLE_CHROMIUM") or shutil.which("chromium")
SIZES = {"desk": (1280, 900), "phone": (390, 844)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the bench of a module."""
    return tmp_path_factory.mktemp("bench")


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    """Serve without secrets, on this computer."""
    with serving(bench_file(folder)) as found:
        yield found


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Serve with secrets."""
    folder = tmp_path_factory.mktemp("closed")
    bench = bench_file(folder, SECRETS)
    with serving(bench) as found:
        yield found


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """Start Chromium, once for a module; skip its tests where there is none."""
    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium, or HUDDLE_CHROMIUM=PATH")
    if find_spec("playwright") is None:
        pytest.skip("no playwright")
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def browser(chromium: Browser) -> Iterator[Browser]:
    """Yield the browser; forget the visitors of the test, with their cookies, when it ends."""
    yield chromium
    for context in chromium.contexts:
        context.close()


@pytest.fixture
def wrong() -> Iterator[list[str]]:
    """Collect what pages complain about, and fail the test where they do."""
    found: list[str] = []
    yield found
    assert found == []


@pytest.fixture(scope="session")
def barriers() -> Barriers:
    """Return what finds the barriers of a page, each with its element; skip where nothing does."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()

    def found(page: Page) -> list[tuple[str, str]]:
        violations = axe.run(page).response["violations"]
        return [(each["id"], each["nodes"][0]["html"]) for each in violations]

    return found


def opened(browser: Browser, wrong: list[str], size: str = "desk", *, script: bool = True) -> Page:
    """Return a new tab of a visitor of its own, whose complaints are collected."""
    width, height = SIZES[size]
    context = browser.new_context(
        viewport={"width": width, "height": height}, java_script_enabled=script
    )
    page = context.new_page()
    page.set_default_timeout(60_000 * float(os.environ.get("HUDDLE_TEST_PATIENCE", "1")))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("dialog", lambda dialog: wrong.append(f"dialog: {dialog.message}"))
    page.on(
        "console",
        lambda message: wrong.append(message.text) if "Content Security" in message.text else None,
    )
    return page
