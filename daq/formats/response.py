"""Instrument responses from RESP and StationXML, read by ObsPy.

Only what an estimate needs is taken: the product of all analog poles-and-zeros stages and the
product of all gains. Digital filters are left out: they are flat where noise is estimated, and
their delay is already taken out of the times that digitizers write.

A file may hold several epochs of a channel, in any order. Samples get the response of the epoch in
which they were taken.
"""

from __future__ import annotations

import logging
import math
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.model import PolesZeros
from daq.bench.units import is_motion
from daq.errors import ImportFormatError
from daq.formats.readers.waveforms import load_obspy

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

_LOGGER = logging.getLogger(__name__)
_UNITS = {"m": "m", "m/s": "m/s", "m/s**2": "m/s²", "m/s/s": "m/s²", "m/(s**2)": "m/s²"}
_SAME_UNIT = {"count": "counts", "digits": "counts", "volt": "v", "volts": "v"}
_TOLERANCE = 0.01
"""Share by which the sensitivity of a file may miss the product of its stages."""
_END_OF_TIME_NS = 2**63 - 1
_FAR_NS = 4 * 10**18
"""Ends beyond the year 2096 are written for "not yet"."""
_EDGE_NS = 10**9
"""By which data may begin before their epoch, or end after it: dates are often whole seconds."""


@dataclass(frozen=True, slots=True)
class ChannelResponse:
    """How one channel turns motion into counts: ``counts = sensitivity · H(f) · motion``.

    ``sensitivity`` is in counts per ``unit``; ``shape`` is H, normalised as its file says.
    """

    sensitivity: float
    unit: str
    shape: PolesZeros


@dataclass(frozen=True, slots=True)
class Epoch:
    """The response of a channel from one instant to another, in ns since 1970."""

    start_ns: int
    end_ns: int
    response: ChannelResponse


class Responses:
    """The responses a file holds, by sensor (``network.station.location``) and channel code."""

    def __init__(self, path: Path, by_channel: dict[tuple[str, str], tuple[Epoch, ...]]) -> None:
        self.path = path
        self.by_channel = by_channel

    def of(
        self, sensor: str, channel: str, stretches: Sequence[tuple[int, int]] = ()
    ) -> ChannelResponse:
        """Return the response of a channel; the only one in the file serves all channels.

        Parameters
        ----------
        sensor, channel : str
        stretches : sequence of (int, int)
            Times of the first and the last sample of each stretch of data, in ns since 1970. None
            where the data have no date.

        Raises
        ------
        ImportFormatError
            If the file has no response for this channel at these times, or several.
        """
        epochs = self._epochs(sensor, channel)
        where = f"{self.path}: the response of {sensor}.{channel}"
        if not stretches:
            if len({epoch.response for epoch in epochs}) > 1:
                raise ImportFormatError(
                    f"{where} changes on {', '.join(_date(e.start_ns) for e in epochs[1:])}, and"
                    " the data have no date; expected a response of one epoch, or data with times"
                )
            return epochs[0].response
        found: list[Epoch] = []
        for begin, last in stretches:
            edge = min(_EDGE_NS, (last - begin) // 2)
            start, end = begin + edge, last - edge
            met = [epoch for epoch in epochs if epoch.start_ns <= end and start < epoch.end_ns]
            if not met or met[0].start_ns > start or max(e.end_ns for e in met) < end:
                known = ", ".join(f"{_date(e.start_ns)} to {_date(e.end_ns)}" for e in epochs)
                raise ImportFormatError(
                    f"{where} is known for {known}; expected one for the data, from"
                    f" {_date(begin)} to {_date(last)}"
                )
            found += met
        for epoch in found:
            if epoch.response != found[0].response:
                raise ImportFormatError(
                    f"{where} changes on {_date(epoch.start_ns)}, within the data; import what was"
                    " recorded before and after that date into two recordings"
                )
        return found[0].response

    def _epochs(self, sensor: str, channel: str) -> tuple[Epoch, ...]:
        if len(self.by_channel) == 1:
            return next(iter(self.by_channel.values()))
        try:
            return self.by_channel[sensor, channel]
        except KeyError:
            known = ", ".join(".".join(key) for key in sorted(self.by_channel))
            raise ImportFormatError(
                f"{self.path}: no response for {sensor}.{channel}; it holds {known}"
            ) from None


def read_responses(path: Path) -> Responses:
    """Read a RESP or StationXML file, with all its epochs.

    A sensitivity that misses the product of its stages by one per cent or more is logged.

    Raises
    ------
    ImportFormatError
        ObsPy is absent, or the file holds no response that it understands.
    """
    obspy = load_obspy()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            inventory = obspy.read_inventory(str(path), format=_format(path))
    except Exception as error:
        raise ImportFormatError(
            f"{path}: expected a RESP or StationXML file; ObsPy cannot read it: {error}"
        ) from error
    by_channel: dict[tuple[str, str], list[Epoch]] = {}
    for network in inventory:
        for station in network:
            for channel in station:
                if channel.response is None or not channel.response.response_stages:
                    continue
                name = _joined(network.code, station.code, channel.location_code)
                start = _ns(channel.start_date, 0)
                where = f"{path}: {name}.{channel.code} from {_date(start)}"
                by_channel.setdefault((name, channel.code), []).append(
                    Epoch(
                        start,
                        _ns(channel.end_date, _END_OF_TIME_NS),
                        _channel(where, channel.response),
                    )
                )
    if not by_channel:
        raise ImportFormatError(f"{path}: expected at least one channel with a response")
    return Responses(path, {key: _in_order(epochs) for key, epochs in by_channel.items()})


def _format(path: Path) -> str:
    """Return the name that ObsPy has for this file: what it tries by itself is not limited."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if b"<!DOCTYPE" in head or b"<!ENTITY" in head:
        raise ImportFormatError("it declares entities, which StationXML does not need")
    if b"FDSNStationXML" in head:
        return "STATIONXML"
    if b"B050F03" in head:
        return "RESP"
    raise ImportFormatError("it has neither the element FDSNStationXML nor the field B050F03")


def _in_order(epochs: Iterable[Epoch]) -> tuple[Epoch, ...]:
    """Return epochs by their start; one without an end lasts until the next begins."""
    ordered = sorted(epochs, key=lambda epoch: epoch.start_ns)
    nexts = [epoch.start_ns for epoch in ordered[1:]] + [_END_OF_TIME_NS]
    return tuple(
        Epoch(e.start_ns, min(following, e.end_ns) if _is_open(e) else e.end_ns, e.response)
        for e, following in zip(ordered, nexts, strict=True)
    )


def _is_open(epoch: Epoch) -> bool:
    return epoch.end_ns > _FAR_NS


def _ns(instant: Any, otherwise: int) -> int:  # noqa: ANN401 - ObsPy has no types
    return otherwise if instant is None else min(int(instant.ns), _END_OF_TIME_NS)


def _date(instant_ns: int) -> str:
    if instant_ns > _FAR_NS:
        return "now"
    if instant_ns <= 0:
        return "ever"
    text = datetime.fromtimestamp(instant_ns // 1_000_000_000, tz=UTC).isoformat()
    return text.removesuffix("+00:00").removesuffix("T00:00:00")


def _joined(*codes: str) -> str:
    return ".".join(code for code in codes if code)


def _channel(where: str, response: Any) -> ChannelResponse:  # noqa: ANN401 - ObsPy has no types
    zeros: list[complex] = []
    poles: list[complex] = []
    normalization, frequency = 1.0, 1.0
    _check_units(where, response)
    gains = [stage.stage_gain for stage in response.response_stages]
    for stage in response.response_stages:
        kind = getattr(stage, "pz_transfer_function_type", "")
        if not kind.startswith("LAPLACE"):
            continue
        to_radians = 2 * math.pi if "HERTZ" in kind else 1.0
        stage_zeros = tuple(complex(zero) * to_radians for zero in stage.zeros)
        stage_poles = tuple(complex(pole) * to_radians for pole in stage.poles)
        zeros += stage_zeros
        poles += stage_poles
        frequency = float(stage.normalization_frequency) or frequency
        factor = stage.normalization_factor * to_radians ** (len(stage_poles) - len(stage_zeros))
        normalization *= _at_gain_frequency(stage, stage_zeros, stage_poles, factor)
    stated = response.instrument_sensitivity
    value = None if stated is None or not stated.value else float(stated.value)
    if gains and all(gain is not None for gain in gains):
        sensitivity = math.prod(float(gain) for gain in gains)
        if value is not None and abs(value - sensitivity) >= _TOLERANCE * abs(sensitivity):
            _LOGGER.warning(
                "%s: its sensitivity is %g, the product of its stages %g counts per %s; the stages"
                " are used",
                *(where, value, sensitivity, stated.input_units),
            )
    elif value is not None:
        sensitivity = value
    else:
        raise ImportFormatError(f"{where}: expected a gain for every stage, or a sensitivity")
    motion = response.response_stages[0].input_units or (stated and stated.input_units)
    unit = str(motion or "").lower()
    unit = _UNITS.get(unit, unit)
    if not is_motion(unit):
        _LOGGER.warning(
            "%s: its input is in %r; expected a unit of motion, such as M/S or M/S**2. The channel"
            " keeps this unit; if it is a mistake, import again with the right response",
            *(where, motion),
        )
    return ChannelResponse(
        sensitivity=sensitivity,
        unit=unit,
        shape=PolesZeros(
            zeros=tuple(zeros), poles=tuple(poles), normalization=normalization, frequency=frequency
        ),
    )


def _at_gain_frequency(
    stage: Any,  # noqa: ANN401 - ObsPy has no types
    zeros: tuple[complex, ...],
    poles: tuple[complex, ...],
    factor: float,
) -> float:
    """Return the factor that makes a stage 1 at the frequency for which its gain is stated."""
    at = stage.stage_gain_frequency
    if not at or float(at) == float(stage.normalization_frequency):
        return factor
    value = np.abs(PolesZeros(zeros=zeros, poles=poles, normalization=1.0).at(np.array(float(at))))
    return factor if not np.isfinite(value) or value == 0 else 1.0 / float(value)


def _check_units(where: str, response: Any) -> None:  # noqa: ANN401 - ObsPy has no types
    """Check that each stage takes what the one before gives, and that the last gives counts.

    Raises
    ------
    ImportFormatError
        With the stage that does not fit.
    """
    stages = response.response_stages
    given = ""
    for number, stage in enumerate(stages, start=1):
        taken = _unit(stage.input_units)
        if given and taken and taken != given:
            raise ImportFormatError(
                f"{where}: stage {number} takes {stage.input_units}, stage {number - 1} gives"
                f" {stages[number - 2].output_units}; expected the same unit"
            )
        given = _unit(stage.output_units) or given
    if given and given != "counts":
        raise ImportFormatError(
            f"{where}: the last stage gives {stages[-1].output_units}; expected counts, from"
            " sensor and digitizer together"
        )


def _unit(text: Any) -> str:  # noqa: ANN401 - ObsPy has no types
    unit = str(text or "").strip().lower()
    return _SAME_UNIT.get(unit, unit)
