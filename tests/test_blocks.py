"""The blocks of README and how-tos: commands run, and print what is shown.

In a block `console`, lines after `$ ` run in one folder for each page; `…` stands for lines that
are not shown. Numbers may differ by `TOLERANCE`, which is far below the intervals that pages show.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import textwrap
import tomllib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from tests.command import huddle

ROOT = Path(__file__).parents[1]
HOW_TOS = ROOT / "docs" / "examples"
PAGES = [ROOT / "README.md", ROOT / "docs" / "method.md", *sorted(HOW_TOS.glob("*.md"))]
TABLES = [
    page
    for page in [*ROOT.glob("docs/*.md"), *HOW_TOS.glob("*.md"), ROOT / "SECURITY.md"]
    if page.name not in {"driver-guide.md", "responses.md"}  # the one of an import names its file
    and "```toml" in page.read_text(encoding="utf-8")
]
TOLERANCE = 0.021
"""Of numbers in dB and in %, of the last of two digits that are shown."""
_BLOCK = re.compile(r"^ *```(\w+)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"[−-]?\d+\.\d+")


def blocks(page: Path, language: str) -> Iterator[str]:
    """Yield the blocks of a page in one language, without their indent."""
    for word, block in _BLOCK.findall(page.read_text(encoding="utf-8")):
        if word == language:
            yield textwrap.dedent(block)


def sessions(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield each command of a page and the lines that it prints."""
    for block in blocks(page, "console"):
        lines = block.splitlines()
        starts = [n for n, line in enumerate(lines) if line.startswith("$ ")]
        for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
            yield lines[start][2:], lines[start + 1 : end]


def is_alike(shown: str, printed: str) -> bool:
    """Return whether lines are equal but for the last digit of their numbers."""
    shown, printed = " ".join(shown.split()), " ".join(printed.split())
    if _NUMBER.sub("#", shown) != _NUMBER.sub("#", printed):
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    return all(
        abs(float(a.replace("−", "-")) - float(b.replace("−", "-"))) < TOLERANCE for a, b in pairs
    )


def assert_prints(shown: list[str], printed: str) -> None:
    """Check that the lines of a page are printed, in their order."""
    left = iter(printed.splitlines())
    for line in shown:
        if line.strip() != "…":
            assert any(is_alike(line, each) for each in left), f"{line!r} is not in\n{printed}"


def needs_usgs(command: str) -> bool:
    """Return whether a command is of the recording of the US Geological Survey."""
    return "tst" in command.lower()


@pytest.mark.parametrize(
    ("page", "usgs"),
    [
        pytest.param(page, usgs, id=page.name, marks=[pytest.mark.long] if usgs else [])
        for page in PAGES
        for usgs in (False, True)
        if any(needs_usgs(command) == usgs for command, _ in sessions(page))
    ],
)
def test_commands_print_what_is_shown(
    page: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    *,
    usgs: bool,
) -> None:
    """The recording of the survey takes longer than all others: it is a long test."""
    monkeypatch.chdir(tmp_path)
    if usgs:
        for file in request.getfixturevalue("usgs_recording").iterdir():
            (tmp_path / file.name).symlink_to(file)
    for command, shown in sessions(page):
        if needs_usgs(command) != usgs:
            continue
        words = shlex.split(command)
        assert words[0] == "huddle"
        words = [
            name
            for word in words[1:]
            for name in (sorted(map(str, Path().glob(word))) if "*." in word else [word])
        ]
        done = huddle(*words, terminal_width=200)
        assert_prints(shown, done.stdout)


def merged(whole: Any, part: Any) -> Any:  # noqa: ANN401 - a value of TOML
    """Return a bench file with the tables of a page; of sensors and channels those of the first."""
    if isinstance(whole, list):
        first = part[0] if isinstance(part, list) else part
        return [merged(whole[0], first), *whole[1:]]
    if isinstance(whole, dict):
        return whole | {
            key: merged(whole[key], value) if key in whole else value for key, value in part.items()
        }
    return part


@pytest.mark.parametrize("page", TABLES, ids=lambda page: page.name)
def test_tables_of_bench_files_are_accepted(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    huddle("init", "-o", "lab.toml")
    Path("mask.csv").write_text("frequency (Hz),noise (µg/√Hz)\n1,1\n10,2\n", encoding="utf-8")
    secret = f'"sha256:{0:064x}"'
    for number, block in enumerate(blocks(page, "toml")):
        part = tomllib.loads(re.sub(r'"(scrypt|sha256):…"', secret, block))
        bench = Path(f"{number}.toml")
        whole = tomllib.loads(Path("lab.toml").read_text(encoding="utf-8"))
        bench.write_text(tomlkit.dumps(merged(whole, part)), encoding="utf-8")
        huddle("check", bench, "--no-devices")


@pytest.mark.long
def test_shell_commands_of_how_tos_run_on_simulated_sensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of certificates, limits and miniSEED; `recordings/` and runs of hours are of real sensors."""
    monkeypatch.chdir(tmp_path)
    pages = ("issue-a-certificate.md", "limits.md", "miniseed-to-noise.md")
    shown = "".join(chain.from_iterable(blocks(HOW_TOS / page, "sh") for page in pages))
    for line in [
        "huddle simulate fig9 --duration 1min --out night.h5",
        "huddle export night.h5 --format mseed --out bench.mseed",
        *(line for line in shown.splitlines() if " recordings/" not in line and "8h" not in line),
    ]:
        huddle(*shlex.split(line)[1:])


def test_the_python_of_the_readme_prints_what_is_shown() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"^```python\n(.*?)^```\n+```\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert found is not None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(found[1], {})  # noqa: S102 - the block of the page
    assert_prints(found[2].splitlines(), printed.getvalue())


@pytest.mark.parametrize(
    "notebook", sorted((ROOT / "examples").glob("*.ipynb")), ids=lambda p: p.name
)
@pytest.mark.long
def test_notebooks_run(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)  # noqa: S102 - a cell of the notebook
    assert str(names["result"]).startswith("Self-noise, mean over ")


@pytest.mark.long
def test_the_gallery_draws_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each command of the page runs; sessions of the application are drawn by its own tests."""
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    commands = re.findall(r"^huddle (?!tui )(.*)$", page, re.MULTILINE)
    for command in commands:
        huddle(*shlex.split(command))
    assert all(Path(each.rpartition(" ")[2]).stat().st_size > 9000 for each in commands[1:])


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 110
