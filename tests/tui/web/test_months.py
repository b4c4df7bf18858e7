"""Sensors over the runs of a service, and the archive that the bench file names."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import pytest

from daq.devices.bench_file import load
from tests.command import huddle
from tests.tui.web.conftest import SIZES, opened
from tests.tui.web.pages import Server, bench_file, serving
from tui.service.records.run_state import RecordedNoise, Run, RunState
from tui.service.records.store import RunStore

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from playwright.sync_api import Browser

    from tests.tui.web.conftest import Barriers

FIRST = datetime(2026, 1, 1, tzinfo=UTC)
NAME = "A<img src=x>"


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    """Serve a bench with an archive and forty runs, after twenty of which a sensor is worse."""
    bench = bench_file(folder, '[web]\narchive = "store"\n')
    recording = folder / "recordings" / "night.h5"
    huddle("archive", recording, "--store", str(folder / "store"))
    store = RunStore(folder / "recordings")
    for day in range(40):
        psd = 1e-9 * (1.0 if day < 20 else 2.0)
        noise = RecordedNoise.of(
            NAME, "M-1", "SN-7", "X", "m/s²", "three-sensor", 1.0, 10.0, psd, 0.95 * psd, 1.05 * psd
        )
        run = Run(
            load(bench).name,
            "night",
            FIRST + timedelta(days=day),
            3600.0,
            state=RunState.DONE,
            noise=(noise,),
        )
        store.save(run)
    with serving(bench) as found:
        yield found


def test_a_sensor_that_changed_is_named(server: Server) -> None:
    text = server.visit().get("/sensors").text
    assert '<th scope="row">SN-7</th>' in text
    assert "A&lt;img src=x&gt;" in text
    assert NAME not in text
    assert re.search(r"1 to 10 Hz: \+3\.01 ±0\.\d\d dB since 2026-01-21 00:00", text)
    picture = server.visit().get("/sensors.png")
    assert picture.content.startswith(b"\x89PNG")


def test_the_archive_has_tables_and_pictures(server: Server) -> None:
    visit = server.visit()
    text = visit.get("/archive").text
    assert "Noise by day, 2–20 Hz, maximum-likelihood, 1 day from 2016-07-14" in text
    assert "Drift and change are not decided: 1 day, and 8 with an estimate are needed." in text
    for name in ("days", "density"):
        assert visit.get(f"/archive/{name}.png").content.startswith(b"\x89PNG")


@pytest.mark.parametrize("size", SIZES)
def test_pages_of_months_fit_and_have_no_barrier(
    server: Server, browser: Browser, wrong: list[str], size: str, barriers: Barriers
) -> None:
    page = opened(browser, wrong, size)
    for path in ("sensors", "archive"):
        page.goto(server.url + path)
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        assert all(page.evaluate("[...document.images].map((each) => each.naturalWidth)"))
        assert barriers(page) == []
