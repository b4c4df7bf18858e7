"""Instrument responses from RESP and StationXML, read by ObsPy.

Only what an estimate needs is taken: the product of all analog poles-and-zeros stages and the
product of all gains. Digital filters are left out: they are flat where noise is estimated, and
their delay is already taken out of the times that digitizers write.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from daq.bench.model import PolesZeros
from daq.errors import ImportFormatError
from daq.formats.miniseed import load_obspy

if TYPE_CHECKING:
    from pathlib import Path

_UNITS = {"m": "m", "m/s": "m/s", "m/s**2": "m/s²", "m/s/s": "m/s²", "m/(s**2)": "m/s²"}


@dataclass(frozen=True, slots=True)
class ChannelResponse:
    """How one channel turns motion into counts: ``counts = sensitivity · H(f) · motion``.

    ``sensitivity`` is in counts per ``unit``; ``shape`` is H, normalised as its file says.
    """

    sensitivity: float
    unit: str
    shape: PolesZeros


class Responses:
    """The responses a file holds, by sensor (``network.station.location``) and channel code."""

    def __init__(self, path: Path, by_channel: dict[tuple[str, str], ChannelResponse]) -> None:
        self.path = path
        self.by_channel = by_channel

    def of(self, sensor: str, channel: str) -> ChannelResponse:
        """Return the response of a channel; one alone serves them all.

        Raises
        ------
        ImportFormatError
            The file holds several, and none for this channel.
        """
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
    """Read a RESP or StationXML file. Where a channel has several epochs, the last one counts.

    Raises
    ------
    ImportFormatError
        ObsPy is absent, or the file holds no response that it understands.
    """
    obspy = load_obspy()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            inventory = obspy.read_inventory(str(path))
    except Exception as error:
        raise ImportFormatError(
            f"{path}: expected a RESP or StationXML file; ObsPy cannot read it: {error}"
        ) from error
    by_channel = {
        (_sensor_name(network.code, station.code, channel.location_code), channel.code): _channel(
            f"{path}: {station.code}.{channel.code}", channel.response
        )
        for network in inventory
        for station in network
        for channel in station
        if channel.response is not None
    }
    if not by_channel:
        raise ImportFormatError(f"{path}: expected at least one channel with a response")
    return Responses(path, by_channel)


def _sensor_name(*codes: str) -> str:
    return ".".join(code for code in codes if code)


def _channel(where: str, response: Any) -> ChannelResponse:  # noqa: ANN401 - ObsPy has no types
    zeros: list[complex] = []
    poles: list[complex] = []
    normalization, frequency = 1.0, 1.0
    gains = [stage.stage_gain for stage in response.response_stages]
    for stage in response.response_stages:
        kind = getattr(stage, "pz_transfer_function_type", "")
        if not kind.startswith("LAPLACE"):
            continue
        to_radians = 2 * math.pi if "HERTZ" in kind else 1.0
        zeros += [complex(zero) * to_radians for zero in stage.zeros]
        poles += [complex(pole) * to_radians for pole in stage.poles]
        normalization *= stage.normalization_factor * to_radians ** (
            len(stage.poles) - len(stage.zeros)
        )
        frequency = float(stage.normalization_frequency) or frequency
    if gains and all(gain is not None for gain in gains):
        sensitivity = math.prod(float(gain) for gain in gains)
    elif response.instrument_sensitivity is not None:
        sensitivity = float(response.instrument_sensitivity.value)
    else:
        raise ImportFormatError(f"{where}: expected a gain for every stage, or a sensitivity")
    motion = response.instrument_sensitivity or response.response_stages[0]
    unit = str(motion.input_units or "").lower()
    return ChannelResponse(
        sensitivity=sensitivity,
        unit=_UNITS.get(unit, unit),
        shape=PolesZeros(
            zeros=tuple(zeros), poles=tuple(poles), normalization=normalization, frequency=frequency
        ),
    )
