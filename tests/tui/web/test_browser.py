"""The pages in a real browser: every width, zoom, reading off, downloads, comparison, login."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Literal

import pytest

from tests.tui.night_recording import HOSTILE, record
from tests.tui.web.conftest import SIZES, opened
from tests.tui.web.pages import READER, SECRETS, Server, bench_file, serving
from tests.waiting import wait_until

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Browser, Page

    from tests.tui.web.conftest import Barriers

pytestmark = pytest.mark.usefixtures("chromium")  # no server where there is none
PAGES = {"/": "Now", "/tests": "Tests", "/tests/night.h5": "night", "/login": "Log in"}
DRAWN = "#chart[data-drawn]"


@pytest.mark.parametrize("size", SIZES)
def test_every_page_fits_and_has_no_barrier(
    server: Server, browser: Browser, wrong: list[str], size: str, barriers: Barriers
) -> None:
    page = opened(browser, wrong, size)
    for path, title in PAGES.items():
        page.goto(server.url.rstrip("/") + path)
        assert page.title() == f"{title} · cellar <b>"
        if path == "/tests/night.h5":
            page.wait_for_selector(DRAWN)
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        assert barriers(page) == []


def test_a_page_without_script_is_whole(server: Server, browser: Browser, wrong: list[str]) -> None:
    page = opened(browser, wrong, script=False)
    page.goto(f"{server.url}tests/night.h5?channel=3")
    assert page.locator("#plot > svg").is_visible()
    assert "B Y " in str(page.locator("#plot > svg").get_attribute("aria-label"))
    page.locator("select[name=channel]").select_option(label=f"{HOSTILE}.X")
    page.locator("button:text('Show')").click()
    assert HOSTILE in str(page.locator("#plot > svg").get_attribute("aria-label"))


def test_curves_are_zoomed_and_read_off(server: Server, browser: Browser, wrong: list[str]) -> None:
    page = opened(browser, wrong)
    page.goto(f"{server.url}tests/night.h5")
    page.wait_for_selector(DRAWN)
    low, high = _span(page)
    assert (low, high) == pytest.approx((1.0, 49.0))
    box = page.locator(".u-over").bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.5 * box["width"], middle)
    wait_until(lambda: " Hz, dB re" in page.locator("#reading").inner_text(), "values are read")
    reading = page.locator("#reading").inner_text()
    value = r"maximum-likelihood −9\d\.\d \(−\d+\.\d to −\d+\.\d\)"
    assert re.fullmatch(rf"7(\.\d+)? Hz, dB re 1 \(m/s²\)²/Hz: .*{value}.*", reading)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], middle, steps=5)
    page.mouse.up()
    wait_until(lambda: _span(page)[0] > 5, "the curves are zoomed")
    low, high = _span(page)
    assert 6 < low < 8
    assert 15 < high < 22
    page.locator("#whole").click()
    wait_until(lambda: _span(page)[0] < 2, "the whole spectrum is back")


def _span(page: Page) -> tuple[float, float]:
    low, high = str(page.locator("#chart").get_attribute("data-span")).split()
    return float(low), float(high)


def test_units_and_two_tests_are_chosen(
    server: Server, folder: Path, browser: Browser, wrong: list[str]
) -> None:
    other = folder / "recordings" / "later.h5"
    if not other.exists():
        record(other)
    page = opened(browser, wrong)
    page.goto(f"{server.url}tests/night.h5")
    page.wait_for_selector(DRAWN)
    page.locator("select[name=unit]").select_option(label="ng/√Hz")
    page.wait_for_selector(".u-axis >> nth=0")
    page.wait_for_url("**unit=3**")
    page.locator("select[name=with]").select_option("later.h5")
    page.wait_for_selector("#chart[data-drawn~=later]")
    assert page.locator("h2:text('Noise against later.h5')").is_visible()
    differences = page.locator("section[aria-labelledby=differences-title] td").all_inner_texts()
    assert differences[0] == "+0.00 ±0.52"


def test_results_are_downloaded(server: Server, browser: Browser, wrong: list[str]) -> None:
    page = opened(browser, wrong)
    page.goto(f"{server.url}tests/night.h5")
    with page.expect_download() as download:
        page.locator("a:text('JSON')").click()
    assert download.value.suggested_filename == "night.json"
    with download.value.path().open(encoding="utf-8") as file:
        assert json.load(file)["verdict"] == "not-decided"
    page.locator("a.button:text-is('Report')").click()
    page.wait_for_url("**/report.html")
    assert page.locator("svg").first.is_visible()


def test_a_wrong_password_is_refused_and_a_right_one_leads_on(
    tmp_path: Path, browser: Browser, wrong: list[str]
) -> None:
    with serving(bench_file(tmp_path, SECRETS)) as closed:
        page = opened(browser, wrong)
        page.goto(f"{closed.url}tests/night.h5")
        assert page.url.endswith("/login?next=%2Ftests%2Fnight.h5")
        for secret in ("a wrong one", READER):
            page.locator("input[name=name]").fill("Ada")
            page.locator("input[name=secret]").fill(secret)
            page.locator("main button").click()
            if secret != READER:
                alert = page.locator("[role=alert]").inner_text()
                assert alert == "This password or token is wrong."
        page.wait_for_url("**/tests/night.h5")
        page.wait_for_selector(DRAWN)
        assert "Ada, may look" in page.locator("header").inner_text()
        page.locator("button:text('Log out')").click()
        page.wait_for_url("**/login?next=**")


@pytest.mark.parametrize("asked", ["light", "dark"])
def test_pages_follow_the_system_and_a_choice_is_kept(
    server: Server,
    browser: Browser,
    wrong: list[str],
    asked: Literal["light", "dark"],
    barriers: Barriers,
) -> None:
    page = opened(browser, wrong, "phone")
    page.emulate_media(color_scheme=asked)
    back = "getComputedStyle(document.body).backgroundColor"
    found = []
    for _ in range(2):
        page.goto(f"{server.url}tests")
        found.append(page.evaluate(back))
        assert barriers(page) == []
        page.locator("#theme").click()
    light, dark = "rgb(255, 255, 255)", "rgb(17, 21, 28)"
    assert found == ([light, dark] if asked == "light" else [dark, light])


def test_local_time_is_beside_utc(server: Server, browser: Browser) -> None:
    page = browser.new_context(timezone_id="Asia/Kathmandu").new_page()
    page.goto(f"{server.url}tests")
    assert page.locator("td time").first.inner_text() == "2016-07-14 01:00 (06:45 GMT+5:45)"


def test_a_phone_shows_tables_as_lists_with_the_verdict_whole(
    server: Server, browser: Browser, wrong: list[str]
) -> None:
    page = opened(browser, wrong, "phone")
    page.goto(f"{server.url}tests")
    for region in page.locator(".wide").all():
        assert region.evaluate("each => each.scrollWidth <= each.clientWidth")
    box = page.locator("td[data-title=verdict]").first.bounding_box()
    assert box is not None
    assert box["x"] + box["width"] <= SIZES["phone"][0]


def test_curves_have_the_noise_models(server: Server, browser: Browser, wrong: list[str]) -> None:
    page = opened(browser, wrong)
    page.goto(f"{server.url}tests/night.h5")
    page.wait_for_selector("#chart[data-drawn~=NLNM]")
    dashes = page.locator(".key path").evaluate_all(
        "all => all.map((each) => each.getAttribute('stroke-dasharray'))"
    )
    assert {"8 3", "2 3"} <= set(dashes)
