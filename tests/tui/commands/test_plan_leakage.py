"""A plan says what unequal responses of the bench file would leak."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tui.commands.main import app
from tui.notebook.planning import plan_bench

TEMPLATE = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
OMEGA = 2 * 3.141592653589793 * 30.0
LOW_PASS = f"response = {{poles = [{-OMEGA}], normalization = {OMEGA}}}\n"
"""One pole at 30 Hz: |H'|² = 1 / (30 Hz)² towards 0 Hz."""


def test_a_plan_says_what_leaks_and_what_helps(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    text = re.sub(r"^sensitivity = [^\n]*\n", rf"\g<0>{LOW_PASS}", TEMPLATE, flags=re.MULTILINE)
    path.write_text(text, encoding="utf-8")
    found = plan_bench(path, snr=1e5, cov=0.05).leakage
    assert found is not None
    assert found.channel.startswith("A.")
    # |H' / H|² SNR / (3 T²), at the lowest frequencies, with segments of 10 s
    assert found.share == pytest.approx(1e5 / 30**2 / 300, rel=0.02)
    assert found.segment == pytest.approx(10 * (found.share / 0.01) ** 0.5)
    shown = CliRunner().invoke(app, ["plan", str(path), "--snr", "1e5"])
    assert "Responses in the bench file differ" in shown.stdout
    assert plan_bench(path, snr=10.0, cov=0.05).leakage is None


def test_equal_responses_leak_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(TEMPLATE, encoding="utf-8")
    assert plan_bench(path, snr=1e9, cov=0.05).leakage is None
