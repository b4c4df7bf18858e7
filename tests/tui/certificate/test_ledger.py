"""The ledger: no number is lost or given twice, and no change stays unnoticed."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.waiting import limit
from tui.certificate.ledger import NAME, Ledger, LedgerEntry, LedgerError

AT = datetime(2026, 11, 25, 12, tzinfo=UTC)

ISSUE = """
import os, signal, sys
from datetime import UTC, datetime
from pathlib import Path
import tui.certificate.ledger as module
from tui.certificate.ledger import Ledger

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

folder, name, point, count = sys.argv[1:]
for number in range(int(count)):
    ledger = Ledger(Path(folder))
    with ledger.held():
        run = (f"{name}.h5", f"{name}{number}", "0" * 64)
        entry = ledger.allot("LAB", at=datetime(2026, 11, 25, tzinfo=UTC), by="Ada",
                             recordings=[run], settings={}, reason="")
        if point == "after the number":
            die()
        if point == "before the name":
            module._name = die
        ledger.publish(entry, ".pdf", f"{name} {number}".encode())
"""


def issue(ledger: Ledger, run: str, *, reason: str = "", prefix: str = "LAB") -> LedgerEntry:
    with ledger.held():
        entry = ledger.allot(
            prefix, at=AT, by="Ada", recordings=[(f"{run}.h5", run, "0" * 64)],
            settings={"segment": "10s"}, reason=reason,
        )  # fmt: skip
        ledger.publish(entry, ".pdf", run.encode())
    return entry


def start(folder: Path, name: str, *, point: str = "", count: int = 1) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", ISSUE, str(folder), name, point, str(count)])


def states(ledger: Ledger) -> list[tuple[str, int, str]]:
    return [(each.number, each.revision, each.state) for each in ledger.entries()]


def test_numbers_run_on_and_a_further_one_of_a_run_is_a_revision(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    for run in ("a", "b"):
        issue(ledger, run)
    assert issue(ledger, "a", reason="finer").name == "LAB-2026-0001, revision 1"
    assert issue(ledger, "c", prefix="OTHER").number == "OTHER-2026-0001"
    assert states(ledger) == [
        ("LAB-2026-0001", 0, "replaced"),
        ("LAB-2026-0002", 0, "issued"),
        ("LAB-2026-0001", 1, "issued"),
        ("OTHER-2026-0001", 0, "issued"),
    ]
    assert (tmp_path / "LAB-2026-0001-r1.pdf").read_bytes() == b"a"


def test_processes_that_issue_at_once_share_no_number(tmp_path: Path) -> None:
    running = [start(tmp_path, name, count=5) for name in "abcd"]
    assert [process.wait(limit()) for process in running] == [0] * 4
    found = Ledger(tmp_path).entries()
    assert [each.number for each in found] == [f"LAB-2026-{n:04d}" for n in range(1, 21)]
    assert {each.state for each in found} == {"issued"}
    for each in found:
        name = each.recordings[0][1]
        content = (tmp_path / each.file).read_bytes().decode()
        assert content == f"{name[0]} {name[1:]}"


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL there")
def test_a_number_without_a_file_is_void_and_not_given_again(tmp_path: Path) -> None:
    assert start(tmp_path, "a", point="after the number").wait(limit()) == -signal.SIGKILL
    ledger = Ledger(tmp_path)
    assert states(ledger) == [("LAB-2026-0001", 0, "void")]
    assert issue(ledger, "a0").number == "LAB-2026-0002"  # the same run: nothing to revise
    assert states(ledger) == [("LAB-2026-0001", 0, "void"), ("LAB-2026-0002", 0, "issued")]
    assert sorted(path.name for path in tmp_path.glob("*.pdf")) == ["LAB-2026-0002-r0.pdf"]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL there")
def test_a_certificate_that_lacks_only_its_name_gets_it(tmp_path: Path) -> None:
    assert start(tmp_path, "a", point="before the name").wait(limit()) == -signal.SIGKILL
    ledger = Ledger(tmp_path)
    assert states(ledger) == [("LAB-2026-0001", 0, "file missing")]
    issue(ledger, "b")
    assert states(ledger) == [("LAB-2026-0001", 0, "issued"), ("LAB-2026-0002", 0, "issued")]
    assert (tmp_path / "LAB-2026-0001-r0.pdf").read_bytes() == b"a 0"
    assert not list(tmp_path.glob(".*.part"))


def test_no_file_is_replaced(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    (tmp_path / "LAB-2026-0001-r0.pdf").write_text("of somebody else", encoding="utf-8")
    with pytest.raises(LedgerError, match="exists, and is not in the ledger"):
        issue(ledger, "a")
    assert (tmp_path / "LAB-2026-0001-r0.pdf").read_text(encoding="utf-8") == "of somebody else"
    assert issue(ledger, "a").number == "LAB-2026-0002"


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE entries SET record = replace(record, 'Ada', 'Bob') WHERE row = 3",
        "DELETE FROM entries WHERE row = 2",
        "DELETE FROM entries WHERE row >= 5",
    ],
)
def test_a_changed_ledger_is_detected(tmp_path: Path, statement: str) -> None:
    ledger = Ledger(tmp_path)
    for run in ("a", "b", "c"):
        issue(ledger, run)
    with closing(sqlite3.connect(tmp_path / NAME)) as rows:
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            rows.execute(statement)
        rows.executescript("DROP TRIGGER no_change; DROP TRIGGER no_removal;")
        rows.execute(statement)
        rows.commit()
    with pytest.raises(LedgerError, match="changed by hand"):
        ledger.entries()
    with pytest.raises(LedgerError, match="changed by hand"):
        issue(ledger, "d")


@pytest.mark.parametrize(
    "file", ["../../lab.toml", "/etc/passwd", "lab.toml", "LAB-2026-0001-r0.pdf/../x", "", None]
)
def test_a_ledger_from_elsewhere_names_certificates_only(tmp_path: Path, file: object) -> None:
    ledger = Ledger(tmp_path)
    entry = issue(ledger, "a")
    assert [each.file for each in ledger.entries()] == ["LAB-2026-0001-r0.pdf"]
    record = {"kind": "issued", "number": entry.number, "revision": 0, "file": file}
    ledger._add({"at": AT.isoformat(), "sha256": "0" * 64} | record)  # noqa: SLF001 - a forger
    with pytest.raises(LedgerError, match="row 3 is no row of a ledger"):
        ledger.entries()


@pytest.mark.parametrize("record", [{}, {"kind": "allotted"}, {"kind": "void", "number": 3}])
def test_a_row_that_is_no_record_is_named(tmp_path: Path, record: dict[str, object]) -> None:
    ledger = Ledger(tmp_path)
    issue(ledger, "a")
    ledger._add(record)  # noqa: SLF001 - a forger
    with pytest.raises(LedgerError, match="row 3 is no row of a ledger"):
        ledger.entries()
