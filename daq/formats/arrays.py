"""Arrays of samples, as scripts and notebooks have them, as a recording that no file holds.

A sensor is an array ``(n_samples, n_channels)`` or ``(n_samples,)``, an xarray DataArray, or an
ObsPy Stream or Trace. Samples that are not finite are gaps. Neither xarray nor ObsPy is imported:
who passes their objects has imported them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daq.caveats import NO_CAVEATS
from daq.errors import ArrayError
from daq.formats.foreign_sensor import NS_PER_S, ForeignSensor, Stretch, finite_stretches
from daq.formats.memory import RecordingInMemory, SensorInMemory
from daq.formats.readers.waveforms import is_corrected, stream_part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.formats.response import Responses

    Samples: TypeAlias = NDArray[Any]

NAME = "arrays"
"""What messages call a recording made of arrays."""
COUNTS = "counts"
TIME = "time"
"""Dimension of a DataArray along which samples follow each other."""
SENSOR = "sensor"
"""Dimension of a DataArray of all sensors along which sensors follow each other."""
_SAME_RATE = 1e-4  # by which a stated rate may differ from that of the time coordinate
_EVEN = 0.1  # samples by which a time coordinate may be off an even one


@dataclass(frozen=True, slots=True)
class _Sensor:
    """One sensor as it was given.

    Attributes
    ----------
    foreign : ForeignSensor
    n_samples : int
        Those that are not finite included.
    unit : str
        Of the samples; empty where the array does not say.
    timed : bool
        Whether the array says when its samples were taken.
    """

    foreign: ForeignSensor
    n_samples: int
    unit: str
    timed: bool


def recording_of_arrays(
    sensors: object,
    sampling_rate: object = None,
    *,
    channels: Sequence[str] | None = None,
    unit: str | None = None,
    responses: Responses | None = None,
) -> RecordingInMemory:
    """Return a recording of samples that are in memory; they are not copied.

    Parameters
    ----------
    sensors : mapping of str to array, array, DataArray, DataFrame or ObsPy Stream
        Samples of each sensor by its name. An array as a whole has the axes sensor, time and
        channel; a DataFrame as a whole has columns of two levels, sensor and channel; a Stream as
        a whole holds one sensor for each network, station and location.
    sampling_rate : float or mapping of str to float, optional
        In Hz; not needed where the arrays have times.
    channels : sequence of str, optional
        Names of the channels, the same for every sensor; "1", "2", … if not given.
    unit : str, optional
        Unit of the samples, whatever the arrays say. Where it is not given and the array does not
        say either, samples are counts.
    responses : Responses, optional
        Responses of the channels, by code and date.

    Raises
    ------
    ArrayError
        With the sensor, what was given and what was expected.
    ImportFormatError
        If the traces of one sensor do not fit together, or a channel has no response.
    """
    given = _sensors(sensors, sampling_rate, channels)
    _check_together(given)
    in_memory = [_in_memory(each, unit, responses) for each in given]
    return RecordingInMemory(in_memory, NAME, caveats=getattr(sensors, "caveats", NO_CAVEATS))


def _sensors(sensors: object, rate: object, channels: Sequence[str] | None) -> list[_Sensor]:
    if _is_stream(sensors):
        found = _of_stream(sensors)
        return [_of_traces(foreign, rate, channels) for foreign in found]
    if not isinstance(sensors, Mapping):
        sensors = _by_sensor(sensors)
    if not sensors:
        raise ArrayError("sensors: an empty dictionary; expected an array for each sensor")
    return [_sensor(name, value, rate, channels) for name, value in sensors.items()]


def _by_sensor(whole: Any) -> Mapping[Any, Any]:  # noqa: ANN401 - whatever it is
    """Return the samples of each sensor of an array, DataArray or DataFrame of all."""
    if _is_data_array(whole) and SENSOR in whole.dims and SENSOR in whole.coords:
        names = [str(name) for name in whole.coords[SENSOR].values]
        if len(set(names)) == len(names):
            return {
                name: whole.isel({SENSOR: number}, drop=True) for number, name in enumerate(names)
            }
    if _is_frame(whole) and getattr(whole.columns, "nlevels", 1) == 2:
        return {name: whole[name] for name in dict.fromkeys(whole.columns.get_level_values(0))}
    if isinstance(whole, np.ndarray) and whole.ndim == 3:
        return {str(number): each for number, each in enumerate(whole, start=1)}
    raise ArrayError(
        f"sensors: {_described(whole)}; expected a dictionary of arrays by the name of the"
        ' sensor, as in {"A": a, "B": b, "C": c}, an array (sensor, time, channel), a DataArray'
        f" with a coordinate {SENSOR!r}, or a DataFrame with columns of two levels, sensor and"
        " channel"
    )


def _is_data_array(value: Any) -> bool:  # noqa: ANN401 - whatever it is
    return hasattr(value, "dims") and hasattr(value, "coords")


def _is_frame(value: Any) -> bool:  # noqa: ANN401 - whatever it is
    """Whether a value is a DataFrame or Series."""
    return hasattr(value, "index") and hasattr(value, "to_numpy")


def _of_frame(
    frame: Any,  # noqa: ANN401 - of pandas
) -> tuple[Samples, Samples | None, Sequence[str] | None, str]:
    """Return samples, times of a DatetimeIndex, names of the channels, and the unit."""
    index = frame.index.to_numpy()
    if hasattr(frame.index, "tz_convert") and frame.index.tz is not None:
        index = frame.index.tz_convert("UTC").tz_localize(None).to_numpy()
    labels = [str(label) for label in frame.columns] if hasattr(frame, "columns") else None
    times = index if index.dtype.kind in "mM" else None
    return frame.to_numpy(), times, labels, str(frame.attrs.get("units", ""))


def _sensor(name: object, value: Any, rate: object, channels: Sequence[str] | None) -> _Sensor:  # noqa: ANN401 - whatever it is
    if not isinstance(name, str) or not name.strip():
        raise ArrayError(f"sensor {name!r}: expected a name, as a text that is not empty")
    if isinstance(rate, Mapping):
        if name not in rate:
            raise ArrayError(f"fs: no sampling rate of sensor {name!r}; expected one for each")
        rate = rate[name]
    if _is_stream(value):
        found = _of_stream(value)
        if len(found) != 1:
            listed = ", ".join(foreign.name for foreign in found) or "none"
            raise ArrayError(
                f"sensor {name!r}: a Stream with traces of {len(found)} sensors ({listed});"
                " expected those of one, or one Stream of all in place of the dictionary"
            )
        return _of_traces(replace(found[0], name=name), rate, channels)
    times = None
    names, unit = channels, ""
    if _is_data_array(value) or _is_frame(value):
        described = _of_data_array(name, value) if _is_data_array(value) else _of_frame(value)
        value, times, labels, unit = described
        names = labels if channels is None else channels
    samples = _samples(name, value)
    start_utc_ns, found_rate = (0, None) if times is None else _lattice(name, times)
    known = _rate(name, rate, found_rate)
    names = _channel_names(name, samples.shape[1], names)
    stretches = finite_stretches(samples, start_utc_ns=start_utc_ns, sampling_rate=known)
    foreign = ForeignSensor(name, names, known, _not_empty(name, stretches), NAME)
    return _Sensor(foreign, len(samples), unit, times is not None)


def _samples(name: str, value: object) -> Samples:
    """Return samples of shape (n_samples, n_channels)."""
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.filled(value.astype(np.float64), np.nan) if value.mask.any() else value.data
    try:
        samples = np.asarray(value)
    except ValueError as error:  # rows of several lengths
        raise ArrayError(
            f"sensor {name!r}: {_described(value)}; expected numbers of shape"
            f" (n_samples, n_channels): {error}"
        ) from error
    if samples.dtype.kind not in "iuf":
        raise ArrayError(
            f"sensor {name!r}: {samples.dtype} samples; expected real numbers (integers or floats)"
        )
    shape = samples.shape
    if samples.ndim == 1:
        samples = samples[:, np.newaxis]
    if samples.ndim != 2 or 0 in samples.shape:
        raise ArrayError(
            f"sensor {name!r}: an array of shape {shape}; expected"
            " (n_samples, n_channels), or (n_samples,) for one channel"
        )
    if samples.shape[1] > samples.shape[0]:
        raise ArrayError(
            f"sensor {name!r}: {samples.shape[0]} samples of {samples.shape[1]} channels; expected"
            f" (n_samples, n_channels): pass the transposed array, {name}.T"
        )
    return samples


def _of_data_array(
    name: str,
    array: Any,  # noqa: ANN401 - an xarray DataArray
) -> tuple[Samples, Samples | None, Sequence[str] | None, str]:
    """Return samples, their times, names of the channels, and the unit, as far as there are any."""
    others = [dim for dim in array.dims if dim != TIME]
    if TIME not in array.dims or len(others) > 1:
        raise ArrayError(
            f"sensor {name!r}: a DataArray with dimensions {tuple(array.dims)}; expected"
            f" {TIME!r} and at most one more, of the channels"
        )
    array = array.transpose(TIME, *others)
    times = np.asarray(array.coords[TIME].values) if TIME in array.coords else None
    labels = None
    if others and others[0] in array.coords:
        labels = [str(label) for label in array.coords[others[0]].values]
    return np.asarray(array.values), times, labels, str(array.attrs.get("units", ""))


def _lattice(name: str, times: Samples) -> tuple[int, float]:
    """Return the time of the first sample in ns, and the sampling rate in Hz."""
    if len(times) < 2:
        raise ArrayError(f"sensor {name!r}: {len(times)} samples; expected at least two")
    if times.dtype.kind in "mM":
        ns = times.astype(f"{times.dtype.kind}8[ns]").astype(np.int64)
        seconds, start = (ns - ns[0]) / NS_PER_S, int(ns[0])
    elif times.dtype.kind in "iuf":
        seconds, start = np.asarray(times - times[0], np.float64), round(float(times[0]) * NS_PER_S)
    else:
        raise ArrayError(f"sensor {name!r}: times of type {times.dtype}; expected times or seconds")
    interval = float(seconds[-1]) / (len(times) - 1)
    off = np.abs(seconds - interval * np.arange(len(times)))
    if not interval > 0 or not float(off.max()) <= _EVEN * interval:
        steps = np.diff(seconds)
        raise ArrayError(
            f"sensor {name!r}: times with steps of {steps.min():g} to {steps.max():g} s; expected"
            " even ones: put NaN where samples are missing (reindex), or interpolate"
        )
    return start, 1.0 / interval


def _rate(name: str, stated: object, found: float | None) -> float:
    """Return the sampling rate in Hz."""
    if stated is None:
        if found is None:
            raise ArrayError(f"fs: no sampling rate of sensor {name!r}; expected it in Hz (fs=200)")
        return found
    is_number = isinstance(stated, (int, float, np.integer, np.floating))
    if not is_number or isinstance(stated, bool) or not 0 < float(stated) < math.inf:  # type: ignore[arg-type]  # is_number
        raise ArrayError(f"fs={stated!r}: expected a sampling rate in Hz, above 0")
    rate = float(stated)  # type: ignore[arg-type]  # is_number
    if found is not None and abs(found / rate - 1) > _SAME_RATE:
        raise ArrayError(
            f"fs={rate:g}: the times of sensor {name!r} are {found:g} Hz; expected the same rate,"
            " or no fs"
        )
    return rate


def _channel_names(sensor: str, n: int, names: Sequence[str] | None) -> tuple[str, ...]:
    if names is None:
        return tuple(str(number) for number in range(1, n + 1))
    if len(names) != n or len(set(names)) != n:
        raise ArrayError(
            f"channels: {', '.join(map(str, names))}; expected {n} names that differ, as sensor"
            f" {sensor!r} has {n} channel{'s' if n > 1 else ''}"
        )
    return tuple(map(str, names))


def _not_empty(name: str, stretches: tuple[Stretch, ...]) -> tuple[Stretch, ...]:
    if not stretches:
        raise ArrayError(f"sensor {name!r}: no finite sample; expected numbers that are not NaN")
    return stretches


def _is_stream(value: Any) -> bool:  # noqa: ANN401 - whatever it is
    """Whether a value is an ObsPy Stream or Trace, or a list of Traces."""
    if isinstance(value, (list, tuple)):
        return bool(value) and all(hasattr(each, "stats") for each in value)
    return hasattr(value, "traces") or hasattr(value, "stats")


def _of_stream(value: Any) -> tuple[ForeignSensor, ...]:  # noqa: ANN401 - ObsPy has no types
    """Return the sensors of a Stream, Trace, or list of Traces; masked samples are gaps."""
    from daq.formats.sources import sensors_of_parts  # noqa: PLC0415 - for those who need it

    traces = [value] if hasattr(value, "stats") else value
    whole = [part for each in traces for part in each.split()]
    return sensors_of_parts([stream_part(whole, NAME)])


def _of_traces(foreign: ForeignSensor, rate: object, channels: Sequence[str] | None) -> _Sensor:
    name = foreign.name
    if isinstance(rate, Mapping):
        rate = rate.get(name)
    known = _rate(name, rate, foreign.sampling_rate)
    names = foreign.channels
    if channels is not None:
        names = _channel_names(name, len(foreign.channels), channels)
    whole = replace(foreign, sampling_rate=known, channels=names)
    return _Sensor(whole, sum(each.n_samples for each in whole.stretches), "", timed=True)


def attached_responses(sensors: Any) -> dict[str, Any]:  # noqa: ANN401 - whatever it is
    """Return the responses of ObsPy that traces carry, by sensor and channel.

    Those of traces from which one was removed do not count.
    """
    given = (
        {"": sensors} if _is_stream(sensors) else sensors if isinstance(sensors, Mapping) else {}
    )
    found = {}
    for name, stream in given.items():
        if not _is_stream(stream):
            continue
        for trace in [stream] if hasattr(stream, "stats") else stream:
            stats = trace.stats
            if stats.get("response") is not None and not is_corrected(stats):
                (known,) = stream_part([trace], NAME).load()
                found[f"{name or known.sensor}.{known.channel}"] = stats.response
    return found


def _check_together(given: Sequence[_Sensor]) -> None:
    """Refuse arrays that were not sampled together."""
    timed = [each.foreign.name for each in given if each.timed]
    untimed = [each for each in given if not each.timed]
    if timed and untimed:
        raise ArrayError(
            f"sensor {timed[0]!r} has times, {untimed[0].foreign.name!r} has none; expected all"
            " sensors with times, or none"
        )
    longest = max(untimed, key=_duration, default=None)
    for each in untimed:
        if longest and (_duration(longest) - _duration(each)) * each.foreign.sampling_rate >= 1:
            raise ArrayError(
                f"sensor {each.foreign.name!r} has {each.n_samples} samples,"
                f" {_duration(each):g} s, and {longest.foreign.name!r} has {longest.n_samples},"
                f" {_duration(longest):g} s; expected equal lengths: cut all to the same span, or"
                " pass arrays with times"
            )


def _duration(given: _Sensor) -> float:
    return given.n_samples / given.foreign.sampling_rate


def _in_memory(given: _Sensor, unit: str | None, responses: Responses | None) -> SensorInMemory:
    foreign = given.foreign
    channels = foreign.own_channels(unit or given.unit)
    for number, channel in enumerate(channels if responses else ()):
        known = responses and responses.of(foreign.name, channel.name, foreign.dated_spans_ns())
        if known:
            channels[number] = known.applied_to(channel)
    return SensorInMemory(foreign, tuple(channels))


def _described(value: object) -> str:
    shape = getattr(value, "shape", None)
    kind = type(value).__name__
    return f"a {kind} of shape {shape}" if shape is not None else f"a {kind}"
