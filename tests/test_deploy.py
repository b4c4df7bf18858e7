"""What is installed on other computers: pinned by hashes, as tested."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


def test_the_build_needs_nothing_without_a_hash() -> None:
    script = (ROOT / "deploy" / "wheelhouse.sh").read_text(encoding="utf-8")
    builds = [line for line in script.splitlines() if " pip wheel " in line]
    assert builds
    assert all("--no-build-isolation" in line for line in builds)
    tools = ROOT / "deploy" / "build-requirements.txt"
    for block in re.split(r"\n(?=\S)", tools.read_text(encoding="utf-8").strip()):
        assert _PIN.match(block), block[:60]
        assert "--hash=sha256:" in block, block[:60]
    system = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]
    found, wanted = set(pins(tools)), list(system["requires"])
    while wanted:  # what the tools need, too
        needed = Requirement(wanted.pop())
        if needed.marker is None or needed.marker.evaluate():
            assert canonicalize_name(needed.name) in found
            wanted += distribution(needed.name).requires or []


def test_every_package_of_every_extra_has_a_tested_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    tested = set(pins(ROOT / "constraints.txt"))
    wanted, done = [*project["dependencies"]], {"huddle-bench"}
    for extra in project["optional-dependencies"].values():
        wanted += extra
    missing = set()
    while wanted:
        needed = Requirement(wanted.pop())
        name, extras = canonicalize_name(needed.name), sorted(needed.extras)
        if name != "huddle-bench" and name not in tested:
            missing.add(name)
        try:
            further = [] if str(needed) in done else distribution(name).requires or []
        except PackageNotFoundError:  # of an extra that is not installed here
            further = []
        done.add(str(needed))
        if name == "huddle-bench":
            continue
        for each in map(Requirement, further):
            marks = [{"extra": extra} for extra in ("", *extras)]
            if each.marker is None or any(map(each.marker.evaluate, marks)):
                wanted.append(str(each))
    assert missing == set()


def test_the_pages_have_a_framework_that_reads_paths_and_not_hosts() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (starlette,) = (
        each
        for each in map(Requirement, project["optional-dependencies"]["web"])
        if each.name == "starlette"
    )
    assert not starlette.specifier.contains("1.0.0")


def test_every_dependency_is_among_them() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    script = (ROOT / "deploy" / "wheelhouse.sh").read_text(encoding="utf-8")
    (extras,) = re.findall(r"huddle-bench\[([\w,]+)\]", script)
    for extra in extras.split(","):
        wanted += project["optional-dependencies"][extra]
    names = {re.split(r"[<>=;\[ ]", each)[0].lower() for each in wanted} - {"huddle-bench"}
    assert names <= set(pins(ROOT / "deploy" / "requirements.txt"))
