"""Time responses of universal files (UFF 58), read by pyuff, and WAV files, read by scipy.

In a universal file a node is a sensor, named by its entity if there is one; its channels are the
directions X, Y, Z; the unit is that of the label, or else follows from the data type and the units
of data set 164; the third line of identification is the date, if it is one. In a WAV file the file
is a sensor, its channels are numbered; it has no date.
24-bit samples of WAV files are in the upper bits of 32, as scipy returns them.

TDMS of National Instruments, read by npTDMS.

A group is a sensor, its channels are the channels. Start, interval and unit are properties of the
channels (``wf_start_time``, ``wf_increment``, ``unit_string``). A file is read in parts of equally
many samples of every channel.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import NS_PER_S, ForeignCalibration, ForeignSensor, finite_stretches
from daq.formats.readers.packages import load
from daq.formats.traces import Trace, TracePart

_SAMPLES = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class TdmsPart(TracePart):
    """Samples of all channels of a file, from one to another; npTDMS reads no pieces of these."""

    first: int
    end: int
    sampling_rate: float | None

    def load(self) -> list[Trace]:
        """Read the samples."""
        nptdms = load("npTDMS", reads="TDMS is", extra="vibration")
        try:
            with nptdms.TdmsFile.open(self.path) as file:
                return [
                    self._trace(group.name, channel)
                    for group in file.groups()
                    for channel in group.channels()
                    if self.first < len(channel)
                ]
        except ImportFormatError:
            raise
        except Exception as error:
            raise ImportFormatError(f"{self.path}: npTDMS cannot read it: {error}") from error

    def _trace(self, group: str, channel: Any) -> Trace:  # noqa: ANN401 - see above
        properties = channel.properties
        interval = float(properties.get("wf_increment") or 0)
        rate = 1 / interval if interval > 0 else self.sampling_rate
        if not rate:
            raise ImportFormatError(
                f"{self.path}: channel {channel.name!r} has no wf_increment; expected the time"
                " between samples: give --sampling-rate"
            )
        samples = np.asarray(channel[self.first : self.end])
        if samples.dtype.kind not in "iuf":
            raise ImportFormatError(
                f"{self.path}: channel {channel.name!r}: {samples.dtype} samples; expected numbers"
            )
        start = np.datetime64(properties.get("wf_start_time", np.datetime64(0, "ns")), "ns")
        offset = float(properties.get("wf_start_offset") or 0) + self.first / rate
        return Trace(
            sensor=group.replace("/", "_"),  # Dev1/ai0: recordings have no / in names
            channel=channel.name.replace("/", "_"),
            start_ns=int(start.astype(np.int64)) + round(offset * NS_PER_S),
            sampling_rate=rate,
            samples=samples,
            unit=str(properties.get("unit_string") or properties.get("NI_UnitDescription") or ""),
        )


def tdms_parts(path: Path, sampling_rate: float | None) -> Iterator[TdmsPart]:
    """Yield the parts of a file.

    Raises
    ------
    ImportFormatError
        npTDMS is not installed, or cannot read the file.
    """
    nptdms = load("npTDMS", reads="TDMS is", extra="vibration")
    try:
        with nptdms.TdmsFile.open(path) as file:
            n_samples = max((len(c) for g in file.groups() for c in g.channels()), default=0)
    except Exception as error:
        raise ImportFormatError(f"{path}: npTDMS cannot read it: {error}") from error
    if n_samples == 0:
        raise ImportFormatError(f"{path}: no samples in it; expected a channel for each axis")
    for first in range(0, n_samples, _SAMPLES):
        yield TdmsPart(path, first, first + _SAMPLES, sampling_rate)


_FUNCTION = 58
_UNITS = 164
_TIME_RESPONSE = 1
_EVEN = 1
_DIRECTIONS = {0: "S", 1: "X", 2: "Y", 3: "Z", 4: "RX", 5: "RY", 6: "RZ"}
_QUANTITIES = {8: "m", 11: "m/s", 12: "m/s²"}
"""By the ordinate's specific data type: displacement, velocity, acceleration."""
_UINT8_ZERO = 128
_LOGGER = logging.getLogger(__name__)


def read_uff(path: Path) -> list[Trace]:
    """Read the time responses of a universal file.

    Raises
    ------
    ImportFormatError
        pyuff is not installed or cannot read the file, or it holds no time response.
    """
    pyuff = load("pyuff", reads="universal files are", extra="vibration")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            file = pyuff.UFF(str(path))
            kinds = [int(kind) for kind in file.get_set_types()]
            numbers = [n for n, kind in enumerate(kinds) if kind == _FUNCTION]
            sets = [file.read_sets(number) for number in numbers]
            length = 1.0
            if _UNITS in kinds:
                length = float(file.read_sets(kinds.index(_UNITS))["length"])
            responses = [each for each in sets if int(each["func_type"]) == _TIME_RESPONSE]
            traces = [_trace(each, length) for each in responses]
    except Exception as error:
        raise ImportFormatError(f"{path}: pyuff cannot read it: {error}") from error
    if not traces:
        raise ImportFormatError(
            f"{path}: {len(numbers)} functions, none of them a time response; expected data set 58"
            " with function type 1"
        )
    return traces


def _trace(function: dict[str, Any], length: float) -> Trace:
    """Return a function as a trace; values of its unit system are `length` in a metre."""
    interval = float(function.get("abscissa_inc") or 0)
    if int(function.get("abscissa_spacing", _EVEN)) != _EVEN or interval <= 0:
        raise ValueError(f"an interval of {interval} s; expected evenly spaced samples")
    entity = str(function.get("rsp_ent_name") or "").strip()
    node, direction = str(function["rsp_node"]), int(function["rsp_dir"])
    name = f"{entity}.{node}" if entity and entity != "NONE" else node
    axis = _DIRECTIONS.get(abs(direction), str(direction))
    unit = str(function.get("ordinate_axis_units_lab") or "").strip()
    unit = "" if unit.upper() == "NONE" else unit
    calibration = None
    if not unit:
        quantity = _QUANTITIES.get(int(function.get("ordinate_spec_data_type") or 0), "")
        if length == 1:
            unit = quantity
        elif quantity and length > 0:
            origin = f"data type of UFF 58, with {length:g} length units in a metre of UFF 164"
            calibration = ForeignCalibration(length, quantity, origin)
    after = round(float(function.get("abscissa_min") or 0) * NS_PER_S)
    return Trace(
        sensor=name,
        channel=f"-{axis}" if direction < 0 else axis,
        start_ns=_date(str(function.get("id3") or "")) + after,
        sampling_rate=_rate(interval),
        samples=np.asarray(function["data"]),
        unit=unit,
        calibration=calibration,
    )


def _date(text: str) -> int:
    """Return the date of a function in ns, as written in 28-NOV-26 03:00:00; 0 if there is none."""
    try:
        found = datetime.strptime(text.strip(), "%d-%b-%y %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return 0
    return int(found.timestamp()) * NS_PER_S


def _rate(interval: float) -> float:
    """Return the rate of an interval that is written with six digits."""
    nearest = round(1 / interval)
    if nearest and f"{1 / nearest:.5e}" == f"{interval:.5e}":
        return float(nearest)
    return 1 / interval


def read_wav(path: Path, sampling_rate: float | None = None) -> tuple[ForeignSensor, ...]:
    """Read a WAV file; it has its own ``sampling_rate``.

    Raises
    ------
    ImportFormatError
        It is none.
    """
    from scipy.io import wavfile  # noqa: PLC0415 - takes long

    del sampling_rate
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about chunks that hold no samples
            rate, samples = wavfile.read(path)
    except Exception as error:  # of any kind, on damaged files
        raise ImportFormatError(f"{path}: {_wav_fault(path, str(error))}") from error
    samples = samples[:, np.newaxis] if samples.ndim == 1 else samples
    if samples.dtype == np.uint8:
        samples = samples.astype(np.int16) - _UINT8_ZERO
    stretches = finite_stretches(samples, start_utc_ns=0, sampling_rate=float(rate))
    if not stretches:
        raise ImportFormatError(f"{path}: no samples in it")
    with path.open("rb") as file:
        head = file.read(8)
    n_bytes = 8 + int.from_bytes(head[4:], "little")
    if head[:4] == b"RIFF" and path.stat().st_size < n_bytes:
        _LOGGER.warning(
            "%s: ends after %d samples, before its header says: cut off, or written to a pipe",
            path,
            len(samples),
        )
    channels = tuple(str(number) for number in range(1, samples.shape[1] + 1))
    return (ForeignSensor(path.stem, channels, float(rate), stretches, str(path)),)


def _wav_fault(path: Path, error: str) -> str:
    """Return why a file is no WAV file that can be read."""
    with path.open("rb") as file:
        head = file.read(12)
    if head[:4] not in {b"RIFF", b"RIFX", b"RF64"} or head[8:12] != b"WAVE":
        return "not a WAV file: it does not begin with RIFF, its length, and WAVE"
    found = re.search(r"Unknown wave file format: (\w+)", error)
    if found is not None:
        return f"WAV samples of format {found[1]}; expected PCM or floating-point samples"
    return "the WAV file is damaged or cut off; copy the file again"
