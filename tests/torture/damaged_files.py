"""Bits and sectors of a recording are changed: what is read is right, or its damage is named.

A child process reads the files one after another, so that neither a hang nor a crash of a library
ends the tests.
"""

from __future__ import annotations

import hashlib
import selectors
import subprocess
import sys
from collections import Counter
from typing import TYPE_CHECKING

import h5py
import numpy as np

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import verify, write_results
from daq.recording.storage.trial import remember
from daq.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

CREATED = HostTime(1_000_000_000, 1_790_000_000_000_000_000)
SECTOR = 512
FAULTS = ("hang", "crash", "changed silently", "intact but unreadable")
LIMIT = 10.0
"""Seconds that reading a file may take before it counts as a hang."""


def make_recording(path: Path) -> None:
    """Write a closed recording that has something of everything."""
    rng = np.random.default_rng(1)
    channels = tuple(Channel(name=name, sensitivity=1e6) for name in "xyz")
    sensors = [SensorLayout(name, channels, 100.0, np.dtype("i4")) for name in "ab"]
    writer = RecordingWriter.create(path, sensors=sensors, created=CREATED)
    for number, first in enumerate(range(0, 3000, 50)):
        at = HostTime(CREATED.monotonic_ns + first * 10**7, CREATED.utc_ns + first * 10**7)
        for name in "ab":
            flags = BlockFlag.CLIPPED if number % 7 == 0 else BlockFlag.NONE
            counts = rng.integers(-1000, 1000, (50, 3)).astype(np.int32)
            instants = at.monotonic_ns + np.arange(50) * 10**7 if name == "b" else None
            skipped = 50 * (number >= 40)
            writer.append(
                Block(name, first + skipped, counts, at, flags=flags, instants_ns=instants)
            )
        if number == 40:
            for name in "ab":
                writer.gap(name, first, 50, reason="cable pulled")
        if number % 9 == 0:
            writer.event(Event("a", "mark", f"remark {number}", at))
            writer.commit()
    writer.close()
    write_results(path, {"m": ({"noise_psd": rng.random(100)}, {"unit": "m/s²"})})


def flips(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with one flipped bit each: most of them outside of the samples."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    elsewhere = np.ones(len(content), bool)
    with h5py.File(path) as file:
        for sensor in file["sensors"].values():
            stored = sensor["samples"].id
            for number in range(stored.get_num_chunks()):
                chunk = stored.get_chunk_info(number)
                elsewhere[chunk.byte_offset : chunk.byte_offset + chunk.size] = False
    used = np.frombuffer(content, np.uint8) != 0
    places = [np.flatnonzero(elsewhere & used), np.flatnonzero(elsewhere & ~used)]
    places.append(np.flatnonzero(~elsewhere))
    for _ in range(n):
        at = int(rng.choice(places[rng.choice(3, p=(0.65, 0.15, 0.2))]))
        changed = bytearray(content)
        changed[at] ^= 1 << int(rng.integers(8))
        yield bytes(changed)


def changed_blocks(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with one flipped bit each in the rows of a table of blocks."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    with h5py.File(path) as file:
        tables = [sensor["blocks"] for sensor in file["sensors"].values()]
        places = [
            (table.id.get_chunk_info(0).byte_offset, len(table) * table.dtype.itemsize)
            for table in tables
        ]
    for _ in range(n):
        first, size = places[rng.integers(len(places))]
        changed = bytearray(content)
        changed[first + int(rng.integers(size))] ^= 1 << int(rng.integers(8))
        yield bytes(changed)


def changed_sectors(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with one sector each that is zero, random, or another sector's."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    n_sectors = len(content) // SECTOR
    for _ in range(n):
        at, other = (rng.integers(n_sectors, size=2) * SECTOR).tolist()
        kinds = (bytes(SECTOR), rng.bytes(SECTOR), content[other : other + SECTOR])
        changed = bytearray(content)
        changed[at : at + SECTOR] = kinds[rng.integers(len(kinds))]
        yield bytes(changed)


def contents(path: Path) -> str:
    """Return a digest of everything that can be read from a recording.

    Raises
    ------
    RecordingError
        If the file is damaged, and is said to be.
    """
    found = hashlib.sha256()
    with Recording.open(path) as recording:
        about = (recording.run_id, recording.created_at, recording.closed, recording.bench_text)
        found.update(repr(about).encode())
        found.update(repr(recording.events).encode())
        for sensor in recording.sensors:
            names = (sensor.name, sensor.model, sensor.clock)
            found.update(repr((names, sensor.sampling_rate, sensor.channels)).encode())
            for rows in (sensor.counts(), sensor.blocks[:], sensor.gaps, sensor.blocks.clipped):
                found.update(rows.tobytes())
            if sensor.polled:
                found.update(sensor.instants_ns().tobytes())
        for method, (arrays, attributes) in recording.results().items():
            found.update(repr((method, sorted(arrays), attributes)).encode())
            for name in sorted(arrays):
                found.update(arrays[name].tobytes())
    return found.hexdigest()


def outcome(path: Path, expected: str) -> str:
    """Return what a reader learns from a damaged file."""
    try:
        found = contents(path)
        intact = verify(path).intact
    except RecordingError:
        return "refused"
    if not intact:
        return "damage named"
    if not plain_h5py_reads(path):
        return "intact but unreadable"
    return "read as it was" if found == expected else "changed silently"


def plain_h5py_reads(path: Path) -> bool:
    """Return whether a program that knows nothing of huddle can read all objects of a file."""

    def read(_: str, found: h5py.Group | h5py.Dataset) -> None:
        for name in found.attrs:
            found.attrs[name]
        if isinstance(found, h5py.Dataset):
            found[...]

    try:
        with h5py.File(path) as file:
            read("", file)
            file.visititems(read)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        return False
    return True


def tally(files: Sequence[bytes], expected: str, folder: Path, *, limit: float) -> Counter[str]:
    """Return how many of the files have which outcome; ``limit`` is in seconds a file."""
    counts: Counter[str] = Counter()
    paths = []
    for number, content in enumerate(files):
        paths.append(folder / f"{number}.h5")
        paths[-1].write_bytes(content)
    left = list(paths)
    while left:
        for outcome in _outcomes(left, expected, limit):
            path = left.pop(0)
            if outcome in {"hang", "crash"}:  # of HDF5: the program must notice it
                found = next(_outcomes([path], expected, 3 * limit, task="as a stranger"), "crash")
                counts[found if found in FAULTS else f"{found} (HDF5: {outcome})"] += 1
            else:
                counts[outcome] += 1
    return counts


def _outcomes(
    paths: Iterable[Path], expected: str, limit: float, *, task: str = "as written here"
) -> Iterator[str]:
    """Yield outcomes from a child process, up to the first file that hangs or crashes it.

    A file "as written here" is opened without a trial in a process of its own, which takes most of
    the time.
    """
    command = [sys.executable, "-m", "tests.torture.damaged_files", task, expected]
    command += map(str, paths)
    with (
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0
        ) as child,
        selectors.DefaultSelector() as ready,
    ):
        assert child.stdout is not None
        ready.register(child.stdout, selectors.EVENT_READ)
        child.stdout.readline()  # it has imported what it needs
        while ready.select(limit):
            line = child.stdout.readline()
            if not line:
                break
            yield line.decode().strip()
        else:
            child.kill()
            yield "hang"
            return
        if child.wait() != 0:
            yield "crash"


def main() -> None:
    """Print the outcome of each file that is named."""
    from pathlib import Path  # noqa: PLC0415 - needed at run time here only

    task, expected, *paths = sys.argv[1:]
    print("ready", flush=True)
    for path in map(Path, paths):
        if task == "as written here":
            remember(path)
        print(outcome(path, expected), flush=True)


if __name__ == "__main__":
    main()
