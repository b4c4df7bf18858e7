"""The examples and the tutorial of the documentation run, and say what they say there."""

from __future__ import annotations

import doctest
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tui.commands.main import app

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "examples"


def run(script: str, folder: Path) -> str:
    """Run an example in a folder of its own; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-P", str(ROOT / "examples" / script)],
        cwd=folder,
        env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


@pytest.mark.long
def test_noise_from_arrays(tmp_path: Path) -> None:
    printed = run("noise_from_arrays.py", tmp_path)
    rows = [line.split() for line in printed.splitlines() if re.match("[ABC] +[XYZ]", line)][:9]
    levels = [float(row[3].replace("−", "-")) for row in rows]  # of the three-sensor estimate
    assert levels == pytest.approx([-130.0] * 9, abs=0.15)
    assert "The model test passes in all bands" in printed
    assert (tmp_path / "noise.svg").stat().st_size > 10_000


def test_added_noise_is_found_in_its_channel_alone(tmp_path: Path) -> None:
    printed = run("proof_by_added_noise.py", tmp_path).splitlines()
    levels = {
        name: [float(word) for word in values.strip(" []").split()]
        for name, _, values in (line.partition(":") for line in printed)
    }
    assert levels["three-sensor"] == pytest.approx([-130.0] * 3, abs=0.3)
    assert levels["rotated first"] != pytest.approx([-130.0] * 3, abs=3.0, nan_ok=True)
    risen = levels["7.0 dB more noise in A.X"]
    assert risen[0] - levels["three-sensor"][0] == pytest.approx(7.0, abs=0.3)
    assert risen[1:] == pytest.approx(levels["three-sensor"][1:], abs=0.1)


@pytest.mark.long
def test_noise_added_to_a_real_recording_is_found(
    usgs_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the method page says; where the recording is absent, the script says so and ends."""
    pytest.importorskip("obspy")
    monkeypatch.setenv("HUDDLE_DATA", str(usgs_recording.parent))
    printed = run("noise_added_to_real_data.py", tmp_path).splitlines()
    errors = [[float(word) for word in line.split()[-2:]] for line in printed[1:]]
    assert len(errors) == 5
    assert np.abs(errors).max() < 0.15
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [\d.]+–\d+ \|(.*)\|$", page, re.MULTILINE)
    quoted = [[float(word) for word in row.replace("−", "-").split("|")] for row in rows]
    assert np.allclose([[*map(float, line.split()[1:])] for line in printed[1:]], quoted, atol=0.03)
    monkeypatch.setenv("HUDDLE_DATA", str(tmp_path))
    assert run("noise_added_to_real_data.py", tmp_path).startswith("skipped")


@pytest.mark.long
def test_miniseed_to_noise(tmp_path: Path) -> None:
    pytest.importorskip("obspy")
    printed = run("miniseed_to_noise.py", tmp_path)
    assert "XX.A.HNX: 1e+11 counts per m/s² (response, simulated" in printed
    share = re.search(r"(\d+)% of the intervals from 1 to 20 Hz contain the true noise", printed)
    assert share is not None
    assert 93 <= int(share[1]) <= 97
    assert (tmp_path / "noise.csv").stat().st_size > 10_000


def command(arguments: list[str], *, check: bool) -> None:
    """Run a command of an example in this process: six processes would import everything anew."""
    assert arguments[:4] == [sys.executable, "-P", "-m", "huddle"]
    assert check
    done = CliRunner().invoke(app, arguments[4:])
    assert (done.exit_code, done.stderr) == (0, "")
    print(done.stdout, end="")


@pytest.mark.long
def test_from_a_bench_to_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "run", command)
    runpy.run_path(str(ROOT / "examples" / "bench_to_report.py"))
    printed = capsys.readouterr().out
    assert printed.count("PASS: all 9 channels") == 2
    assert "('A', 'B', 'C') (48000, 3) ('X', 'Y', 'Z')" in printed
    assert "PASS" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_tutorial_says_what_python_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 10
    examples = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, "tutorial", None, 0)
    found = doctest.DocTestRunner().run(examples)
    assert found.failed == 0, capsys.readouterr().out


@pytest.mark.parametrize("script", sorted(path.name for path in (ROOT / "examples").glob("*.py")))
def test_every_script_has_its_page(script: str) -> None:
    pages = [path.read_text(encoding="utf-8") for path in PAGES.glob("*.md")]
    assert sum(f"{{example}} {script}" in page for page in pages) == 1
