"""What is installed: the wheel holds the front door and its types, and works away from the tree."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = """
import huddle

result = huddle.self_noise({"A": [1.0], "B": [2.0], "C": [3.0]}, fs=200, segment="10s")
reveal_type(result)
huddle.estimate("a.h5", segmnt=10)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and install it, without what it needs, into an environment of its own."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    venv.create(folder / "venv")
    (site,) = (folder / "venv").glob("[Ll]ib/**/site-packages")
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """Make a folder with modules of the user's own; each ends the process that imports it."""
    for name in ("random", "cronsim", "huddle"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('own {name}')", encoding="utf-8")
    for name in ("tui", "daq"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise SystemExit('own {name}')")
    return tmp_path


def run(site: Path, folder: Path, *arguments: str) -> str:
    """Run Python in a folder with the installed wheel before the tree; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-P", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.long
def test_it_works_in_a_folder_of_the_users_own_modules(site: Path, crowded: Path) -> None:
    call = (
        "import huddle; sensors = huddle.simulate('fig9', 60);"
        "print(huddle.__file__, huddle.self_noise(sensors, fs=sensors.fs).n_segments)"
    )
    assert run(site, crowded, "-c", call).split() == [str(site / "huddle.py"), "11"]
    assert run(site, crowded, "-m", "huddle", "--version").startswith("huddle ")


def test_everything_that_is_not_code_is_in_it(site: Path) -> None:
    tree = {
        str(path.relative_to(ROOT))
        for package in ("daq", "estimator", "sim_devices", "tui")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix not in {".py", ".pyc"}
    }
    assert {str(Path(package, "py.typed")) for package in ("daq", "estimator", "tui")} < tree
    stub = str(Path("tui", "resources", "huddle.pyi"))
    assert not [name for name in tree - {stub} if not (site / name).is_file()]
    assert (site / "huddle-stubs" / "__init__.pyi").read_text() == (ROOT / stub).read_text()


@pytest.mark.long
def test_a_users_type_checker_sees_its_types(site: Path, tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT, encoding="utf-8")
    interpreter = next(site.parents[i] for i in (1, 2) if (site.parents[i] / "pyvenv.cfg").exists())
    python = next(interpreter.glob("[bS]*/python*"))
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(python), "script.py"],
        cwd=tmp_path,
        env={key: value for key, value in os.environ.items() if key != "MYPYPATH"},
        capture_output=True,
        text=True,
        check=False,
    )
    notes, errors = (
        [line for line in done.stdout.splitlines() if f": {kind}: " in line]
        for kind in ("note", "error")
    )
    assert any('"tui.notebook.result.Result"' in line for line in notes), done.stdout
    assert len(errors) == 1
    assert 'Unexpected keyword argument "segmnt"' in errors[0]
