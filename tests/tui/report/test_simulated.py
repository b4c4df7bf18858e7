"""A simulated test says so everywhere: recording, JSON, page and console."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import h5py
import pytest
from typer.testing import CliRunner

from daq.recording.reader import Recording
from tests.tui.report.written_report import Words
from tui.commands.main import app

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.usefixtures("empty_figures")
def test_a_simulated_recording_says_so_wherever_it_is_shown(tmp_path: Path) -> None:
    recording, out, page = tmp_path / "s.h5", tmp_path / "s.json", tmp_path / "s.html"
    run = CliRunner()
    simulate = ["simulate", "fig4", "--duration", "40s", "--out", str(recording)]
    assert run.invoke(app, simulate).exit_code == 0
    shown = run.invoke(app, ["estimate", str(recording), "--segment", "2s", "--json", str(out)])
    assert shown.exit_code == 0, shown.output
    assert "simulated sensors" in shown.output
    assert json.loads(out.read_text(encoding="utf-8"))["recordings"][0]["simulated"] is True
    written = run.invoke(app, ["report", str(recording), "--segment", "2s", "--out", str(page)])
    assert written.exit_code == 0, written.output
    text = Words(page.read_text(encoding="utf-8")).text
    assert "SIMULATED SENSORS" in text


def test_a_measured_recording_is_not_simulated(tmp_path: Path) -> None:
    from tests.tui.night_recording import record  # noqa: PLC0415 - the other test needs none

    path = record(tmp_path / "night.h5")
    with Recording.open(path) as recording:
        assert not recording.simulated
    with h5py.File(path) as file:
        assert "simulated" not in file.attrs
