"""miniSEED, and other waveform formats that ObsPy reads.

A sensor is ``network.station.location``, its channels are the channel codes in alphabetical order.
Samples exist where all channels of a sensor have them; the rest is a gap.
"""

from __future__ import annotations

import glob
import warnings
from functools import reduce
from importlib.metadata import entry_points
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import NS_PER_S, ForeignSensor, Stretch

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

_SAME_INSTANT = 0.1  # of a sample: channels of one sensor may differ by this much

FORMATS = (
    *("MSEED", "SAC", "GSE2", "GSE1", "SLIST", "TSPAIR", "SEGY", "SEG2", "WAV", "KNET"),
    *("KINEMETRICS_EVT", "REFTEK130", "AH", "GCF"),
)
"""Waveform formats that are read, by ObsPy's names, in the order in which they are tried."""

Interval: TypeAlias = tuple[int, int]
Trace: TypeAlias = Any  # ObsPy has no types
Stream: TypeAlias = Any


def load_obspy() -> Any:  # noqa: ANN401 - ObsPy has no types
    """Import ObsPy.

    Raises
    ------
    ImportFormatError
        It is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its own, about importlib.metadata
            import obspy  # noqa: PLC0415 - takes 0.2 s, and is an extra
    except ImportError as error:
        raise ImportFormatError(
            "this format is read by ObsPy, which is not installed; "
            "run: pip install 'huddle-bench[formats]'"
        ) from error
    return obspy


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
    raise ImportFormatError(f"unknown format; expected one of {known}, not compressed")


def read_waveforms(paths: Sequence[Path]) -> tuple[ForeignSensor, ...]:
    """Read the sensors of miniSEED files (or of others that ObsPy knows), together.

    Raises
    ------
    ImportFormatError
        ObsPy is absent or cannot read a file; channels of one sensor differ in rate or in the
        instants of their samples, or overlap with different samples; channels without samples in
        common.
    """
    obspy = load_obspy()
    stream = obspy.Stream()
    for path in paths:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                stream += obspy.read(
                    glob.escape(str(path)), format=waveform_format(path), check_compression=False
                )
        except Exception as error:
            raise ImportFormatError(f"{path}: ObsPy cannot read it: {error}") from error
    return sensors_of(stream, ", ".join(path.name for path in paths))


def sensors_of(stream: Stream, source: str) -> tuple[ForeignSensor, ...]:
    """Return the sensors of a stream, which is changed.

    Raises
    ------
    ImportFormatError
        As `read_waveforms`.
    """
    stream.merge(method=-1)  # joins what continues; drops repetitions
    of_sensor: dict[str, dict[str, list[Trace]]] = {}
    for trace in stream:
        name = ".".join(
            part
            for part in (trace.stats.network, trace.stats.station, trace.stats.location)
            if part
        )
        of_sensor.setdefault(name, {}).setdefault(trace.stats.channel, []).append(trace)
    return tuple(
        _sensor(name, dict(sorted(channels.items())), source)
        for name, channels in sorted(of_sensor.items())
    )


def _sensor(name: str, channels: dict[str, list[Trace]], source: str) -> ForeignSensor:
    rates = {float(trace.stats.sampling_rate) for traces in channels.values() for trace in traces}
    if len(rates) != 1:
        raise ImportFormatError(
            f"sensor {name}: expected one sampling rate for its channels "
            f"{', '.join(channels)}; found {', '.join(f'{rate:g} Hz' for rate in sorted(rates))}"
        )
    rate = rates.pop()
    origin = min(trace.stats.starttime.ns for traces in channels.values() for trace in traces)
    placed = {
        code: sorted(((_index(t, origin, rate), t) for t in traces), key=lambda pair: pair[0])
        for code, traces in channels.items()
    }
    for code, pieces in placed.items():
        for (first, trace), (following, _) in pairwise(pieces):
            if first + trace.stats.npts > following:
                raise ImportFormatError(
                    f"sensor {name}, channel {code}: records overlap at "
                    f"{trace.stats.endtime} and differ there"
                )
    covered = [
        [(first, first + int(trace.stats.npts)) for first, trace in pieces]
        for pieces in placed.values()
    ]
    stretches = tuple(
        _stretch(interval, list(placed.values())) for interval in reduce(_intersection, covered)
    )
    if not stretches:
        raise ImportFormatError(
            f"sensor {name}: its channels {', '.join(channels)} have no samples in common"
        )
    return ForeignSensor(name, tuple(channels), rate, stretches, source)


def _index(trace: Trace, origin: int, rate: float) -> int:
    """Return the place of a trace's first sample on its sensor's grid."""
    return round(float(trace.stats.starttime.ns - origin) * rate / NS_PER_S)


def _intersection(a: Iterable[Interval], b: Sequence[Interval]) -> list[Interval]:
    """Return what two lists of intervals have in common, in order."""
    common = [
        (max(first, other_first), min(end, other_end))
        for first, end in a
        for other_first, other_end in b
    ]
    return sorted(interval for interval in common if interval[0] < interval[1])


def _stretch(interval: Interval, pieces: list[list[tuple[int, Trace]]]) -> Stretch:
    first, end = interval
    columns, instants = [], []
    for placed in pieces:
        at, trace = next(
            (at, trace) for at, trace in placed if at <= first and end <= at + trace.stats.npts
        )
        columns.append(np.asarray(trace.data)[first - at : end - at])
        ns_per_sample = NS_PER_S / trace.stats.sampling_rate
        instants.append(trace.stats.starttime.ns + round((first - at) * ns_per_sample))
    if (max(instants) - min(instants)) > _SAME_INSTANT * ns_per_sample:
        raise ImportFormatError(
            f"{placed[0][1].id}: sampled {(max(instants) - min(instants)) / NS_PER_S:.6f} s apart "
            f"from other channels of its sensor; expected the same instants"
        )
    return Stretch(instants[0], np.stack(columns, axis=1))
