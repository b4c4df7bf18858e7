"""Finishes the recordings of a run: repairs them, estimates, stores and reports the result.

A process of its own, so that neither memory nor a crash of a library concerns the service. It can
be killed at any moment and started again: it changes nothing that it has changed before.

``python -m tui.service.processes.finish REQUEST`` takes a `Request` as JSON, and prints an
`Outcome` as JSON; before it, lines with a point for as long as it makes progress.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from daq.bench.estimate_settings import OPTIONS, table_keys
from daq.bench.model import EstimateTable
from daq.caveats import NO_CAVEATS, Caveat, Caveats
from daq.errors import HuddleError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.recording.repair import repair
from daq.recording.signing import sign, signature_of
from daq.results.result import Result
from daq.results.store import store_results
from daq.whole_file import remove_parts
from estimator.errors import EstimatorError
from tui.output.console import write_json
from tui.output.json_document import document
from tui.output.json_values import json_text
from tui.output.logs.lines import configure
from tui.output.logs.options import LogFormat
from tui.runs.estimate_settings import chosen
from tui.service.history.ledger import band_noise, noted
from tui.service.records.parts import identities, with_continuations
from tui.service.records.run_state import RUN, RecordedNoise

MEMORY_SHARE = 0.6
"""Of the memory of the service that an estimate may take: the least of the computer's and of the
limits of its control group."""
OOM_SCORE = 800
"""Of 1000: an estimate can be made again, a recording cannot."""
_OF_DISK = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EMFILE, errno.ENFILE),
}
_NOISE = tuple(field.name for field in fields(RecordedNoise))


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be finished.

    Attributes
    ----------
    parts : list of str
        Paths of the recordings of the run, in order.
    options : dict
        Settings that replace those of the bench file, as its table ``[estimate]`` has them.
    report : str or None
        ``html`` or ``pdf``.
    bands : list of (float, float)
        Further bands in Hz whose noise is wanted.
    run : dict or None
        The run, as `Run.record` has it; it is stored with the result.
    key : str or None
        Private key for the recordings that are not signed yet.
    """

    parts: list[str]
    options: dict[str, Any]
    report: str | None = None
    bands: tuple[tuple[float, float], ...] = ()
    run: dict[str, Any] | None = None
    key: str | None = None

    def text(self) -> str:
        """Return the request as an argument."""
        return json.dumps(asdict(self))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of it: an error, or a verdict (empty without limits), and what is to be known.

    ``parts`` are the file names of the request, with those in which its recorders went on. If
    ``refused`` is set, the disk did not take or give something, which can be tried again.
    """

    verdict: str = ""
    notes: tuple[str, ...] = ()
    noise: tuple[RecordedNoise, ...] = ()
    error: str = ""
    parts: tuple[str, ...] = ()
    refused: bool = False
    caveats: Caveats = NO_CAVEATS
    identities: tuple[tuple[str, str, str], ...] = ()
    """File name, run id and root SHA-256 of each closed recording."""

    @classmethod
    def of(cls, text: str) -> Outcome:
        """Return the outcome that a process printed.

        Raises
        ------
        ValueError
            If it printed something else.
        """
        try:
            found = json.loads(text)
            noise = tuple(
                RecordedNoise.of(*(each[name] for name in _NOISE)) for each in found.pop("noise")
            )
            notes, parts = tuple(found.pop("notes")), tuple(found.pop("parts"))
            known = tuple((part, run, root) for part, run, root in found.pop("identities"))
            found["caveats"] = Caveats(map(Caveat, found.get("caveats", ())))
            return cls(noise=noise, notes=notes, parts=parts, identities=known, **found)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"no outcome: {error}") from None


def options_table(wanted: Mapping[str, object]) -> dict[str, Any]:
    """Return settings by field, None where not given, as the table ``[estimate]`` has them."""
    keys = {field: key for key, field in table_keys().items()}
    return {
        keys[name]: OPTIONS[name].show(value) for name, value in wanted.items() if value is not None
    }


def finish(request: Request, progress: Callable[[], object] = lambda: None) -> Outcome:
    """Repair, estimate, store, report; also the files in which recorders went on.

    `progress` is called as long as something is done: it need not be called by an estimate that
    HDF5 keeps busy for ever.
    """
    parts = with_continuations(map(Path, request.parts))
    for part in parts:
        remove_parts(part.parent, part.stem)  # of a process that was killed; only one runs
    try:
        outcome = _finished(replace(request, parts=[str(part) for part in parts]), progress)
    except (HuddleError, EstimatorError, OSError) as error:
        outcome = Outcome(error=str(error) or type(error).__name__, refused=is_of_disk(error))
    names = tuple(part.name for part in parts)
    return replace(outcome, parts=names, identities=tuple(identities(parts)))


def _signed(parts: Sequence[Path], key: Path) -> Iterator[str]:
    """Sign recordings that are not signed yet; yield problems."""
    for part in parts:
        try:
            if signature_of(part) is None:
                sign(part, key)
        except (HuddleError, OSError) as error:
            yield f"{part.name}: not signed: {error}"


def _finished(request: Request, progress: Callable[[], object]) -> Outcome:
    paths, notes, refused = _repaired([Path(part) for part in request.parts], progress)
    if request.key is not None:
        notes += _signed(paths, Path(request.key))
    table = EstimateTable.model_validate(request.options)
    names = table_keys()
    wanted = {names[key]: getattr(table, key) for key in table.model_fields_set}
    with Recording.open(paths[-1]) as recording:
        bench = recording.bench
        about = {s.name: (s.model, s.serial_number) for s in recording.sensors}
    settings = chosen(Settings.of(bench), **wanted)
    paths = _long_enough(paths, settings.segment, notes)

    def of_segments(_done: int, _total: int) -> None:
        progress()

    snapshot = estimate(paths, settings, progress=of_segments)
    progress()
    last, result = paths[-1], Result(snapshot, settings, bench, tuple(paths))
    verdict = "" if result.verdict is None else str(result.verdict.verdict)
    noise = band_noise(result, request.bands, about, notes)
    about_run = {}
    if request.run is not None:
        record = request.run | {
            "recordings": [Path(part).name for part in request.parts],
            "verdict": verdict,
            "noise": [asdict(each) for each in noise],
        }
        about_run = {RUN: json_text(record)}
    try:  # first into the recording, whatever becomes of other files
        store_results(last, snapshot, about=about_run)
    except HuddleError as error:
        notes.append(f"the result is not in the recording: {error}")
        refused |= is_of_disk(error)
    noted(last, result)
    text = document(result)
    try:
        write_json(str(last.with_suffix(".json")), text)
    except OSError as error:
        notes.append(f"the result is not in the JSON file: {error}")
        refused |= is_of_disk(error)
    if request.report is not None:
        try:
            _report(result, last, request.report)
        except (HuddleError, OSError) as error:
            notes.append(f"no report: {error}")
            refused |= is_of_disk(error)
    return Outcome(verdict, tuple(notes), noise, refused=refused, caveats=snapshot.caveats)


def is_of_disk(error: BaseException | None) -> bool:
    """Return whether an error comes from a disk, or the lack of descriptors: both can pass."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _OF_DISK:
            return True
        error = error.__cause__ or error.__context__
    return False


def _repaired(
    parts: Sequence[Path], progress: Callable[[], object]
) -> tuple[list[Path], list[str], bool]:
    """Close what was left open.

    Returns
    -------
    paths : list of Path
        Recordings that can be read.
    notes : list of str
        What was found.
    refused : bool
        Whether the disk refused one.
    """
    good: list[Path] = []
    notes: list[str] = []
    errors: list[HuddleError] = []
    for part in parts:
        try:
            if not repair(part, progress=progress).intact:
                notes.append(f"{part.name}: damaged blocks are left out")
        except HuddleError as error:
            errors.append(error)
        else:
            good.append(part)
    if not good:
        raise NothingRecordedError("; ".join(map(str, errors))) from errors[0]
    return good, notes + [str(error) for error in errors], any(map(is_of_disk, errors))


class NothingRecordedError(HuddleError):
    """No recording of the run can be read."""


def _long_enough(paths: list[Path], segment: float, notes: list[str]) -> list[Path]:
    """Return the recordings that hold a segment of every sensor, or all if none does."""
    if len(paths) == 1:
        return paths
    found = []
    for path in paths:
        with Recording.open(path) as recording:
            shortest = min(s.n_samples / s.sampling_rate for s in recording.sensors)
        if shortest >= segment:
            found.append(path)
        else:
            notes.append(f"{path.name}: shorter than one segment, and left out")
    return found or paths


def _report(result: Result, last: Path, kind: str) -> None:
    from tui.report.writing import write  # noqa: PLC0415 - matplotlib only where there is a report

    write(result, last.with_suffix(f".{kind}"), taken="beside")


class _Heartbeat:
    """Prints a line with a point, at most once a second."""

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self) -> None:
        """Print, if it is time."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + 1.0
            sys.stdout.write(".\n")
            sys.stdout.flush()


def die_first() -> None:
    """Have the kernel end this process before any other of the service if memory runs out."""
    with contextlib.suppress(OSError):  # not Linux
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE), encoding="ascii")


def limit_memory(share: float = MEMORY_SHARE) -> None:
    """Have this process fail with MemoryError beyond a share of the memory that the service has."""
    if sys.platform != "linux":
        return
    import resource  # noqa: PLC0415 - Windows has none

    sizes = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with contextlib.suppress(OSError):
        _, _, group = Path("/proc/self/cgroup").read_text(encoding="ascii").partition("0::/")
        for name in ("memory.max", "memory.high"):
            limit = Path("/sys/fs/cgroup", group.strip(), name)
            with contextlib.suppress(OSError, ValueError):  # no such limit, or "max"
                sizes.append(int(limit.read_text(encoding="ascii")))
    n_bytes = round(share * min(sizes))
    resource.setrlimit(resource.RLIMIT_DATA, (n_bytes, n_bytes))


def main() -> None:
    """Finish what the argument says; print the outcome."""
    die_first()
    limit_memory()
    configure(style=LogFormat.JSON)
    found = json.loads(sys.argv[1])
    request = Request(**found | {"bands": tuple((low, high) for low, high in found["bands"])})
    sys.stdout.buffer.write(json_text(asdict(finish(request, _Heartbeat()))).encode())


if __name__ == "__main__":
    main()
