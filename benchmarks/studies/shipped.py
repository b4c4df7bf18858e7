"""``python -m benchmarks.studies.shipped [FOLDER]``: every waveform and response file of ObsPy.

Each file whose format is read is imported, and its samples are compared with those that ObsPy reads
of the same file; each epoch of a channel in a response file is compared with evalresp. Prints the
tables of ``docs/validation/exchange.md``; returns 1 after a traceback or a sample that differs.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.errors import HuddleError
from daq.formats.importer import import_files
from daq.formats.readers.miniseed import is_miniseed
from daq.formats.readers.waveforms import load_obspy, waveform_format
from daq.formats.response import Responses, whole_response
from daq.formats.sources import Selection
from daq.recording.reader import Recording

Samples = dict[str, NDArray[Any]]

MAX_DB, MAX_DEGREES, USED, LOWEST, LEAST_KNOWN = 0.01, 0.1, 0.4, 1e-3, 0.7
SAME, ROWS, NOT_COMPARED, OURS_ALONE, REFUSED, DIFFERENT, FAILED = (
    "every sample as ObsPy has it",
    "traces overlap, or channels are resampled or lack rows, as the import says",
    "imported, not compared: without codes, or codes that ObsPy spells differently",
    "imported, and refused by ObsPy",
    "refused by name",
    "SAMPLES DIFFER",
    "TRACEBACK",
)
AGREED, OURS_REFUSES, BOTH_REFUSE, THEIRS_REFUSES, BEYOND = (
    "within 0.01 dB and 0.1° of evalresp",
    "accepted by evalresp, refused here by name",
    "refused by both",
    "refused by evalresp alone",
    "BEYOND 0.01 dB or 0.1°",
)
WRONG = {DIFFERENT, FAILED, BEYOND}


def waveform_files(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield the files whose format is read, with its name."""
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or path.suffix in {".py", ".so", ".pyc"}:
            continue
        try:
            yield path, "MSEED" if is_miniseed(path) else waveform_format(path)
        except (HuddleError, OSError):
            continue
        except Exception:  # noqa: BLE001 - ObsPy's own tests of formats fail on some files
            print(f"{path.name}: its format cannot be told: {traceback.format_exc(limit=1)}")


def by_obspy(path: Path, kind: str) -> Samples | None:
    """Return the samples of each code, traces by time one after the other; None if refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            stream = load_obspy().read(str(path), format=kind)
        except Exception:  # noqa: BLE001 - of any kind
            return None
    stream.sort(["starttime"])
    found: dict[str, list[NDArray[Any]]] = defaultdict(list)
    for trace in stream:
        samples = np.asarray(trace.data)
        if samples.dtype == np.uint8:  # WAV of 8 bits; its zero is 128
            samples = samples.astype(np.int16) - 128
        found[_without_blanks(trace.id)].append(samples)
    return {code: np.concatenate(parts) for code, parts in found.items()}


def by_import(path: Path, out: Path) -> tuple[Samples, set[str]]:
    """Return the samples of each channel that it has, and which channels were resampled."""
    result = import_files([path], out, selection=Selection(channels=("*",), overlap="first"))
    found = {}
    with Recording.open(out) as recording:
        for sensor in recording.sensors:
            counts = np.asarray(sensor.counts())
            for column, channel in enumerate(sensor.channels):
                present = np.ones(len(counts), bool)
                for absent, first, end in sensor.absent:
                    present[first:end] &= absent != column
                name = _without_blanks(f"{sensor.name}.{channel.name}")
                found[name] = counts[present, column]
    resampled = {
        _without_blanks(f"{each.sensor}.{channel}")
        for each in result.sensors
        for channel in each.resampled
    }
    return found, resampled


def _without_blanks(codes: str) -> str:
    return ".".join(code for code in codes.split(".") if code)


def compared(path: Path, kind: str) -> tuple[str, str]:
    """Return what became of a file, and a word more."""
    theirs = by_obspy(path, kind)
    with tempfile.TemporaryDirectory() as folder:
        try:
            ours, resampled = by_import(path, Path(folder) / "a.h5")
        except HuddleError as error:
            return REFUSED, str(error).splitlines()[0]
        except Exception:  # noqa: BLE001 - that is what is counted
            return FAILED, traceback.format_exc(limit=3)
    if theirs is None:
        return OURS_ALONE, ""
    if len(ours) == len(theirs) == 1:  # a file without codes
        theirs = dict(zip(ours, theirs.values(), strict=True))
    names = ours.keys() & theirs.keys()
    if not names:
        return NOT_COMPARED, f"{sorted(ours)[:2]} and {sorted(theirs)[:2]}"
    others = any(len(ours[name]) != len(theirs[name]) for name in names)
    if others or len(names) < len(theirs) or names & resampled:
        return ROWS, ""
    differ = [name for name in names if not np.array_equal(ours[name], theirs[name])]
    return (DIFFERENT, ", ".join(differ)) if differ else (SAME, "")


def response_files(folder: Path) -> Iterator[Path]:
    """Yield the RESP and StationXML files."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix not in {".py", ".so", ".pyc", ".xsd"}:
            with path.open("rb") as file:
                head = file.read(1 << 16)
            if b"FDSNStationXML" in head or b"B050F03" in head:
                yield path


def by_evalresp(raw: Any, frequency: NDArray[np.float64]) -> NDArray[Any] | None:  # noqa: ANN401 - ObsPy has no types
    """Return evalresp's response; None where it refuses."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = np.asarray(raw.get_evalresp_response_for_frequencies(frequency, output="DEF"))
        except Exception:  # noqa: BLE001 - of any kind
            return None
    return found if np.isfinite(found).all() else None


def evaluated(epoch: Any) -> tuple[str, str]:  # noqa: ANN401 - ObsPy has no types
    """Return what became of an epoch of a channel, and a word more."""
    rate = float(epoch.raw.sample_rate or 0)
    frequency = np.geomspace(LOWEST, USED * rate if rate > 0 else 1.0, 300)
    theirs = by_evalresp(epoch.raw.response, frequency)
    try:
        ours = whole_response([epoch])
    except HuddleError as error:
        return (OURS_REFUSES if theirs is not None else BOTH_REFUSE), str(error)
    if theirs is None:
        return THEIRS_REFUSES, epoch.name
    found = ours.sensitivity * ours.shape.at(frequency)
    known = np.isfinite(found)  # nothing is known beyond lists of measured values
    if known.mean() < LEAST_KNOWN:
        return BEYOND, f"{epoch.name}: known at {known.mean():.0%} of the frequencies"
    ratio = found[known] / theirs[known]
    off = np.abs(20 * np.log10(np.abs(ratio))).max(), np.abs(np.degrees(np.angle(ratio))).max()
    good = off[0] <= MAX_DB and off[1] <= MAX_DEGREES
    return (AGREED if good else BEYOND), f"{epoch.name}: {off[0]:.4f} dB, {off[1]:.3f}°"


def print_table(found: dict[Path | str, tuple[str, str]], order: tuple[str, ...]) -> None:
    """Print how many became what, then each that is not as the first of these."""
    counts = Counter(what for what, _ in found.values())
    print("| number | |\n|---|---|")
    for what in order:
        if counts[what]:
            print(f"| {counts[what]} | {what} |")
    print()
    for key, (what, more) in found.items():
        if what != order[0]:
            print(f"{key}: {what}{f': {more}' if more else ''}")
    print()


def main(arguments: list[str]) -> int:
    """Compare all files of a folder, by default of the installed ObsPy."""
    obspy = load_obspy()
    folder = Path(arguments[0]) if arguments else Path(obspy.__file__).parent
    print(f"ObsPy {version('obspy')}\n")
    waveforms: dict[Path | str, tuple[str, str]] = {}
    for path, kind in waveform_files(folder):
        waveforms[path.relative_to(folder)] = compared(path, kind)
    print(f"{len(waveforms)} waveform files")
    print_table(waveforms, (SAME, ROWS, NOT_COMPARED, OURS_ALONE, REFUSED, DIFFERENT, FAILED))
    responses: dict[Path | str, tuple[str, str]] = {}
    n_files = 0
    for path in response_files(folder):
        n_files += 1
        try:
            epochs = Responses([path])._epochs  # noqa: SLF001 - every epoch of a file
        except HuddleError as error:
            print(f"{path.name}: refused: {error}")
            continue
        for number, epoch in enumerate(epochs):
            responses[f"{path.relative_to(folder)} {number}"] = evaluated(epoch)
    print(f"{len(responses)} epochs of {n_files} response files")
    print_table(responses, (AGREED, OURS_REFUSES, BOTH_REFUSE, THEIRS_REFUSES, BEYOND))
    found = [*waveforms.values(), *responses.values()]
    return int(any(what in WRONG for what, _ in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
