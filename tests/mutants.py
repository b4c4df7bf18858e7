"""Changes lines of the product one at a time, and runs the tests that reach them: ``make mutants``.

``python -m tests.mutants [NUMBER] [--seed SEED]`` works in a copy of the tree. For each change the
files of tests run that import its module, and those of its package. A change is killed if a test
fails, or if they take longer than `LIMIT`. docs/validation/mutants.md explains survivors.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PLACES = (
    *("estimator/decision/**/*.py", "estimator/levels/**/*.py", "daq/results/**/*.py"),
    *("daq/recording/**/*.py", "daq/whole_file.py", "tui/certificate/*.py"),
    *("tui/report/[!p]*.py", "tui/web/*.py"),  # of reports not `paper.py`, which is all layout
)
"""What is changed: as many lines of each, by lot."""
MOST, LIMIT = 4, 240
"""Files of tests for a change, and seconds for them: one that takes longer is killed, too."""
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


def tests_of(file: str, root: Path) -> list[str]:
    """Return files of tests of a module, those that import it first, and small ones; no browser."""
    module = file.removesuffix(".py").replace("/", ".")
    every = (each for each in (root / "tests").rglob("test_*.py") if each.stem != "test_browser")
    tests = sorted(every, key=lambda path: path.stat().st_size)
    named = re.compile(rf"^(from|import) {re.escape(module)}\b", re.MULTILINE)
    found = [each for each in tests if named.search(each.read_text(encoding="utf-8"))]
    package = root / "tests" / Path(file).parent
    while not found and package != root / "tests":
        found = [each for each in tests if each.is_relative_to(package)]
        package = package.parent
    beside = [each for each in tests if each.is_relative_to(root / "tests" / Path(file).parent)]
    more = [each for each in beside if each not in found]
    return [str(each.relative_to(root)) for each in [*found, *more][:MOST]]


def serve() -> None:
    """Run tests in a forked child for each line read: libraries are loaded once."""
    import h5py  # noqa: F401, PLC0415
    import matplotlib.figure  # noqa: F401, PLC0415
    import pydantic  # noqa: F401, PLC0415
    import scipy.signal  # noqa: PLC0415
    import scipy.stats  # noqa: F401, PLC0415
    import typer.testing  # noqa: F401, PLC0415

    sys.dont_write_bytecode = True
    said = Path("said")
    for text in sys.stdin:
        child = os.fork()
        if not child:
            os.setsid()
            signal.alarm(LIMIT)
            os.dup2(os.open(said, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), 1)
            os.dup2(1, 2)
            os._exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *json.loads(text)]))
        _, status = os.waitpid(child, 0)
        failed = re.search("^(?:FAILED|ERROR) .*", said.read_text(errors="replace"), re.MULTILINE)
        known = {0: "survived", -signal.SIGALRM: "out of time"}
        state = known.get(os.waitstatus_to_exitcode(status), "killed")
        print(json.dumps([state, failed[0][:100] if failed else ""]), flush=True)


def main() -> int:
    """Do it; exit code 1 if fewer than 95 % are killed."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("number", nargs="?", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve()
        return 0
    with tempfile.TemporaryDirectory(prefix="huddle-mutants-") as folder:
        killed = Counter(mutate(chosen(given.number, given.seed), Path(folder)))
    share = killed["killed"] / max(1, killed.total())
    print(f"{dict(killed)}: {share:.1%} killed")
    return int(share < 0.95)


def mutate(wanted: list[tuple[str, int, int, int, str]], folder: Path) -> Iterator[str]:
    """Yield what becomes of each change, and print it.

    Raises
    ------
    RuntimeError
        If tests fail without a change.
    """
    tree = folder / "tree"
    files = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
    ).stdout.split("\0")
    for name in filter(None, files):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "tests.mutants"]
    data = os.environ.get("HUDDLE_DATA", str(ROOT.parent / "shared" / "data"))
    environment = {"HUDDLE_TEST_PATIENCE": "4"} | os.environ
    environment |= {"PYTHONPATH": str(tree), "HUDDLE_DATA": data}
    with subprocess.Popen(
        [*command, "--serve"], cwd=tree, env=environment, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as server:  # fmt: skip
        if _run(server, ["tests/daq/test_whole_file.py"])[0] != "survived":
            raise RuntimeError("tests fail without a change")
        for file, line, first, last, put in wanted:
            whole = (tree / file).read_text(encoding="utf-8")
            lines = whole.splitlines(keepends=True)
            old = lines[line - 1].encode()
            lines[line - 1] = (old[:first] + put.encode() + old[last:]).decode()
            for stale in (tree / file).parent.glob(f"__pycache__/{Path(file).stem}.*.pyc"):
                stale.unlink()
            (tree / file).write_text("".join(lines), encoding="utf-8")
            state, failed = _run(server, tests_of(file, tree))
            (tree / file).write_text(whole, encoding="utf-8")
            shown = old[first:last].decode()
            print(f"{state}: {file}:{line}: {shown} -> {put}  {failed}", flush=True)
            yield state
        if server.stdin is not None:
            server.stdin.close()


def _run(server: subprocess.Popen[str], tests: list[str]) -> tuple[str, str]:
    """Return what becomes of a change, and the test that failed."""
    if server.stdin is None or server.stdout is None:
        raise RuntimeError("no pipes")
    print(json.dumps(tests), file=server.stdin, flush=True)
    state, failed = json.loads(server.stdout.readline())
    return state, failed


if __name__ == "__main__":
    sys.exit(main())
