"""The page of a recording against time: as HTML, and in a browser with wheel, drag and keys."""

from __future__ import annotations

import json
import re
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
import pytest
from markupsafe import escape
from PIL import Image

from tests.tui.night_recording import HOSTILE
from tests.tui.web.conftest import SIZES, opened
from tests.tui.web.pages import Server, Visit
from tests.waiting import wait_until
from tui.web.signal import png

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from tests.tui.web.conftest import Barriers

PAGE = "tests/night.h5/signal"
START = 1_468_458_000.0


def span(page: Page) -> tuple[float, float]:
    """Return the span that is shown, in s after the start."""
    begin, end = str(page.locator("#signal").get_attribute("data-span")).split()
    return float(begin) - START, float(end) - START


def frame(page: Page) -> tuple[float, float, float]:
    """Return left, top and width of the waveforms, beside their names."""
    box = page.locator("svg.signal").bounding_box()
    assert box is not None
    return box["x"] + 0.11 * box["width"], box["y"], 0.89 * box["width"]


def test_the_picture_has_every_channel_and_the_gap(server: Server) -> None:
    """As text of a vector graphic; names of sensors cannot write tags."""
    visit = Visit(server.url)
    text = visit.get(f"/{PAGE}").text
    assert text.count('class="wave') == 8
    assert "B gap: cable pulled" in text
    assert "<script>alert" not in text
    assert str(escape(HOSTILE)) in text
    closer = visit.get(f"/{PAGE}?from={START + 20}&to={START + 30}").text
    assert "2016-07-14 01:00:20 to 01:00:30 UTC" in closer
    assert "cable pulled" not in closer


def test_a_time_is_found_and_nonsense_is_answered(server: Server) -> None:
    """With the whole recording and why; pictures of nonsense are refused."""
    visit = Visit(server.url)
    assert "01:00:00 to 01:00:59" in visit.get(f"/{PAGE}?at=01:00:30").text
    answer = visit.get(f"/{PAGE}?at=soon")
    assert answer.status == 200
    assert "expected a time as 03:12" in answer.text
    for asked in ("from=1e300&to=nan", "from=5&to=5", "channel=99", "channel=-1", "spectrum=x"):
        assert visit.get(f"/{PAGE}/picture?{asked}").status == 400
        assert visit.get(f"/{PAGE}?{asked}").status == 200
    assert visit.get("/tests/other.h5/signal").status == 404


def test_a_spectrogram_is_a_picture_in_the_page(server: Server) -> None:
    """With its frequencies and levels in text."""
    visit = Visit(server.url)
    wait_until(
        lambda: "data:image/png" in visit.get(f"/{PAGE}?spectrum=recorded").text, "it is estimated"
    )
    text = visit.get(f"/{PAGE}?spectrum=recorded&channel=2").text
    assert re.search(r"−\d+ to −\d+ dB re 1 \(m/s²\)²/Hz", text)
    assert " Hz</text>" in text


def test_the_png_is_one() -> None:
    """What is not known is transparent."""
    content = png(np.array([[0.0, 0.5, 1.0], [np.nan, 1.0, 0.0]]))
    pixels = np.asarray(Image.open(BytesIO(content)))
    assert pixels.shape == (2, 3, 4)
    assert pixels[..., 3].tolist() == [[255, 255, 255], [0, 255, 255]]


@pytest.mark.parametrize("size", SIZES)
def test_it_fits_and_has_no_barrier(
    server: Server, browser: Browser, wrong: list[str], size: str, barriers: Barriers
) -> None:
    """On a desk and a phone."""
    page = opened(browser, wrong, size)
    page.goto(server.url + PAGE)
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    assert barriers(page) == []


def test_wheel_drag_and_keys(server: Server, browser: Browser, wrong: list[str]) -> None:
    """The picture follows; the address is that of what is seen."""
    page = opened(browser, wrong)
    page.goto(server.url + PAGE)
    left, top, width = frame(page)
    page.mouse.move(left + width / 2, top + 50)
    page.mouse.wheel(0, -100)
    wait_until(lambda: span(page)[1] - span(page)[0] < 31, "it is zoomed")
    assert span(page) == pytest.approx((15, 45), abs=0.5)
    page.mouse.wheel(0, -100)
    wait_until(lambda: span(page)[1] - span(page)[0] < 16, "it is zoomed")
    page.mouse.down()
    page.mouse.move(left + width / 4, top + 50, steps=4)
    page.mouse.up()
    wait_until(lambda: span(page)[0] > 26, "it is dragged")
    assert span(page) == pytest.approx((26.25, 41.25), abs=0.5)
    picture = page.locator("svg.signal")
    wait_until(lambda: "01:00:26" in str(picture.get_attribute("aria-label")), "it is drawn")
    assert "from=" in page.url
    page.locator("#signal").focus()
    page.keyboard.press("Escape")
    wait_until(lambda: span(page)[0] < 1, "all of it is back")


def test_without_a_script_links_lead_on(server: Server, browser: Browser, wrong: list[str]) -> None:
    """Closer, later, all."""
    page = opened(browser, wrong, script=False)
    page.goto(server.url + PAGE)
    page.locator("a:text('Closer')").click()
    assert span(page) == pytest.approx((15, 45), abs=0.5)
    page.locator("a:text('Later')").click()
    assert span(page) == pytest.approx((30, 60), abs=0.5)
    page.locator("input[name=at]").fill("01:00:10")
    page.get_by_role("button", name="Show", exact=True).click()
    assert span(page) == pytest.approx((0, 60), abs=0.5)


def test_a_stretch_is_excluded_and_taken_back(
    server: Server, browser: Browser, wrong: list[str]
) -> None:
    """With Shift and the mouse, as text, or what is shown; the estimate and its result follow."""
    page = opened(browser, wrong)
    page.goto(server.url + PAGE)
    left, top, width = frame(page)
    page.keyboard.down("Shift")
    page.mouse.move(left + width / 3, top + 50)
    page.mouse.down()
    page.mouse.move(left + width / 2, top + 50, steps=4)
    page.mouse.up()
    page.keyboard.up("Shift")
    excluded = page.locator("li:has-text('excluded: by choice')")
    page.get_by_text("Take back").wait_for()
    assert "01:00:19" in excluded.first.inner_text() or "01:00:20" in excluded.first.inner_text()
    assert page.locator("rect.excluded").count() == 1
    without = page.locator("p:has-text('effective averages')").inner_text()
    page.locator("input[name=add]").fill("01:00:40/01:00:50")
    page.get_by_role("button", name="Exclude", exact=True).click()
    page.get_by_text("01:00:40 to 01:00:50").first.wait_for()
    assert page.locator("p:has-text('effective averages')").inner_text() != without
    page.get_by_role("link", name="Result without").click()
    page.get_by_text("by choice of the time (--exclude)").wait_for()
    assert page.url.count("exclude=") == 2
    page.get_by_role("link", name="Signal").click()
    page.locator("li:has-text('01:00:40') >> text=Take back").click()
    page.locator("a:text('Closer')").click()
    wait_until(lambda: "01:00:40 to" not in page.content(), "it is taken back")
    page.locator("text=Take back").click()
    wait_until(lambda: page.locator("text=Take back").count() == 0, "none is left")
    page.get_by_role("button", name="Exclude what is shown").click()
    page.get_by_text("Take back").wait_for()


def test_an_exclusion_of_nothing_is_answered(server: Server) -> None:
    """With why, and with those that were right; results without them are refused."""
    visit = Visit(server.url)
    kept = "exclude=2016-07-14T01:00:20/2016-07-14T01:00:30"
    for wrong in ("soon", "01:00:30", "01:00:30/01:00:30", "03:00/04:00"):
        text = visit.get(f"/{PAGE}?{kept}&add={wrong}").text
        assert "within the recording" in text
        assert text.count("Take back") == 1
    far = visit.get(f"/{PAGE}?exclude=1h/2h")
    assert (far.status, "not within the recording" in far.text) == (200, True)
    for wrong in ("x", "9/8", f"{'9' * 400}d/{'9' * 401}d", "1h/2h"):
        assert visit.get(f"/tests/night.h5?exclude={wrong}").status in {400, 409}
    many = "&".join(["exclude=0s/1s"] * 51)
    assert visit.get(f"/tests/night.h5?{many}").status == 400


def test_a_result_without_a_stretch_is_the_same_everywhere(server: Server) -> None:
    """On its page, as JSON, CSV and report; of the whole test nothing has changed."""
    visit = Visit(server.url)
    chosen = "?exclude=20s/30s"
    found = [visit.get(f"/tests/night.h5/result.json{each}").text for each in ("", chosen)]
    whole, part = map(json.loads, found)
    assert part["settings"]["exclude"] == ["20s/30s"]
    assert whole["settings"]["exclude"] == []
    n_excluded = [each["diagnostics"]["excluded_segments"] for each in (whole, part)]
    assert n_excluded[0] < n_excluded[1]
    csv = [visit.get(f"/tests/night.h5/curves.csv{each}").content for each in ("", chosen)]
    assert csv[0] != csv[1]
    assert "by choice of the time" in visit.get(f"/tests/night.h5/report.html{chosen}").text
    page = visit.get(f"/tests/night.h5{chosen}").text
    assert 'href="/tests/night.h5/report.html?exclude=20s%2F30s"' in page
    assert '<input type="hidden" name="exclude" value="20s/30s">' in page
