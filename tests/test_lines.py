"""What counts as a line of code."""

from __future__ import annotations

from pathlib import Path

from tests.lines import code_lines, lines_by_room

MODULE = '''"""What it is.

Two lines."""

# a comment
NAME = """a text,
not a docstring"""  # 2


def function() -> None:  # 3
    """Do it."""
    return None  # 4
'''


def test_blanks_comments_and_docstrings_are_no_code(tmp_path: Path) -> None:
    assert code_lines(MODULE) == 4
    (tmp_path / "daq" / "deep").mkdir(parents=True)
    (tmp_path / "daq" / "deep" / "a.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "huddle.py").write_text("one = 1\n", encoding="utf-8")
    found = lines_by_room(tmp_path)
    assert (found["daq"], found["huddle.py"], found["tui"]) == (4, 1, 0)
