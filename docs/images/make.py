"""Make the pictures of the README: `python -m docs.images.make` from the root of the repository.

The application is photographed while it looks at a recording simulated from the demo's bench; needs
rsvg-convert (Debian: librsvg2-bin). The page in the browser is that of a running simulated test.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from daq.bench.loading import dump
from daq.devices.bench_file import parse
from daq.python_process import python_command
from docs.images.terminal import photograph
from tui.simulation.devices import simulated

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LIMIT = """
[[limits]]
name = "data sheet"
frequency = [1.0, 10.0, 80.0]
psd = [5e-12, 3e-12, 3e-12]
"""


def draw(picture: str, out: Path) -> None:
    """Write a picture of the application as PNG."""
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
        "application-result": ("3",),
    }
    for name, keys in views.items():
        picture = asyncio.run(photograph(recording, size=(100, 30), keys=keys))
        draw(picture, HERE / f"{name}.png")


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


if __name__ == "__main__":
    main()
