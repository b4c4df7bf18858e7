"""What is installed on other computers: pinned by hashes, as tested."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
_PIN = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^ ;\\]+)")


def pins(path: Path) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if match := _PIN.match(line):
            found.setdefault(match["name"].lower().replace("_", "-"), set()).add(match["version"])
    return found


def test_every_package_that_is_installed_has_hashes_and_the_tested_version() -> None:
    text = (ROOT / "deploy" / "requirements.txt").read_text(encoding="utf-8")
    for block in re.split(r"\n(?=\S)", text.strip()):
        assert _PIN.match(block), block[:60]
        assert "--hash=sha256:" in block, block[:60]
    tested = pins(ROOT / "constraints.txt")
    for name, versions in pins(ROOT / "deploy" / "requirements.txt").items():
        assert versions <= tested.get(name, versions), name


def test_every_dependency_is_among_them() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in ("fast", "metrics", "report", "signing"):
        wanted += project["optional-dependencies"][extra]
    names = {re.split(r"[<>=;\[ ]", each)[0].lower() for each in wanted}
    assert names <= set(pins(ROOT / "deploy" / "requirements.txt"))
