"""Bits and pages of the database of runs change: the next start restores it, or it is as it was.

SQLite has no checksums: a bit of a number or of a text changes unseen. Such changes are counted.
"""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from daq.bench.model import Bench
from daq.errors import HuddleError
from tests.torture.long_history import make_history
from tui.service.healing import heal
from tui.service.records.store import NAME, RunStore, StoreError

PAGE = 4096
KINDS = ("bit", "zeros", "random", "another page", "cut")


def damaged(content: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """Return a database with one changed bit or page, or without its end."""
    changed = bytearray(content)
    at, other = (int(page) * PAGE for page in rng.integers(len(content) // PAGE, size=2))
    if kind == "bit":
        changed[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    elif kind == "cut":
        del changed[at:]
    else:
        pages = {"zeros": bytes(PAGE), "random": rng.bytes(PAGE)}
        changed[at : at + PAGE] = pages.get(kind, content[other : other + PAGE])
    return bytes(changed)


def database_faults(folder: Path, n: int, *, seed: int) -> tuple[list[str], str]:
    """Damage a database so often; return what was not as it must be, and the outcomes."""
    rng = np.random.default_rng(seed)
    bench = make_history(folder, 300, seed=seed)
    store = RunStore(bench.recording_directory)
    store.copy(datetime.now(UTC).date())
    content, expected = store.path.read_bytes(), _rows(store.path)
    faults, outcomes = [], Counter[str]()
    level = logging.root.manager.disable
    logging.disable()
    try:
        for number in range(n):
            kind = KINDS[number % len(KINDS)]
            store.path.write_bytes(damaged(content, kind, rng))
            try:
                found = _outcome(bench, expected)
            except Exception as error:  # noqa: BLE001 - whatever it is, the service has ended
                found = f"{type(error).__name__}: {error}"
                faults.append(f"{kind}: {found}")
            outcomes[found if kind != "bit" else f"{found} (one bit)"] += 1
            for moved in store.path.parent.glob(f"{NAME}.damaged-*"):
                moved.unlink()
    finally:
        logging.disable(level)
    return faults, ", ".join(f"{n} {found}" for found, n in outcomes.most_common())


def _outcome(bench: Bench, expected: dict[str, list[Any]]) -> str:
    """Return what a service that starts makes of its database."""
    store = RunStore(bench.recording_directory)
    with contextlib.suppress(StoreError):  # what `status` and `runs` say meanwhile
        store.current(bench.name)
        store.runs(last=100)
    is_healed = heal(store, bench, datetime.now(UTC))
    if store.damage():
        raise HuddleError(f"still damaged: {store.damage()}")
    for _ in store.noise(bench.name):
        pass
    found = _rows(store.path)
    if found == expected:
        return "restored" if is_healed else "as it was"
    lost = len(expected["runs"]) - len(found["runs"])
    if is_healed or lost:
        raise HuddleError(f"{lost} of {len(expected['runs'])} runs are lost")
    return "a value changed"


def _rows(path: Path) -> dict[str, list[Any]]:
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.text_factory = bytes
        return {
            "runs": database.execute("SELECT * FROM runs ORDER BY key").fetchall(),
            "noise": database.execute("SELECT * FROM noise ORDER BY rowid").fetchall(),
        }
