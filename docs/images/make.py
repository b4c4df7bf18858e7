"""Make the pictures of the README: `python docs/images/make.py` from the root of the repository.

The application is photographed while it looks at a recording simulated from the demo's bench; the
figure is made from the real recording (USGS, public domain) in $HUDDLE_DATA or ../shared/data.
Needs rsvg-convert (Debian: librsvg2-bin) for the first, ObsPy for the second. The page in the
browser is that of a running simulated test.
"""

from __future__ import annotations

import asyncio
import html
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from playwright.sync_api import sync_playwright

from daq.bench.loading import dump
from daq.devices.bench_file import parse
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.importer import import_files
from daq.python_process import python_command
from daq.recording.reader import Recording
from daq.results.result import Result
from daq.results.sources import sources
from estimator.levels.bands import log_edges
from tui.application.app import HuddleApp
from tui.commands.tui_controls import RecordingControls
from tui.report.contents import report_of
from tui.report.paper import write_paper
from tui.simulation.devices import simulated

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
DATA = Path(os.environ.get("HUDDLE_DATA", ROOT.parent / "shared" / "data")) / "usgs-tst-huddle"
BRAILLE = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3))
METHODS = ("three-sensor", "three-channel")
LIMIT = """
[[limits]]
name = "data sheet"
frequency = [1.0, 10.0, 80.0]
psd = [5e-12, 3e-12, 3e-12]
"""


_TEXT = re.compile(
    r'<text class="([^"]*)" x="([\d.]+)" y="([\d.]+)" textLength="[\d.]+" '
    r'clip-path="[^"]*">(.*?)</text>'
)
CELL, LINE = 12.2, 24.4  # of a character in the picture


def placed(run: re.Match[str]) -> str:
    """Put every character of a run of text into its own cell, and draw Braille as dots."""
    name, x, y = run[1], float(run[2]), float(run[3])
    parts = []
    for column, character in enumerate(html.unescape(run[4])):
        left = x + column * CELL
        dots = ord(character) - 0x2800
        if 0 < dots < 256:
            for bit, (across, down) in enumerate(BRAILLE):
                if dots >> bit & 1:
                    cx, cy = left + CELL * (across + 0.5) / 2, y - 18.6 + LINE * (down + 0.5) / 4
                    parts.append(f'<circle class="{name}" cx="{cx:.1f}" cy="{cy:.1f}" r="1.9"/>')
        elif character.strip("\xa0 "):
            text = html.escape(character)
            parts.append(f'<text class="{name}" x="{left:.1f}" y="{y}">{text}</text>')
    return "".join(parts)


async def photograph(recording: Path, *, size: tuple[int, int], keys: tuple[str, ...]) -> str:
    """Return a picture (SVG) of the application on a recording of a bench, after some keys."""
    settings = Settings(segment=2.0, methods=METHODS, band=(2.0, 20.0), target_cov=0.15)
    with Recording.open(recording) as opened:
        bench = opened.bench
    app = HuddleApp(RecordingControls(recording, settings, bench), path=recording)
    async with app.run_test(size=size) as pilot:
        while app.snapshot is None:
            await pilot.pause(0.1)
        await pilot.press(*keys)
        await pilot.pause(0.5)
        return app.export_screenshot(title="huddle")


def draw(picture: str, out: Path) -> None:
    """Write a picture of the application as PNG."""
    picture = _TEXT.sub(placed, picture.replace("Fira Code", "DejaVu Sans Mono"))
    with tempfile.NamedTemporaryFile("w", suffix=".svg") as file:
        file.write(picture)
        file.flush()
        subprocess.run(["rsvg-convert", file.name, "-o", str(out)], check=True)
    with Image.open(out) as drawn:  # few colours: a third of the size
        few = drawn.convert("RGB").quantize(128, Image.Quantize.MAXCOVERAGE)
        few.save(out, optimize=True)


def application(folder: Path) -> None:
    """Draw the views of the application on the demo's bench, with a limit."""
    bench, recording = folder / "bench.toml", folder / "lab.h5"
    demo = (ROOT / "tui" / "resources" / "demo.toml").read_text(encoding="utf-8")
    bench.write_text(demo + LIMIT, encoding="utf-8")
    command = python_command("tui", "simulate", str(bench), "--duration", "300s")
    subprocess.run([*command, "--out", str(recording)], check=True)
    views = {
        "application": ("down",),
        "application-cursor": ("down", "full_stop", "u", "u", "u", "t"),
        "application-result": ("3",),
    }
    for name, keys in views.items():
        picture = asyncio.run(photograph(recording, size=(100, 30), keys=keys))
        draw(picture, HERE / f"{name}.png")


def real_recording(folder: Path) -> None:
    """Draw the noise of the sensors of the real recording."""
    recording = folder / "tst.h5"
    import_files(
        sorted(DATA.glob("*.mseed")),
        recording,
        response_for=[("*", DATA / "T-compact_Q330HR_BH_40")],
    )
    settings = Settings(segment=409.6, detrend="none", methods=METHODS, unit="m/s²")
    snapshot = estimate([recording], settings)
    frequency = snapshot.frequency
    edges = log_edges(frequency, 220)
    edges = edges[frequency[edges] <= 16.0]
    centre = np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1])
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for axis, name, title in zip(
        axes, ("BH0", "BH1", "BH2"), ("vertical", "horizontal", "horizontal"), strict=True
    ):
        column = [label.channel for label in snapshot.channels].index(name)
        data = np.add.reduceat(snapshot.data_psd[: edges[-1], column], edges[:-1])
        axis.plot(centre, 10 * np.log10(data / np.diff(edges)), color="0.6", label="data")
        for method, colour in zip(METHODS, ("#0a7ea4", "#e07b39"), strict=True):
            noise = snapshot.results[method]
            mean = (
                Result(snapshot, settings).spectrum(noise.method).levels(edges).of_channel(column)
            )
            with np.errstate(invalid="ignore", divide="ignore"):
                level, low, high = (10 * np.log10(v) for v in (mean.mean, mean.low, mean.high))
            axis.fill_between(centre, low, high, color=colour, alpha=0.25, lw=0)
            axis.plot(centre, level, color=colour, lw=1.2, label=method)
        axis.set(xscale="log", xlabel="frequency in Hz", title=f"{name}, {title}")
        axis.set_xlim(0.005, 16)
        axis.grid(which="both", color="0.92")
    axes[0].set(ylabel="PSD in dB re 1 (m/s²)²/Hz", ylim=(-195, -120))
    axes[1].legend(loc="upper right")
    figure.savefig(HERE / "usgs.png", dpi=110)


def report(folder: Path) -> None:
    """Draw the first two pages of a report on the demo's bench, with a limit, side by side."""
    bench, recording = folder / "bench.toml", folder / "report.h5"
    demo = (ROOT / "tui" / "resources" / "demo.toml").read_text(encoding="utf-8")
    bench.write_text(demo + LIMIT, encoding="utf-8")
    command = python_command("tui", "simulate", str(bench), "--duration", "20min")
    subprocess.run([*command, "--out", str(recording)], check=True)
    settings = Settings(segment=2.0, band=(2.0, 20.0))
    contents = report_of(
        Result(
            estimate([recording], settings),
            settings,
            sources([recording])[0].bench,
            examined=tuple(sources([recording])),
        )
    )
    paper = folder / "report.pdf"
    with paper.open("wb") as file:
        write_paper(contents, file)
    # of poppler-utils
    subprocess.run(["pdftoppm", "-l", "2", "-r", "80", "-png", paper, folder / "page"], check=True)
    sheets = [Image.open(path).convert("RGB") for path in sorted(folder.glob("page*.png"))]
    width, height = sheets[0].size
    picture = Image.new("RGB", (2 * width + 8, height), "#c8cdd2")
    for number, sheet in enumerate(sheets):
        picture.paste(sheet, (number * (width + 8), 0))
    picture.quantize(96, Image.Quantize.MAXCOVERAGE).save(HERE / "report.png", optimize=True)


def pages(folder: Path) -> None:
    """Photograph the page of a running test on the demo's bench, with a limit, in Chromium.

    Takes four minutes: a simulated test goes on meanwhile. Needs the extra `dev`, and Chromium.
    """
    bench, told = folder / "bench.toml", folder / "told"
    demo = (ROOT / "tui" / "resources" / "demo.toml").read_text(encoding="utf-8")
    with simulated(parse(demo + LIMIT), speed=1.0) as reachable:
        bench.write_text(dump(reachable), encoding="utf-8")
        run = subprocess.Popen(python_command("tui", "run", str(bench)), stdout=subprocess.DEVNULL)
        with told.open("wb") as out:
            command = python_command("tui", "web", str(bench), "--port", "0")
            served = subprocess.Popen(
                command, stdout=out, env=os.environ | {"PYTHONUNBUFFERED": "1"}
            )
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=os.environ.get("HUDDLE_CHROMIUM") or shutil.which("chromium"),
                args=["--no-sandbox"],
            )
            page = browser.new_page(viewport={"width": 1100, "height": 940})
            while not (address := told.read_text(encoding="utf-8").split()):
                time.sleep(0.2)
            page.goto(address[-1])
            page.wait_for_selector("#state:has-text('3:20 long')", timeout=600_000)
            page.wait_for_selector("#chart[data-drawn]")
            page.hover(".u-over", position={"x": 420, "y": 150})
            page.screenshot(path=folder / "web.png")
            browser.close()
        for process in (served, run):
            process.send_signal(signal.SIGINT)
            process.wait()
    with Image.open(folder / "web.png") as drawn:
        few = drawn.convert("RGB").quantize(128, Image.Quantize.MAXCOVERAGE)
        few.save(HERE / "web.png", optimize=True)


def main() -> None:
    """Make all pictures."""
    with tempfile.TemporaryDirectory() as folder:
        pages(Path(folder))
        application(Path(folder))
        report(Path(folder))
        real_recording(Path(folder))


if __name__ == "__main__":
    main()
