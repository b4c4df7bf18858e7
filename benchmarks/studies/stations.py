"""A simulated year of many stations, archived by a local Dask cluster, and its growth.

``python -m benchmarks.studies.stations FOLDER`` writes day files of an SDS archive into a folder,
archives 1, 10 and 100 stations by the workers of a Dask scheduler on this computer, and prints the
table of ``docs/validation/archives.md``. ``--kills`` kills the command and a worker again and again
while stations are taken, and compares every value with archives of one process and of two.

The sampling rate is 0.1 Hz, one channel a sensor: at 100 Hz and three channels, as in the tables of
60 days, a year of 100 stations would fill 4 TB. Days are whole, and follow each other without gaps.

Samples are drawn here, and files are written by pymseed: neither shares code with the archive.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import psutil
import pymseed

from daq.archive.stations import archives_in
from daq.archive.store import Store
from daq.python_process import python_command

FIRST_S = 20_454 * 86_400  # 2026-01-01
RATE = 0.1
SENSORS = ("00", "10", "20")
NOISE, MOTION = 20.0, 500.0
OPTIONS = (
    *("--segment", "600s", "--stretch", "day", "--method", "three-sensor"),
    *("--clocks", "nominal"),
)
SCHEDULER = "tcp://127.0.0.1:28786"
_MB = 1 << 20
_KILLS = 4


@dataclass(frozen=True, slots=True)
class Cost:
    """What a run cost: seconds of wall and processor time, and peak memory in bytes."""

    wall: float
    command: float
    workers: float
    scheduler: float
    command_peak: int
    worker_peak: int
    scheduler_peak: int
    said: str


def write_year(root: Path, station: str, *, n_days: int, seed: int) -> None:
    """Write day files of one channel of three sensors: one motion, noise of its own in each."""
    rng = np.random.default_rng(seed)
    n = round(86_400 * RATE)
    for day in range(n_days):
        begin_s = FIRST_S + day * 86_400
        motion = rng.normal(size=n) * MOTION
        for location in SENSORS:
            counts = np.rint(motion + NOISE * rng.normal(size=n)).astype(np.int32)
            when = datetime.fromtimestamp(begin_s, UTC)
            folder = root / f"{when:%Y}" / "XX" / station / "VHZ.D"
            folder.mkdir(parents=True, exist_ok=True)
            record = pymseed.MS3Record(reclen=4096, encoding=11)
            record.formatversion = 2
            record.sourceid = pymseed.nslc2sourceid("XX", station, location, "VHZ")
            record.samprate = RATE
            record.starttime = begin_s * 10**9
            path = folder / f"XX.{station}.{location}.VHZ.D.{when:%Y.%j}"
            path.write_bytes(b"".join(bytes(each) for each in record.generate(counts, "i")))


@contextlib.contextmanager
def cluster(n_workers: int) -> Iterator[list[psutil.Process]]:
    """Run a scheduler and workers of Dask on loopback; yields their processes."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    host = ("--host", "127.0.0.1", "--no-dashboard")
    commands = [
        [*python_command("distributed.cli.dask_scheduler"), "--port", SCHEDULER[-5:], *host],
        *(
            [*python_command("distributed.cli.dask_worker"), SCHEDULER, "--nthreads", "1", *host]
            for _ in range(n_workers)
        ),
    ]
    processes = [subprocess.Popen(each, **quiet) for each in commands]  # type: ignore[call-overload]
    try:
        time.sleep(8)  # until they know each other
        yield [psutil.Process(each.pid) for each in processes]
    finally:
        for each in processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                for child in psutil.Process(each.pid).children(recursive=True):
                    child.kill()
            each.kill()
            each.wait()


def archived(sources: Sequence[str], store: Path, *options: str) -> subprocess.Popen[str]:
    """Start `huddle archive`."""
    command = [*python_command("tui"), "archive", *sources, "--store", str(store), *OPTIONS]
    return subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def measured(
    sources: Sequence[str], store: Path, processes: Sequence[psutil.Process], *options: str
) -> Cost:
    """Archive, and measure the command, the scheduler and the workers."""
    before = [_cpu(each) for each in processes]
    own = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.monotonic()
    with archived(sources, store, *options) as command:
        about = psutil.Process(command.pid)
        peak = 0
        while command.poll() is None:
            with contextlib.suppress(psutil.NoSuchProcess):
                peak = max(peak, about.memory_info().rss)
            time.sleep(0.2)
        said = command.stdout.read() if command.stdout else ""
    wall = time.monotonic() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = [_cpu(each) - one for each, one in zip(processes, before, strict=True)]
    if command.returncode:
        raise SystemExit(f"huddle archive ended with {command.returncode}:\n{said}")
    return Cost(
        wall=wall,
        command=after.ru_utime + after.ru_stime - own.ru_utime - own.ru_stime,
        workers=sum(spent[1:]),
        scheduler=spent[0] if spent else 0.0,
        command_peak=peak,
        worker_peak=max((_peak(each) for each in processes[1:]), default=0),
        scheduler_peak=_peak(processes[0]) if processes else 0,
        said=said,
    )


def _cpu(process: psutil.Process) -> float:
    """Seconds of a process and its children, living and dead."""
    every = [process, *process.children(recursive=True)]
    return sum(sum(each.cpu_times()[:4]) for each in every)


def _peak(process: psutil.Process) -> int:
    """Return the largest memory that a process or a child of it has had."""
    found = []
    for each in (process, *process.children(recursive=True)):
        text = Path(f"/proc/{each.pid}/status").read_text(encoding="ascii")
        (line,) = (row for row in text.splitlines() if row.startswith("VmHWM"))
        found.append(int(line.split()[1]) * 1024)
    return max(found)


def values(folder: Path) -> dict[str, bytes]:
    """Return every dataset and attribute of the archives in a folder but those of roll-ups."""
    found: dict[str, bytes] = {}
    for place in archives_in(folder):
        store = Store.open(place)
        for path in store.files() if store else ():

            def take(name: str, item: h5py.Group, path: Path = path) -> None:
                place = f"{path.parent.parent.name}/{path.name} {name}"
                for key, value in item.attrs.items():
                    found[f"{place} {key}"] = repr(np.asarray(value).tolist()).encode()
                if isinstance(item, h5py.Dataset):
                    found[place] = np.asarray(item[()]).tobytes()

            with h5py.File(path) as file:
                take("/", file)
                file.visititems(take)
    return found


def growth(root: Path, out: Path, numbers: Sequence[int], n_days: int, n_workers: int) -> None:
    """Print a row for each number of stations."""
    print("| stations | days | wall | CPU of workers | of the command | of the scheduler |", end="")
    print(" peak of a worker | of the command | of the scheduler | again, nothing new |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for number in numbers:
        names = ",".join(f"S{each:03d}" for each in range(number))
        chosen = ["--channels", ",".join(f"XX.{name}.*" for name in names.split(","))]
        with cluster(n_workers) as processes:
            options = (*chosen, "--scheduler", SCHEDULER)
            store = out / f"of-{number}"
            cost = measured([f"sds://{root}"], store, processes, *options)
            again = measured([f"sds://{root}"], store, processes, *options)
        n = number * n_days
        peaks = (cost.worker_peak, cost.command_peak, cost.scheduler_peak)
        print(
            f"| {number} | {n} | {cost.wall:.0f} s | {cost.workers:.0f} s, {cost.workers / n:.3f} a"
            f" day | {cost.command:.0f} s | {cost.scheduler:.0f} s |"
            f" {' | '.join(f'{peak / _MB:.0f} MB' for peak in peaks)} |"
            f" {again.wall:.0f} s, {again.command + again.workers:.0f} s of CPU |",
            flush=True,
        )


def kills(root: Path, out: Path, n_stations: int, n_workers: int) -> None:
    """Kill the command and a worker until all is done, and compare with one process and two."""
    rng = np.random.default_rng(1)
    names = ",".join(f"XX.S{each:03d}.*" for each in range(n_stations))
    source = [f"sds://{root}"]
    options = ("--channels", names, "--scheduler", SCHEDULER)
    n_killed = 0
    with cluster(n_workers) as processes:
        while n_killed < _KILLS:
            with archived(source, out / "killed", *options) as command:
                enough = _n_files(out / "killed") + int(rng.integers(30, 90))
                while _n_files(out / "killed") < enough and command.poll() is None:
                    time.sleep(0.1)
                if command.poll() is not None:
                    break
                children = processes[1 + int(rng.integers(n_workers))].children()
                worker = max(children, key=lambda each: int(each.memory_info().rss))
                os.kill(worker.pid, signal.SIGKILL)
                time.sleep(rng.uniform(0, 2))
                command.kill()
                n_killed += 1
            print(f"killed {n_killed} times: {_n_files(out / 'killed')} files", flush=True)
        last = measured(source, out / "killed", processes, *options)
    print(last.said)
    stores = {"Dask, with kills": out / "killed"}
    for jobs in (1, 2):
        name = f"--jobs {jobs}"
        stores[name] = out / f"jobs-{jobs}"
        cost = measured(source, stores[name], (), "--channels", names, "--jobs", str(jobs))
        print(f"{name}: {cost.wall:.1f} s, {cost.command:.1f} s of CPU", flush=True)
    first, *others = (values(store) for store in stores.values())
    print(f"{n_killed} kills of the command and of a worker; {len(first)} values")
    for name, found in zip(list(stores)[1:], others, strict=True):
        different = [key for key in first.keys() | found.keys() if first.get(key) != found.get(key)]
        print(f"{name}: {len(different)} values differ", *different[:5])


def _n_files(store: Path) -> int:
    return len(list(store.glob("*/*/*.h5")))


def main() -> None:
    """Write what is not there, and print the tables."""
    parser = argparse.ArgumentParser(prog="benchmarks.studies.stations", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--stations", default="1,10,100")
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", action="store_true")
    given = parser.parse_args()
    numbers = [int(each) for each in given.stations.split(",")]
    root, out = given.folder / "sds", given.folder / "archives"
    for number in range(max(numbers)):
        name = f"S{number:03d}"
        if not list(root.glob(f"*/XX/{name}")):
            write_year(root, name, n_days=given.days, seed=number)
    if given.kills:
        kills(root, out, max(numbers), given.workers)
    else:
        growth(root, out, numbers, given.days, given.workers)


if __name__ == "__main__":
    main()
