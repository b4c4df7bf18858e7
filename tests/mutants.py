"""Changes lines of the product one at a time, and runs the tests that reach them: ``make mutants``.

``python -m tests.mutants [NUMBER] [--seed SEED]`` works in a copy of the tree. It runs the tests of
`TESTS` once, and notes which lines each executes; what a shared fixture executes counts for every
test that takes it. For each change the tests run that execute its line, first those of its package.
A change is killed if a test fails, or if they take too long. docs/validation/mutants.md explains
survivors.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

ROOT = Path(__file__).parents[1]
PLACES = (
    *("estimator/decision/**/*.py", "estimator/levels/**/*.py", "daq/results/**/*.py"),
    *("daq/recording/**/*.py", "daq/whole_file.py", "tui/certificate/*.py"),
    *("tui/report/[!p]*.py", "tui/web/*.py"),  # of reports not `paper.py`, which is all layout
)
"""What is changed: as many lines of each, by lot."""
TESTS = (
    *("estimator/decision", "estimator/levels", "daq/results", "daq/test_whole_file.py"),
    *("daq/recording", "tui/certificate", "tui/report", "tui/web", "tui/output", "tui/wording"),
    *("tui/page", "tui/commands", "daq/archive"),
)
"""Folders of tests that can kill a change."""
OPTIONS = ("-q", "-p", "no:cacheprovider", "--ignore-glob=*/test_browser.py")
MOST, LIMIT = 30, 300
"""Seconds of tests of a change's package, and of others; after `LIMIT` it is killed, too."""
_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
_NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
_SKIPPED = (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom, ast.arguments)


def changes(source: str) -> Iterator[tuple[int, int, int, str]]:
    """Yield line, first and last column, and what is put there instead."""
    waiting: list[ast.AST] = [ast.parse(source)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, _SKIPPED):
            continue
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            waiting += node.body
        elif isinstance(node, ast.AnnAssign):
            waiting += [node.value] if node.value else []
        else:
            waiting += ast.iter_child_nodes(node)
        changed = _changed(node)
        if changed and getattr(node, "lineno", 0) == getattr(node, "end_lineno", -1):
            place: Any = node
            yield place.lineno, place.col_offset, place.end_col_offset, changed


def _changed(node: ast.AST) -> str:  # noqa: PLR0911 - one for each kind
    """Return a changed expression or statement; empty if it has no change."""
    match node:
        case ast.Compare(left, [op], [right]) if type(op) in _SWAPS:
            other: Any = _SWAPS[type(op)]()
            return ast.unparse(ast.Compare(left, [other], [right]))
        case ast.BinOp(left, op, right) if type(op) in _SWAPS:
            other = _SWAPS[type(op)]()
            return f"({ast.unparse(ast.BinOp(left, other, right))})"
        case ast.BoolOp(op, values):
            other = _SWAPS[type(op)]()
            return f"({ast.unparse(ast.BoolOp(other, values))})"
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            return f"({ast.unparse(operand)})"
        case ast.Constant(bool() as value):
            return str(not value)
        case ast.Constant(int() | float() as value):
            return repr(value + 1)
        case ast.Name(name) if name in _NAMES:
            return _NAMES[name]
        case ast.Expr(ast.Call()):
            return "..."
        case ast.IfExp(test, body, orelse):
            return f"({ast.unparse(ast.IfExp(test, orelse, body))})"
    return ""


def chosen(number: int, seed: int) -> list[tuple[str, int, int, int, str]]:
    """Return so many changes by lot, one a line, as many of each place."""
    lot, found = random.Random(seed), []
    for place in PLACES:
        lines: dict[tuple[str, int], list[tuple[str, int, int, int, str]]] = defaultdict(list)
        for path in sorted(ROOT.glob(place)):
            name = str(path.relative_to(ROOT))
            for line, *change in changes(path.read_text(encoding="utf-8")):
                lines[name, line].append((name, line, *change))  # type: ignore[arg-type]
        some = lot.sample(sorted(lines), min(len(lines), -(-number // len(PLACES))))
        found += [lot.choice(lines[each]) for each in some]
    return lot.sample(found, min(number, len(found)))


class Executed:
    """Plugin of pytest that notes what executes each line: a test, or a shared fixture."""

    def __init__(self, notes: Path) -> None:
        self.notes = notes
        os.environ["COVERAGE_PROCESS_START"] = str(notes.parent / "coveragerc")
        self.coverage = coverage.Coverage(config_file=os.environ["COVERAGE_PROCESS_START"])
        self.coverage.start()
        self.context, self.since = "", time.monotonic()
        self.seconds: dict[str, float] = defaultdict(float)
        self.takes: dict[str, list[str]] = {}

    def switch(self, context: str) -> str:
        """Count lines and seconds for another context, in children, too; return the last."""
        last, now = self.context, time.monotonic()
        self.seconds[last] += now - self.since
        self.context = os.environ["HUDDLE_MUTANTS"] = context
        self.since = now
        self.coverage.switch_context(context)
        return last

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
        """Count a shared fixture as itself: each test that takes it executes its lines."""
        if fixturedef.scope == "function":
            return (yield)
        last = self.switch(f"{fixturedef.baseid}::{fixturedef.argname}")
        try:
            return (yield)
        finally:
            self.switch(last)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Function) -> Generator[None, Any, Any]:
        """Note the fixtures that a test takes."""
        every = itertools.chain(*item._fixtureinfo.name2fixturedefs.values())  # noqa: SLF001
        shared = [f"{each.baseid}::{each.argname}" for each in every if each.scope != "function"]
        self.takes[item.nodeid] = [item.nodeid, *shared]
        self.switch(item.nodeid)
        return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Forget a test that fails without a change."""
        if not report.passed:
            self.takes.pop(report.nodeid, None)

    def pytest_unconfigure(self) -> None:
        """Write what was noted."""
        self.switch("")
        self.coverage.stop()
        self.coverage.save()
        self.notes.write_text(json.dumps([self.seconds, self.takes]), encoding="utf-8")


class Map:
    """Which tests execute a line of `root`, by what `Executed` wrote into a folder."""

    def __init__(self, folder: Path, root: Path) -> None:
        self.root = root
        self.seconds: dict[str, float] = {}
        self.takes: dict[str, list[str]] = {}
        for path in folder.glob("*.json"):
            seconds, takes = json.loads(path.read_text(encoding="utf-8"))
            self.seconds |= seconds
            self.takes |= takes
        self.lines: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
        for path in folder.glob("lines.*"):
            data = coverage.CoverageData(str(path))
            data.read()
            for file in data.measured_files():
                for line, contexts in data.contexts_by_lineno(file).items():
                    self.lines[str(Path(file).relative_to(root))][line].update(contexts)

    def tests_of(self, file: str, line: int) -> Iterator[list[str]]:
        """Yield the tests for a change, quick ones first: of its package; others, for `MOST` s."""
        executed = self._contexts(file, line)
        found = [test for test, parts in self.takes.items() if not executed.isdisjoint(parts)]
        found.sort(key=lambda test: self.seconds[test])
        near = [test for test in found if test.startswith(f"tests/{Path(file).parent}/")]
        far = [test for test in found if test not in near]
        for some in (near, far):
            paid = itertools.accumulate(self.seconds[test] for test in some)
            yield [test for test, seconds in zip(some, paid, strict=True) if seconds < MOST]

    def _contexts(self, file: str, line: int) -> set[str]:
        """Return what executes a line; of one outside functions, what executes any."""
        lines, tree = self.lines[file], ast.parse((self.root / file).read_text(encoding="utf-8"))
        functions = (
            e for e in ast.walk(tree) if isinstance(e, (ast.FunctionDef, ast.AsyncFunctionDef))
        )
        around = (e.lineno for e in functions if e.lineno <= line <= (e.end_lineno or 0))
        first = max(around, default=0)
        while first < line and first and not lines[line]:
            line -= 1  # of a statement of several lines, not all are counted
        return lines[line] if first else set().union(*lines.values())


def main() -> int:
    """Do it; exit code 1 if fewer than 95 % are killed."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("number", nargs="?", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--map", nargs=2, type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.map:
        notes, tests = given.map
        return pytest.main([*OPTIONS, str(tests)], [Executed(notes)])
    with tempfile.TemporaryDirectory(prefix="huddle-mutants-") as folder:
        killed = Counter(mutate(chosen(given.number, given.seed), Path(folder)))
    share = 1 - killed["survived"] / max(1, killed.total())
    print(f"{dict(killed)}: {share:.1%} killed")
    return int(share < 0.95)


def mutate(wanted: list[tuple[str, int, int, int, str]], folder: Path) -> Iterator[str]:
    """Yield what becomes of each change, and print it."""
    tree = folder / "tree"
    files = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
    ).stdout.split("\0")
    for name in filter(None, files):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).write_bytes((ROOT / name).read_bytes())
    rooms = "".join(f"\n    {tree / room}" for room in ("daq", "estimator", "tui"))
    (folder / "coveragerc").write_text(
        f"[run]\nsource ={rooms}\ndata_file = {folder / 'lines'}\nparallel = true\n"
        "context = ${HUDDLE_MUTANTS-}\n",
        encoding="utf-8",
    )
    for number, some in enumerate(TESTS):
        notes = str(folder / f"{number}.json")
        print(some, *_run(tree, ["tests.mutants", "--map", notes, f"tests/{some}"]), flush=True)
    known = Map(folder, tree)
    for file, line, first, last, put in wanted:
        whole = (tree / file).read_text(encoding="utf-8")
        lines = whole.splitlines(keepends=True)
        old = lines[line - 1].encode()
        lines[line - 1] = (old[:first] + put.encode() + old[last:]).decode()
        _write(tree / file, "".join(lines))
        state, failed = "survived", "no test executes it"
        for tests in filter(None, known.tests_of(file, line)):
            if state == "survived":
                state, failed = _run(tree, ["pytest", "-x", *OPTIONS, *tests], LIMIT)
        _write(tree / file, whole)
        shown = old[first:last].decode()
        print(f"{state}: {file}:{line}: {shown} -> {put}  {failed}", flush=True)
        yield state


def _write(path: Path, text: str) -> None:
    """Write a module; a compiled one of the same second and size would take its place."""
    for stale in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
        stale.unlink()
    path.write_text(text, encoding="utf-8")


def _run(tree: Path, module: list[str], limit: float | None = None) -> tuple[str, str]:
    """Run tests; return what becomes of a change, and the test that failed."""
    data = os.environ.get("HUDDLE_DATA", str(ROOT.parent / "shared" / "data"))
    environment = {"HUDDLE_TEST_PATIENCE": "4"} | os.environ
    environment |= {"PYTHONPATH": str(tree), "HUDDLE_DATA": data}
    with subprocess.Popen(
        [sys.executable, "-m", *module], cwd=tree, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
    ) as running:  # fmt: skip
        try:
            said, _ = running.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            return "out of time", ""
    failed = re.search("^(?:FAILED|ERROR) .*", said, re.MULTILINE)
    return "killed" if running.returncode else "survived", failed[0][:100] if failed else ""


if __name__ == "__main__":
    sys.exit(main())
