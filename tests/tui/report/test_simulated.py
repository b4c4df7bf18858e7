"""A simulated test says so everywhere: recording, JSON, page, screens, exports, imports."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import huddle
from daq.archive.index import ROLLUP
from daq.caveats import NO_CAVEATS, Caveat, Caveats
from daq.recording.reader import Recording
from daq.results.result import Result
from tests import command
from tests.tui.example_snapshot import SETTINGS, demo_bench, made_now, made_snapshot
from tests.tui.report.written_report import Words
from tui.application.state import VIEWS, State
from tui.application.view import status_line
from tui.report.figures.archive import days_figure
from tui.report.figures.curves import noise_plots

SIMULATED = Caveats([Caveat.SIMULATED])


@pytest.mark.parametrize("caveats", [NO_CAVEATS, SIMULATED])
def test_caveats_stay_what_they_are_in_files_and_words(caveats: Caveats) -> None:
    assert Caveats.of(json.loads(json.dumps(caveats.keys))) == caveats
    assert Caveats.joined([NO_CAVEATS, caveats, caveats]) == caveats
    assert all(each.words.noun in caveats.nouns("9 segments") for each in caveats)
    assert caveats.after("pier") == ", ".join(["pier", *caveats])
    assert caveats.after() == ", ".join(caveats)


@pytest.mark.usefixtures("empty_figures")
def test_a_simulated_recording_says_so_wherever_it_is_shown(tmp_path: Path) -> None:
    recording, out, page = tmp_path / "s.h5", tmp_path / "s.json", tmp_path / "s.html"
    command.huddle("simulate", "fig4", "--duration", "20s", "--out", recording)
    shown = command.huddle("estimate", recording, "--segment", "2s", "--json", out)
    assert "simulated sensors" in shown.output
    assert json.loads(out.read_text(encoding="utf-8"))["recordings"][0]["simulated"] is True
    command.huddle("report", recording, "--segment", "2s", "--out", page)
    text = Words(page.read_text(encoding="utf-8")).text
    assert "SIMULATED SENSORS" in text


def test_exports_and_imports_of_simulated_recordings_keep_the_mark(tmp_path: Path) -> None:
    pytest.importorskip("obspy")
    recording, out = tmp_path / "s.h5", tmp_path / "s.mseed"
    command.huddle("simulate", "fig4", "--duration", "20s", "--out", recording)
    command.huddle("export", recording, "--format", "npz", "--segment", "2s")
    with np.load(recording.with_suffix(".npz")) as file:
        assert str(file["simulated"]) == "true"
    command.huddle("export", recording, "--format", "mseed", "--out", out)
    back = tmp_path / "back.h5"
    command.huddle("import", out, "--out", back)
    with Recording.open(back) as imported:
        assert imported.caveats
    assert "simulated sensors" in repr(huddle.open(back))
    assert "simulated sensors" in repr(huddle.read(out))
    out.with_suffix(".xml").unlink()
    assert "simulated" not in repr(huddle.read(out))  # miniSEED alone cannot say so


def test_an_archive_of_simulated_recordings_says_so(tmp_path: Path) -> None:
    recording, out = tmp_path / "s.h5", tmp_path / "a.json"
    command.huddle("simulate", "fig4", "--duration", "40s", "--out", recording)
    options = ["--segment", "2s", "--json", str(out)]
    for _ in range(2):  # from the recording, and from the index alone
        shown = command.huddle("archive", recording, *options)
        assert "simulated sensors" in shown.output
        pooled = json.loads(out.read_text(encoding="utf-8"))["pooled"]
        assert "sensors-simulated" in [each["kind"] for each in pooled["facts"]]
    store = tmp_path / "huddle-archive"
    assert days_figure(huddle.archive(store=store)).get_suptitle() == "Simulated sensors"
    files = store.rglob("*.h5")
    (kept,) = (each for each in files if not each.name.startswith(ROLLUP))
    with h5py.File(kept, "r+") as file:
        del file.attrs["simulated"]
    earlier = command.huddle("archive", "--store", store)
    assert "simulated" not in earlier.output  # versions before did not keep it


def test_estimates_and_figures_of_simulated_samples_say_so() -> None:
    simulation = huddle.simulate("fig4", duration="20s")
    result = huddle.self_noise(simulation, fs=simulation.fs, sample_unit="m/s²", segment="2s")
    assert result.snapshot.caveats
    assert "simulated" in repr(result)
    plots = noise_plots(result.result)
    assert plots[0].title == "Simulated sensors"


def test_the_status_line_of_every_view_says_simulated() -> None:
    snapshot = made_snapshot()
    for view in VIEWS:
        for caveats in (SIMULATED, NO_CAVEATS):
            state = State("pier", now=replace(made_now(), caveats=caveats))
            shown = status_line(state, view, width=100).plain
            assert ("SIMULATED" in shown) == bool(caveats)
        state = State("pier", result=Result(replace(snapshot, caveats=SIMULATED), SETTINGS))
        assert "SIMULATED" in status_line(state, view, width=80).plain
    bench = demo_bench().model_copy(update={"simulation": {}})
    assert not State("pier", bench=bench).caveats
    simulated_bench = bench.model_copy(update={"simulation": {"clock": "clock.json"}})
    assert State("pier", bench=simulated_bench).caveats
