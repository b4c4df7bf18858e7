"""Report files: where they go, when they are preliminary, and none that is incomplete."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daq.bench.masks.mask_file import masks_named
from daq.devices.bench_file import load
from tests.command import huddle, words_of
from tests.full_disk import files_limited_to
from tests.tui.night_recording import record
from tests.tui.report.written_report import ROOT, Reported, Words
from tui.commands.main import app
from tui.commands.tui_controls import BenchControls
from tui.report.writing import ReportError, write


@pytest.mark.long
def test_the_demo_s_reports_outlive_its_folder_and_have_its_noise_models(
    reported: Reported, tmp_path: Path
) -> None:
    settings, path = reported.settings, ROOT / "tui" / "resources" / "demo.toml"
    models = masks_named("nhnm")
    controls = BenchControls(path, load(path), settings, reports=tmp_path, models=models)
    out = controls.report(reported.recording, reported.result)
    assert out == tmp_path / "night.html"
    page = out.read_text(encoding="utf-8")
    assert "NHNM" in page
    assert "NHNM" not in reported.page


@pytest.mark.usefixtures("empty_figures")
def test_a_test_that_is_still_running_is_preliminary(tmp_path: Path) -> None:
    recording, out = tmp_path / "live.h5", tmp_path / "live.html"

    def report() -> None:
        result = CliRunner().invoke(app, ["report", str(recording)])
        assert result.exit_code == 4, result.output  # a channel is dead

    record(recording, before_end=report)
    text = Words(out.read_text(encoding="utf-8")).text
    assert "Still running, preliminary. NOT DECIDED" in text
    assert "none: the file is still being written" in text


@pytest.mark.usefixtures("empty_figures")
def test_a_report_is_whole_or_not_there(reported: Reported, tmp_path: Path) -> None:
    out = tmp_path / "old.html"
    out.write_text("the old one", encoding="utf-8")
    message = r"old.html: cannot be written \(File too"
    with files_limited_to(10_000), pytest.raises(ReportError, match=message):
        write(reported.result, out, taken="replace")
    assert out.read_text(encoding="utf-8") == "the old one"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    ("out", "said"), [("report.doc", r"\.html, \.pdf or \.xml"), ("none/report.pdf", "no folder")]
)
def test_a_wrong_name_is_refused_before_anything_is_done(
    reported: Reported, out: str, said: str, tmp_path: Path
) -> None:
    arguments = ["report", str(reported.recording), "--out", str(tmp_path / out)]
    result = huddle(*arguments, terminal_width=300, code=2)
    assert re.search(said, result.stderr)


@pytest.mark.usefixtures("empty_figures")
def test_a_draft_replaces_no_other_one_unless_forced(reported: Reported, tmp_path: Path) -> None:
    """Settings are not tried until they pass, without a trace."""
    out = tmp_path / "night.html"
    arguments = ["report", str(reported.recording), "--out", str(out), "--segment", "1s"]
    huddle(*arguments, code=4)
    first = out.read_bytes()
    huddle(*arguments, code=4)  # the same once more changes nothing
    assert "exists with other content" in words_of(*arguments[:-1], "2s", code=3)
    assert out.read_bytes() == first
    huddle(*arguments[:-1], "2s", "--force", code=4)
    page = Words(out.read_text(encoding="utf-8")).text
    assert "segment 1 s → 2 s" in page
    _, beside = write(reported.result, out, taken="beside")
    assert beside == tmp_path / "night-2.html"


def test_a_draft_is_marked_and_says_what_is_missing(reported: Reported) -> None:
    report = reported.report
    assert report.watermark == "DRAFT"
    assert report.number == ""
    text = Words(reported.page).text
    assert "DRAFT: not a certificate" in text
    assert "Sensor B recorded nothing for" in text
    assert "name and address of the laboratory ([laboratory] name, address)" in text
