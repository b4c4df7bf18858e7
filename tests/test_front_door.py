"""The front door: its examples, what it loads, its types, and ``python -m huddle``."""

from __future__ import annotations

import ast
import doctest
import importlib
import importlib.metadata
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import huddle
from daq.bench.estimate_settings import table_keys
from daq.python_process import python_command
from tests.command import modules_after
from tui.notebook import estimates, planning, recording, simulation, verbs
from tui.notebook.options import EstimateOptions

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("module", [huddle, estimates, planning, recording, simulation, verbs])
def test_the_examples_in_the_documentation_run(
    module: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(module)
    assert found.attempted >= 3
    assert found.failed == 0


def test_the_front_door_loads_nothing_until_it_is_used() -> None:
    loaded = modules_after("import huddle") - modules_after(
        "import importlib.util, pathlib, typing"
    )
    assert loaded - {"__future__"} == {"huddle"}


def test_only_what_is_asked_for_is_loaded() -> None:
    call = "import huddle; huddle.self_noise({k: [float(ord(k)) * n % 97 for n in range(4000)]"
    loaded = modules_after(f"{call} for k in 'ABC'}}, fs=100, segment=1)")
    assert "numpy" in loaded
    assert not loaded & {"xarray", "pandas", "matplotlib", "textual", "obspy", "asyncio", "serial"}


def imports_of(path: Path) -> dict[str, str]:
    """Return the module of each name of ours that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {
        name.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for name in node.names
        if node.module.partition(".")[0] in {"daq", "estimator", "sim_devices", "tui"}
    }


def test_names_types_and_modules_of_the_front_door_agree() -> None:
    imported = imports_of(ROOT / "huddle.py")
    assert imported.pop("main") == "tui.commands.main"
    assert sorted(imported) == sorted(huddle.__all__) == sorted(set(dir(huddle)) & set(imported))
    assert imports_of(ROOT / "tui" / "resources" / "huddle.pyi") == imported
    for name, module in imported.items():
        assert getattr(huddle, name) is getattr(importlib.import_module(module), name)


def test_every_option_is_typed_and_explained() -> None:
    typed = set(EstimateOptions.__annotations__)
    assert typed == set(table_keys())
    text = str(inspect.getdoc(huddle.estimate))  # Python 3.13 keeps it without its indent
    explained = re.findall(r"^(\w+) : ", text[text.index("Other Parameters") :], re.MULTILINE)
    assert typed <= set(explained)


def test_public_names_are_there() -> None:
    for name in huddle.__all__:
        assert getattr(huddle, name).__doc__
    assert huddle.__version__ == importlib.metadata.version("huddle-bench")
    with pytest.raises(AttributeError, match="no attribute 'selfnoise'"):
        huddle.selfnoise  # type: ignore[attr-defined]  # noqa: B018 - what is tested


def test_the_module_is_the_command() -> None:
    of_module, of_command = (
        subprocess.run([*start, "--version"], capture_output=True, text=True, check=True).stdout
        for start in (python_command("huddle"), [Path(sys.executable).with_name("huddle")])
    )
    assert of_module == of_command
    assert of_module.startswith("huddle ")


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """Make a folder with modules of the user's own; each ends the process that imports it."""
    for name in ("random", "cronsim", "json", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('own {name}')", encoding="utf-8")
    for name in ("tui", "daq"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise SystemExit('own {name}')")
    (tmp_path / "script.py").write_text("import huddle; print(huddle.plan(snr=1e3, fs=200))")
    return tmp_path


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder."""
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )


def test_the_module_runs_as_a_command_in_a_crowded_folder(crowded: Path) -> None:
    done = run(crowded, "-m", "huddle", "--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("huddle ")
    assert "Usage: huddle plan" in run(crowded, "-m", "huddle", "plan", "--help").stdout


def test_packages_that_hide_ours_are_named(crowded: Path) -> None:
    done = run(crowded, "script.py")
    assert done.returncode == 1
    said = done.stderr.splitlines()[-1]
    own = crowded / "daq" / "__init__.py"
    assert said.startswith(f"ImportError: {own}: hides the package 'daq' of huddle; expected")
    assert "-P" in said


def test_a_script_beside_them_runs_with_its_folder_off_the_path(crowded: Path) -> None:
    done = run(crowded, "-P", "script.py")
    assert done.returncode == 0, done.stderr
    assert "three-sensor" in done.stdout
