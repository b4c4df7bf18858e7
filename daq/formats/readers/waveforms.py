"""Waveform formats that ObsPy reads: SAC, GSE2, GCF, SEG-2, SEG-Y and others.

A sensor is ``network.station.location``, its channels are the channel codes. In SEG-2 and SEG-Y
every trace is a sensor with one channel, named by the number of the trace. Samples stay counts; the
calibrations that K-NET, Kinemetrics EVT, GSE2, SEG-2 and RefTek 130 carry come along. The factor of
SAC is not taken, and said: some writers put counts per unit there, others units per count.
"""

from __future__ import annotations

import glob
import io
import math
import re
import warnings
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from daq.bench.units import STANDARD_GRAVITY
from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import ForeignCalibration
from daq.formats.readers.packages import load
from daq.formats.traces import ReadPart, Trace

FORMATS = (
    *("MSEED", "SAC", "GSE2", "GSE1", "SLIST", "TSPAIR", "SEGY", "SEG2", "WAV", "KNET"),
    *("KINEMETRICS_EVT", "REFTEK130", "AH", "GCF"),
)
"""Waveform formats that are read, by ObsPy's names, in the order in which they are tried."""
_NUMBERED = {"SEGY", "SEG2"}
"""Formats whose traces have numbers and no codes."""
_VOLTS = {"v": 1.0, "mv": 1e-3, "uv": 1e-6, "nv": 1e-9}
_EVT_FULL_SCALE = 1 << 23
_HEAD = 4096
_RESPONSES = (b"B050F03", b"FDSNStationXML", b"\nPOLES")  # RESP, StationXML, SACPZ
_LEVEN = 4 * 105
_SAC_LOGICALS, _SAC_HEADER = range(_LEVEN, _LEVEN + 20, 4), 632
_MINUS_ONE = b"\xff\xff\xff\xff"
_OTHERS = {
    b"PK\x03\x04": "a spreadsheet; save it as CSV, then: huddle import FILE.csv --out NEW.h5",
    b"\xd0\xcf\x11\xe0": "a spreadsheet; save it as CSV, then: huddle import FILE.csv --out NEW.h5",
    b"PAR1": "Parquet; write CSV with pandas (read_parquet, to_csv), then: huddle import FILE.csv"
    " --out NEW.h5",
    b"\x89HDF": "an HDF5 file; write sampling_rate and the array of each sensor with numpy.savez,"
    " then: huddle import FILE.npz --out NEW.h5; recordings of huddle: huddle estimate",
}
"""Files that are not read, by their first bytes, and what can be done with them."""

Stream: TypeAlias = Any  # ObsPy has no types


def load_obspy() -> Any:  # noqa: ANN401 - ObsPy has no types
    """Import ObsPy.

    Raises
    ------
    ImportFormatError
        It is not installed.
    """
    return load("ObsPy", reads="this format is", extra="formats")


def waveform_format(path: Path) -> str:
    """Return ObsPy's name for the format of a file.

    ObsPy must not try all its formats: one of them is a pickle, which runs what it holds, and some
    open other files that are named in the first.

    Raises
    ------
    ImportFormatError
        If it is none of `FORMATS`.
    """
    for name in FORMATS:
        for found in entry_points(group=f"obspy.plugin.waveform.{name}", name="isFormat"):
            if found.load()(str(path)):
                return name
    known = ", ".join(FORMATS)
    raise ImportFormatError(
        f"unknown format; expected one of {known}. Rows of text are read from files called"
        f" {path.stem}.csv"
    )


def _refuse_others(path: Path) -> None:
    """Raise ImportFormatError, with what to do, for files without samples that are read."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if any(mark in head for mark in _RESPONSES):
        raise ImportFormatError("it holds responses, no samples; give it with --response")
    for mark, what in _OTHERS.items():
        if head.startswith(mark):
            raise ImportFormatError(what.replace("FILE", path.stem))


def waveform_part(path: Path) -> ReadPart:
    """Return a file as one part."""
    _refuse_others(path)
    load_obspy()
    return ReadPart(path, _read)


def _read(path: Path) -> list[Trace]:
    obspy = load_obspy()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            source: Any = _sac_with_ones(path)
            name = waveform_format(path) if source is None else "SAC"
            source = source or glob.escape(str(path))
            stream = obspy.read(source, format=name, check_compression=False)
            return _traces(stream, path.stem, numbered=name in _NUMBERED)
    except ImportFormatError as error:
        raise ImportFormatError(f"{path}: {error}") from error
    except Exception as error:
        raise ImportFormatError(f"{path}: ObsPy cannot read it: {error}") from error


def _sac_with_ones(path: Path) -> io.BytesIO | None:
    """Return a SAC file whose logicals are -1 where they are true, as some programs write, with 1.

    ObsPy takes these for no SAC files.
    """
    with path.open("rb") as file:
        head = bytearray(file.read(_SAC_HEADER))
        versions = [head[304:308], head[307:303:-1]]
        if b"\x06\0\0\0" not in versions or head[_LEVEN : _LEVEN + 4] != _MINUS_ONE:
            return None
        one = (1).to_bytes(4, "little" if head[304] else "big")
        for at in _SAC_LOGICALS:
            if head[at : at + 4] == _MINUS_ONE:
                head[at : at + 4] = one
        return io.BytesIO(bytes(head) + file.read())


def stream_part(stream: Stream, source: str) -> ReadPart:
    """Return the traces of a stream that is in memory."""
    traces = _traces(stream, source, numbered=False)
    return ReadPart(Path(source), lambda _: traces)


def _traces(stream: Stream, fallback: str, *, numbered: bool) -> list[Trace]:
    found = []
    for number, trace in enumerate(stream, start=1):
        stats = trace.stats
        codes = [str(stats[each]).strip() for each in ("network", "station", "location")]
        codes = [code for code in codes if code]
        sensor = str(number) if numbered else ".".join(codes) or fallback
        found.append(
            Trace(
                sensor=sensor,
                channel="1" if numbered else stats.channel.strip() or str(number),
                start_ns=int(stats.starttime.ns),
                sampling_rate=float(stats.sampling_rate),
                samples=np.asarray(trace.data),
                unit=_unit(stats),
                fdsn=bool(codes) and not numbered,
                calibration=_calibration(stats),
            )
        )
    return found


_DERIVATIVES = {"'DISP'": 0, "'VEL'": 1, "'ACC'": 2}
_CORRECTIONS = ("remove_response(", "remove_sensitivity(", "simulate(")


def is_corrected(stats: Any) -> bool:  # noqa: ANN401 - ObsPy has no types
    """Tell whether ObsPy has taken a response out of a trace."""
    done = stats.get("processing", ())
    return any(correction in step for step in done for correction in _CORRECTIONS)


def _unit(stats: Any) -> str:  # noqa: ANN401 - ObsPy has no types
    """Return the unit that a trace has since its response was removed, as ObsPy notes; or none."""
    found: int | None = None
    for step in stats.get("processing", ()):
        if "remove_response(" in step:
            output = re.search(r"output=('\w+')", step)
            found = _DERIVATIVES.get(output[1] if output else "")
        elif found is not None:
            found += ("differentiate(" in step) - ("integrate(" in step)
    return {0: "m", 1: "m/s", 2: "m/s²"}.get(-1 if found is None else found, "")


def _calibration(stats: Any) -> ForeignCalibration | None:  # noqa: ANN401 - ObsPy has no types
    """Return what the header of a trace says a count is; None where that is unknown."""
    kind = str(stats.get("_format", ""))
    found = None
    if kind == "KNET":
        found = ForeignCalibration.of_count(float(stats.calib), "m/s²", "scale factor of K-NET")
    elif kind == "KINEMETRICS_EVT":
        found = _kinemetrics(stats.kinemetrics_evt)
    elif kind == "GSE2":
        found = _gse2(float(stats.calib), float(stats.gse2.calper), str(stats.gse2.instype))
    elif kind == "SEG2" and "DESCALING_FACTOR" in stats.seg2:
        stacked = str(stats.seg2.get("STACK", "1")).strip()
        origin = "descaling factor of SEG-2, at the receiver"
        origin += "" if stacked in {"", "1"} else f"; a stack of {stacked}"
        found = ForeignCalibration.of_count(1e-3 * float(stats.calib), "V", origin)
    elif kind == "REFTEK130":
        found = _reftek(stats.reftek130)
    elif kind == "SAC" and float(stats.sac.get("scale", 1.0)) not in {0.0, 1.0}:
        origin = (
            f"SCALE {float(stats.sac.scale):g} of SAC not taken: counts per unit, or units per"
            " count; expected --response or --bench"
        )
        found = ForeignCalibration(1.0, "counts", origin)
    return found


def _reftek(header: Any) -> ForeignCalibration | None:  # noqa: ANN401 - see above
    """Return V of a count, from the bit weight at unity gain; at others files do not agree."""
    number = int(header.channel_number)
    weight = str(header.channel_true_bit_weights[number] or "").split()
    if str(header.channel_gain_code[number]).strip() != "1" or len(weight) != 2:
        return None
    try:
        size = float(weight[0]) * _VOLTS[weight[1].lower()]
    except (KeyError, ValueError):
        return None
    return ForeignCalibration.of_count(size, "V", "bit weight of RefTek 130, at the digitizer")


def _kinemetrics(header: Any) -> ForeignCalibration | None:  # noqa: ANN401 - see above
    """Return m/s² of a count, from V of full scale (23 bits and sign) and V per g of the sensor."""
    full_scale, per_g = float(header.chan_fullscale), float(header.chan_sensitivity)
    if not full_scale or not per_g:
        return None
    return ForeignCalibration.of_count(
        full_scale / _EVT_FULL_SCALE / per_g * STANDARD_GRAVITY,
        "m/s²",
        "full scale and sensitivity of Kinemetrics EVT",
        model=str(header.instrument),
        serial_number=str(header.serialnumber),
    )


def _gse2(calib: float, period: float, model: str) -> ForeignCalibration | None:
    """Return the calibration of nm in a count at a period; 1 at 1 s is what writers put by default.

    In velocity: what seismometers are flat in.
    """
    if period <= 0 or (calib, period) == (1.0, 1.0):
        return None
    origin = f"CALIB of GSE2, known at {period:g} s and taken as flat in velocity"
    velocity = 1e-9 * calib * 2 * math.pi / period
    return ForeignCalibration.of_count(velocity, "m/s", origin, model=model.strip())
