"""Bench files with errors of every kind: each is read, or refused with the reason, in bounded time.

The changes are those of people (a line lost, twice, or elsewhere; another value) and of disks (a
byte). Values are some that programs take amiss: none, huge, negative, of another type, nested.
"""

from __future__ import annotations

import re
import time
from importlib import resources
from pathlib import Path

import numpy as np

from daq.devices.bench_file import load
from daq.errors import BenchFileError

LIMIT = 10.0
"""Seconds that a bench file may take."""
VALUES = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "1e-320", "9" * 40, "true", '""', '"\\u0000"'),
    *("[]", "{}", "[[[[]]]]", "[" * 500 + "]" * 500, '"10 parsecs"', '"../../etc"', "'''\n'''"),
    *("1979-05-27T07:32:00Z", "25:61:00", '"${HOME}"', '"' + "x" * 100_000 + '"', "{a = {b = 1}}"),
)
_VALUE = re.compile(r"= *([^\n=]+)$", re.MULTILINE)


def changed(text: str, rng: np.random.Generator) -> bytes:
    """Return a bench file with one to three changes."""
    for _ in range(int(rng.integers(1, 4))):
        lines = text.split("\n")
        at, other = (int(k) for k in rng.integers(len(lines), size=2))
        match int(rng.integers(6)):
            case 0:
                del lines[at]
            case 1:
                lines.insert(other, lines[at])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at] = lines[at].replace("=", str(rng.choice(["", "==", ".x =", " x="])), 1)
            case _:
                found = list(_VALUE.finditer(text))
                place = found[int(rng.integers(len(found)))] if found else None
                if place is not None:
                    value = VALUES[int(rng.integers(len(VALUES)))]
                    lines = [text[: place.start(1)] + value + text[place.end(1) :]]
        text = "\n".join(lines)
    content = bytearray(text.encode())
    if rng.random() < 0.2 and content:
        content[int(rng.integers(len(content)))] = int(rng.integers(256))
    return bytes(content)


def bench_faults(folder: Path, n: int, *, seed: int) -> tuple[list[str], str]:
    """Read so many changed bench files; return the faults, and the outcomes."""
    rng = np.random.default_rng(seed)
    texts = [
        resources.files("tui.resources").joinpath(name).read_text(encoding="utf-8")
        for name in ("demo.toml", "bench.toml")
    ]
    path, faults, n_refused, longest = folder / "fuzzed.toml", [], 0, 0.0
    for number in range(n):
        path.write_bytes(changed(texts[number % len(texts)], rng))
        begin = time.process_time()
        try:
            load(path)
        except BenchFileError:
            n_refused += 1
        except Exception as error:  # noqa: BLE001 - an error that no command expects
            faults.append(f"{type(error).__name__}: {error}"[:200])
            (folder / f"fault-{len(faults)}.toml").write_bytes(path.read_bytes())
        longest = max(longest, time.process_time() - begin)
    if longest > LIMIT:
        faults.append(f"one took {longest:.1f} s")
    return faults, f"{n_refused} refused, longest {longest:.1f} s"
