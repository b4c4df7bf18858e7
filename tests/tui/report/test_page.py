"""The report as a page: it needs no other file, runs nothing, and can be read by everybody."""

from __future__ import annotations

import itertools
import re
import shutil
from html.parser import HTMLParser
from typing import TYPE_CHECKING

import pytest

from tests.tui.night_recording import HOSTILE
from tests.tui.report.written_report import Reported, Words
from tui.page.table import Table

if TYPE_CHECKING:
    from pathlib import Path


def test_the_page_needs_nothing_else_and_runs_nothing(reported: Reported) -> None:
    words = Words(reported.page)
    assert not words.tags & {"script", "link", "img", "iframe", "object", "embed", "base", "form"}
    assert not {name for name in words.attributes if name.startswith("on")}
    assert not words.attributes & {"src", "srcset", "href", "action"}
    assert set(re.findall(r"https?://[^\s\"<]+", reported.page)) <= {
        "http://www.w3.org/1999/xlink", "http://www.w3.org/2000/svg",
    }  # fmt: skip
    references = set(re.findall(r'xlink:href="([^"]*)"|url\(([^)]*)\)', reported.page))
    assert all((one or other).startswith("#") for one, other in references)


class Landmarks(HTMLParser):
    """What a screen reader tells apart in a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.path: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None], tuple[str, ...]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag, and those that it is in."""
        self.tags.append((tag, dict(attrs), tuple(self.path)))
        if tag not in {"meta", "br"}:
            self.path.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag without contents."""
        self.tags.append((tag, dict(attrs), tuple(self.path)))

    def handle_endtag(self, tag: str) -> None:
        """Leave a tag."""
        assert self.path.pop() == tag

    def having(self, tag: str) -> list[tuple[dict[str, str | None], tuple[str, ...]]]:
        """Return attributes and place of each tag of a name."""
        return [(attributes, path) for name, attributes, path in self.tags if name == tag]


def test_a_screen_reader_finds_its_way(reported: Reported) -> None:
    page = Landmarks(reported.page)
    assert page.path == []
    for landmark, holds in (("header", "h1"), ("main", "section")):
        assert len(page.having(landmark)) == 1
        assert all(landmark in path for _, path in page.having(holds))
    titles = {attributes["id"] for attributes, _ in page.having("h2")}
    sections = [attributes["aria-labelledby"] for attributes, _ in page.having("section")]
    assert len(sections) == len(reported.report.sections)
    assert set(sections) == titles
    ids = [attributes["id"] for _, attributes, _ in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    heads = page.having("th")
    assert {attributes["scope"] for attributes, path in heads if "thead" in path} == {"col"}
    rows = [attributes["scope"] for attributes, path in heads if "tbody" in path]
    n_rows = sum(
        len(part.rows)
        for s in reported.report.sections
        for part in s.parts
        if isinstance(part, Table)
    )
    assert rows == ["row"] * n_rows
    pictures = [attributes for attributes, _ in page.having("svg")]
    assert all(each["role"] == "img" and each["aria-label"] for each in pictures)
    scrolling = [a for a, _ in page.having("div") if a.get("class") == "wide"]
    assert len(scrolling) == len(pictures) + len(page.having("table"))
    assert all(each["tabindex"] == "0" and each["aria-label"] for each in scrolling)


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours by WCAG 2.2."""

    def luminance(colour: str) -> float:
        parts = [int(colour[n : n + 2], 16) / 255 for n in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_colours_have_contrast_in_light_and_in_dark(reported: Reported) -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    light, dark = (
        dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", block))
        for block in re.findall(r":root \{(.*?)\}", reported.page, re.DOTALL)
    )
    assert set(light) == set(dark)
    for colours in (light, dark):
        for name in ("ink", "quiet", "good", "bad", "doubtful"):  # letters
            for ground in ("paper", "raised"):
                assert contrast(colours[name], colours[ground]) >= 4.5, name
        for name in colours.keys() - {"paper", "raised", "rule", "grid", "nothing"}:  # lines
            assert contrast(colours[name], colours["paper"]) >= 3, name


def test_foreign_names_are_text_and_nothing_else(reported: Reported) -> None:
    assert HOSTILE in Words(reported.page).text
    assert "<script" not in reported.page.lower()
    assert "&lt;script&gt;" in reported.page


def test_axe_finds_nothing_in_the_page(reported: Reported, tmp_path: Path) -> None:
    """On a wide screen and on a phone; and it finds what is wrong with a page that lacks it."""
    playwright = pytest.importorskip("playwright.sync_api")
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed (Debian: chromium)")
    pages = {"sound": reported.page, "without": reported.page.replace(' lang="en"', "")}
    found: dict[tuple[str, int], list[str]] = {}
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for (name, content), width in itertools.product(pages.items(), (1280, 375)):
            file = tmp_path / f"{name}.html"
            file.write_text(content, encoding="utf-8")
            page = browser.new_page(viewport={"width": width, "height": 900})
            page.goto(file.as_uri())
            violations = axe.run(page).response["violations"]
            found[name, width] = [each["id"] for each in violations]
        browser.close()
    for width in (1280, 375):
        assert found["sound", width] == []
        assert found["without", width] == ["html-has-lang"]
