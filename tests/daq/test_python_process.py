"""The command that installs an extra fits the way in which this copy was installed."""

from __future__ import annotations

import shlex
import sys
from importlib import metadata
from pathlib import Path

import pytest

from daq.python_process import install_command

METADATA = """Metadata-Version: 2.4
Name: huddle-bench
Version: 1
Requires-Dist: numpy>=2.2
Requires-Dist: fpdf2>=2.8; extra == 'web'
Requires-Dist: starlette>=1.0.1; extra == 'web'
Requires-Dist: pymseed>=1.0; extra == 'seedlink'
"""
PIP = [sys.executable, "-m", "pip", "install"]


@pytest.mark.parametrize(
    ("installer", "folder", "start"),
    [
        ("pip\n", ".venv", PIP),
        ("uv", ".venv", ["uv", "pip", "install", "--python", sys.executable]),
        ("pip", "pipx/venvs/huddle-bench", ["pipx", "inject", "huddle-bench"]),
    ],
)
def test_an_extra_is_installed_as_huddle_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installer: str, folder: str, start: list[str]
) -> None:
    prefix = tmp_path / folder
    info = prefix / "huddle_bench-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(METADATA, encoding="utf-8")
    (info / "INSTALLER").write_text(installer, encoding="utf-8")
    if start[0] == "pipx":
        (prefix / "pipx_metadata.json").write_text("{}", encoding="utf-8")
    monkeypatch.setattr(sys, "prefix", str(prefix))
    monkeypatch.setattr(metadata, "distribution", lambda _: metadata.PathDistribution(info))
    assert shlex.split(install_command("web")) == [*start, "fpdf2>=2.8", "starlette>=1.0.1"]


def test_a_tree_that_is_not_installed_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", absent)
    command = shlex.split(install_command("web"))
    assert command[:4] == PIP
    assert command[4].endswith("[web]")
