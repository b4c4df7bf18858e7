"""What is installed: the wheel holds the front door and its types, and works away from the tree."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
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


def test_a_package_that_was_installed_over_ours_is_named(site: Path, tmp_path: Path) -> None:
    shutil.copytree(site, tmp_path / "site")
    (tmp_path / "site" / "daq" / "__init__.py").write_text("import nowhere_to_be_found")
    info = tmp_path / "site" / "daq-0.4.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: daq\nVersion: 0.4\n")
    (info / "top_level.txt").write_text("daq\n")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "huddle", "estimate", "a.h5"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    (said,) = done.stderr.splitlines()
    assert f"daq{os.sep}__init__.py: replaced by another package that is called 'daq'" in said
    assert "run: python -m pip uninstall daq, then install huddle again" in said


def test_the_command_is_the_front_door(site: Path) -> None:
    """A package that hides ours is named by the command, too."""
    (entries,) = site.glob("huddle_bench-*.dist-info/entry_points.txt")
    assert "\nhuddle = huddle:main\n" in entries.read_text(encoding="utf-8")


SERVICE = ("fast", "metrics", "miniseed", "report", "signing", "web")
PLATFORMS = {
    "aarch64": (("manylinux2014_aarch64", "manylinux_2_28_aarch64"), SERVICE),
    # cryptography has no wheels for Intel Macs any more: recordings are not signed there.
    "x86_64 of Apple": (("macosx_10_12_x86_64", "macosx_14_0_x86_64"), SERVICE[:4] + SERVICE[5:]),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("aarch64", marks=pytest.mark.long),
        pytest.param("x86_64 of Apple", marks=pytest.mark.study),
    ],
)
def test_wheels_of_all_that_a_service_needs_are_there(name: str, tmp_path: Path) -> None:
    platforms, extras = PLATFORMS[name]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [*project["dependencies"]]
    for extra in extras:
        needed += [e for e in project["optional-dependencies"][extra] if "huddle-bench" not in e]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--dry-run", "--only-binary=:all:", "--quiet"]
        + ["--disable-pip-version-check", "--target", str(tmp_path), "--python-version", "3.11"]
        + ["--constraint", str(ROOT / "constraints.txt")]
        + [f"--platform={each}" for each in platforms]
        + needed,
        capture_output=True,
        text=True,
        check=False,
    )
    if "connection broken" in done.stderr:
        pytest.skip("no network")
    assert done.returncode == 0, done.stderr


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
