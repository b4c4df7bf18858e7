"""The commands whose writes fail in `tests.torture.faulty_disk`, and the numbers they must give."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pypdf import PdfReader
from scipy.io import loadmat

from daq.bench.loading import dump
from daq.bench.tables.unattended import Schedule, ScheduledRun
from daq.devices.bench_file import load
from daq.errors import RecordingError
from daq.estimation.estimation import estimate
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.signing import make_key
from daq.recording.storage.journal import journal_path
from tests.daq.archive import months
from tests.torture.after_crash import fault_after_repair, last_acknowledged
from tests.torture.faulty_disk import Command
from tests.tui.certificate.laboratory import DESPITE, laboratory
from tui.certificate.ledger import Ledger
from tui.certificate.verification import JSON_NAME
from tui.service.records.run_state import RunState
from tui.service.records.store import RunStore

SPEED = 8.0
"""Of the simulated devices, in times real time."""


def commands(inputs: Path) -> dict[str, Command]:
    """Make the inputs of all commands in a folder; return the commands by name."""
    months.record(inputs / "night.h5", hours=0.05)
    for number in range(2):
        begin = months.START_NS + number * 9 * months.HOUR_NS
        months.record(inputs / f"day-{number}.h5", hours=0.3, begin_ns=begin, seed=number)
    rng = np.random.default_rng(3)
    counts: dict[str, Any] = {
        name: rng.integers(-1000, 1000, (3000, 2)).astype(np.int32) for name in "ABC"
    }
    np.savez(inputs / "counts.npz", sampling_rate=100.0, **counts)
    make_key(inputs / "lab.key")
    killed(inputs / "killed.h5")
    laboratory(inputs / "laboratory")

    def copies(*names: str) -> Callable[[Path], object]:
        return lambda disk: [shutil.copy(inputs / name, disk / name) for name in names]

    night, options = copies("night.h5"), "--segment 10s --method three-sensor"
    days = f"archive DISK/day-0.h5 DISK/day-1.h5 --store DISK/store {options} --json DISK/a.json"
    issue = f"issue DISK/night.h5 --by 'Grace Hopper' --bench DISK/bench.toml --despite '{DESPITE}'"
    made = [
        Command(
            "estimate",
            f"estimate DISK/night.h5 {options} --json DISK/r.json --csv DISK/r.csv",
            _found({"r.json": _json("channels", "methods"), "r.csv": _text}),
            night,
        ),
        Command(
            "results in a recording", "store DISK/night.h5", _found({"night.h5": _results}), night
        ),
        Command("archive", days, _archived, copies("day-0.h5", "day-1.h5")),
        Command(
            "import",
            f"import '{inputs}/counts.npz' --out DISK/r.h5",
            _found({"r.h5": _samples}),
            needs_free_name=True,
        ),
        *(
            Command(
                f"export {kind}",
                f"export DISK/night.h5 --format {kind} --out DISK/e{suffix} {more}",
                _found({f"e{suffix}": read, **beside}),
                night,
            )
            for kind, suffix, read, more, beside in (
                ("csv", ".csv", _text, options, {"e.csv-metadata.json": _text}),
                ("netcdf", ".nc", _netcdf, options, {}),
                ("zarr", ".zarr", _netcdf, options, {}),
                ("mat", ".mat", _matlab, options, {}),
                ("npz", ".npz", _npz, options, {}),
                ("uff58", ".uff", _bytes, options, {}),
                ("mseed", ".mseed", _bytes, "", {"e.xml": _station}),
            )
        ),
        Command(
            "issue",
            issue,
            _certified,
            lambda disk: shutil.copytree(inputs / "laboratory", disk, dirs_exist_ok=True),
            needs_free_name=True,
        ),
        Command(
            "report",
            f"report DISK/night.h5 {options} --out DISK/r.html",
            _found({"r.html": _page}),
            night,
        ),
        Command(
            "sign",
            "sign DISK/night.h5 --key DISK/lab.key",
            _found({"night.sig": _json("root_sha256", "public_key")}),
            copies("night.h5", "lab.key"),
        ),
        Command(
            "sign --new-key",
            "sign --new-key DISK/k",
            _found({"k": _size, "k.pub": _size}),
            needs_free_name=True,
        ),
        Command("writer of recordings", "write DISK/r.h5", _written, records="r.h5"),
        Command(
            "repair",
            "repair DISK/killed.h5",
            _found({"killed.h5": _repaired}),
            copies("killed.h5", journal_path(inputs / "killed.h5").name),
        ),
    ]
    return {each.name: each for each in made}


def device_commands(bench: Path) -> dict[str, Command]:
    """Return the commands that record from the devices of a bench file, by name."""
    recorded = f"'{bench}' --duration 12s --out DISK/r.h5"

    def scheduled(disk: Path) -> None:
        begin = datetime(2026, 3, 1, 12, tzinfo=UTC)
        runs = tuple(
            ScheduledRun(name=f"run{number}", at=begin + timedelta(hours=number), duration=12.0)
            for number in range(3)
        )
        served = load(bench).model_copy(update={"schedule": Schedule(runs=runs)})
        (disk / "bench.toml").write_text(dump(served), encoding="utf-8")

    made = [
        Command("record", f"record {recorded}", _recorded, records="r.h5"),
        Command("run", f"run {recorded} --json DISK/r.json", _run, records="r.h5"),
        Command("serve", "serve DISK/bench.toml", _served, scheduled),
    ]
    return {each.name: each for each in made}


def killed(path: Path) -> None:
    """Write a recording whose recorder was killed."""
    said = path.with_name("acknowledged")
    said.touch()
    command = [sys.executable, "-m", "tests.torture.recording_program", str(path), str(said)]
    with subprocess.Popen([*command, "1000000"]) as process:
        while said.read_bytes().count(b"\n") < 6 and process.poll() is None:
            os.sched_yield()
        process.send_signal(signal.SIGKILL)


def _written(disk: Path) -> dict[str, Any]:
    """Return the samples of a closed recording; of one left open, what is acknowledged is there."""
    path = disk / "r.h5"
    if not path.exists():
        return {}
    try:
        with Recording.open(path) as recording:
            closed = recording.closed
    except RecordingError:
        closed = False
    if closed and not journal_path(path).exists():
        return {"r.h5": _samples(path)}
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "r.h5"
        for each in (path, journal_path(path)):
            if each.exists():
                shutil.copy(each, copy.with_name(each.name))
        said = disk / "acknowledged"
        known = last_acknowledged(said.read_bytes() if said.exists() else b"")
        if fault := fault_after_repair(copy, known):
            raise ValueError(fault)
    return {}


def _repaired(path: Path) -> Any:  # noqa: ANN401 - samples; None while it is left open
    return None if journal_path(path).exists() else _samples(path)


def _whole(path: Path) -> str | None:
    """Return that a recording is closed and intact; None while it is left open."""
    if journal_path(path).exists() or not verify(path).closed:
        return None
    if not verify(path).intact:
        raise ValueError(f"{path}: not intact")
    return "whole"


def _recorded(disk: Path) -> dict[str, Any]:
    """Return whether a recording is whole: after an error of the disk it continues in a second."""
    paths = [path for path in (disk / "r.h5", disk / "r-2.h5") if path.exists()]
    return {"recording": "whole"} if paths and _whole(paths[-1]) else {}


def _certified(disk: Path) -> dict[str, Any]:
    """Return the results in a certificate; it must be in the ledger."""
    ledger = Ledger(disk / "certificates")
    paths = list((disk / "certificates").glob("*.pdf"))
    for path in paths:
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        if not any(e.sha256 == sha256 and e.state == "issued" for e in ledger.entries()):
            raise ValueError(f"{path}: not in the ledger")
    if not paths:
        return {}
    attached = PdfReader(paths[-1]).attachments[JSON_NAME][0]
    return {"certificate": json.loads(attached)["channels"]}


def _served(disk: Path) -> dict[str, Any]:
    """Return whether a service has done a run: recordings whole, and results those of them."""
    store = next(disk.rglob("runs.sqlite"), None)
    runs = RunStore(store.parent).runs() if store is not None else ()
    parts = {name: run.parts for run in runs for name in run.parts}  # a restart begins another
    for path in sorted(disk.rglob("[!.]*.h5")):
        if _whole(path):
            with Recording.open(path) as recording:
                stored = recording.results()
            _check_results(
                [path.parent / each for each in parts.get(path.name, [path.name])], stored
            )
    done = [run for run in runs if run.state == RunState.DONE]
    if store is not None and not all(_whole(store.parent / p) for run in done for p in run.parts):
        raise ValueError("a run is done, and its recordings are not whole")
    return {"run": "done"} if done else {}


def _check_results(paths: list[Path], stored: dict[Any, Any]) -> None:
    """Raise an error if stored results are not those of their recordings."""
    snapshot = estimate(paths) if stored else None
    for method, (arrays, _) in stored.items():
        noise = None if snapshot is None else snapshot.results[str(method)].noise_psd
        if noise is None or not np.array_equal(arrays["noise_psd"], noise, equal_nan=True):
            raise ValueError("the stored result is not that of the recording")


def _run(disk: Path) -> dict[str, Any]:
    """Return what of a run is there: its result must be the estimate of the recordings."""
    found = _recorded(disk)
    if not found:
        return found
    paths = sorted(disk.glob("r*.h5"), reverse=True)  # r.h5 before r-2.h5
    with Recording.open(paths[-1]) as recording:
        stored = recording.results()
    if stored:
        _check_results(paths, stored)
        found["result"] = sorted(map(str, stored))
    if (disk / "r.json").exists():
        document = json.loads((disk / "r.json").read_text(encoding="utf-8"))
        found["r.json"] = len(document["channels"])
    return found


def _found(readers: dict[str, Callable[[Path], Any]]) -> Callable[[Path], dict[str, Any]]:
    """Return what reads products where they are."""

    def found(disk: Path) -> dict[str, Any]:
        read = {
            name: reader(disk / name) for name, reader in readers.items() if (disk / name).exists()
        }
        return {name: value for name, value in read.items() if value is not None}

    return found


def _json(*keys: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:  # noqa: ANN401 - any JSON
        document = json.loads(path.read_text(encoding="utf-8"))
        return {key: document.get(key) for key in keys}

    return read


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _bytes(path: Path) -> str:
    return path.read_bytes().hex()


def _size(path: Path) -> int:
    return path.stat().st_size


def _page(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    if not text.rstrip().endswith("</html>"):
        raise ValueError(f"{path}: cut off")
    return [str(len(text)), *text.split("<td")[1:50]]


def _station(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    return text[text.index("<Network") :]


def _netcdf(path: Path) -> dict[str, Any]:
    import huddle  # noqa: PLC0415 - takes long

    return {
        str(name): np.asarray(each).tolist() for name, each in huddle.load(path).variables.items()
    }


def _matlab(path: Path) -> dict[str, Any]:
    found = loadmat(path)
    return {str(name): str(value.tolist()) for name, value in found.items() if name[0] != "_"}


def _npz(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as found:
        return {name: found[name].tolist() for name in found}


def _samples(path: Path) -> dict[str, Any]:
    if not verify(path).intact:
        raise ValueError(f"{path}: not intact")
    with Recording.open(path) as recording:
        return {each.name: each.counts().tolist() for each in recording.sensors}


def _results(path: Path) -> Any:  # noqa: ANN401 - arrays by method; None without results
    if not verify(path).intact:
        raise ValueError(f"{path}: not intact")
    with Recording.open(path) as recording:
        found = recording.results()
    return {
        method: {name: values.tolist() for name, values in arrays.items()}
        for method, (arrays, _) in found.items()
    } or None


def _archived(disk: Path) -> dict[str, Any]:
    """Return the answer that was written, and each file of the archive."""
    found: dict[str, Any] = {}
    if (disk / "a.json").exists():
        document = json.loads((disk / "a.json").read_text(encoding="utf-8"))
        if not document["archive"].pop("problems"):  # or it says that it is not of all
            found["a.json"] = {key: document[key] for key in ("archive", "days", "density")}
    for path in (disk / "store").rglob("[!.]*.h5"):
        if not path.name.startswith("rollup"):
            found[path.name] = _spectra(path)
    return found


def _spectra(path: Path) -> dict[str, Any]:
    from daq.archive.spectra_file import SpectraFile  # noqa: PLC0415

    with SpectraFile(path) as file:
        return {
            "rows": [(start, n, str(csm.tolist())) for start, n, csm in file.rows()],
            "months": dict(file.months),
        }
