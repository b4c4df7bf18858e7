"""Every benchmark runs in its smallest form, and a failed one does not keep the others from it."""

from __future__ import annotations

import importlib
import math
import pkgutil
from pathlib import Path

import pytest

import benchmarks
from benchmarks.__main__ import main, table
from benchmarks.row import Row

STUDIES = {"application", "command_start", "estimate_file", "following", "reach", "recorder"}
"""Benchmarks that run whole processes, for most of a minute."""
LONG = {"gaps", "likelihood", "resampler", "signal", "spectra"}
"""Those that take half a second and more."""
NAMES = sorted(
    {module.name for module in pkgutil.iter_modules(benchmarks.__path__) if not module.ispkg}
)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=[pytest.mark.long] * (name in LONG) + [pytest.mark.study] * (name in STUDIES),
        )
        for name in NAMES
        if name not in {"__main__", "row"}
    ],
)
def test_each_runs_in_its_smallest_form(name: str) -> None:
    rows: list[Row] = importlib.import_module(f"benchmarks.{name}").run(smallest=True)
    assert rows
    assert all(math.isfinite(row.measured) for row in rows)
    assert all(row.what in table(rows) for row in rows)


def test_one_that_fails_does_not_keep_others_from_running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "fails.py").write_text("def run():\n    raise NameError('packets')\n")
    (tmp_path / "hangs.py").write_text("import threading\nrun = threading.Event().wait\n")
    runs = "from benchmarks.row import Row\ndef run():\n    return [Row('speed', 2.0, 'x')]\n"
    (tmp_path / "runs.py").write_text(runs)
    monkeypatch.setattr(benchmarks, "__path__", [*benchmarks.__path__, str(tmp_path)])
    assert main(["runs"]) == 0
    monkeypatch.setattr("benchmarks.__main__.LONGEST", 2.0)
    assert main(["fails", "hangs", "runs"]) == 1
    shown = capfd.readouterr().out
    assert "NameError: packets" in shown
    assert "hangs: FAILED\nnot at its end after 2 s" in shown
    assert "speed" in shown
