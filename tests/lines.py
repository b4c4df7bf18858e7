"""Lines of code by room, without blanks, comments and docstrings: ``make check`` prints them."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PRODUCT = ("estimator", "daq", "sim_devices", "tui", "huddle.py")
OTHERS = ("tests", "benchmarks", "docs", "examples")


def code_lines(text: str) -> int:
    """Return the lines of a module that are code."""
    documented: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and ast.get_docstring(node, clean=False) is not None:
                documented.update(range(first.lineno, (first.end_lineno or 0) + 1))
    return sum(
        bool(line.strip()) and not line.lstrip().startswith("#") and number not in documented
        for number, line in enumerate(text.splitlines(), start=1)
    )


def lines_by_room(root: Path = ROOT) -> Counter[str]:
    """Return the lines of code of every room."""
    found: Counter[str] = Counter()
    for room in (*PRODUCT, *OTHERS):
        place = root / room
        for path in [place] if place.suffix else place.rglob("*.py"):
            found[room] += code_lines(path.read_text(encoding="utf-8"))
    return found


def main() -> None:
    """Print the table."""
    found = lines_by_room()
    for room in (*PRODUCT, *OTHERS):
        print(f"{room:12}{found[room]:8,}")
    print(f"{'product':12}{sum(found[room] for room in PRODUCT):8,}")


if __name__ == "__main__":
    main()
