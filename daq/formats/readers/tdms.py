"""TDMS of National Instruments, read by npTDMS.

A group is a sensor, its channels are the channels. Start, interval and unit are properties of the
channels (``wf_start_time``, ``wf_increment``, ``unit_string``). A file is read in parts of equally
many samples of every channel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import NS_PER_S
from daq.formats.readers.packages import load
from daq.formats.traces import Trace

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_SAMPLES = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class TdmsPart:
    """Samples of all channels of a file, from one to another."""

    path: Path
    first: int
    end: int
    sampling_rate: float | None

    @property
    def source(self) -> str:
        """The file, in messages."""
        return str(self.path)

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

    def reaches(self, start_ns: int | None, end_ns: int | None) -> bool:
        """Return True: what it has is known when it is loaded."""
        del start_ns, end_ns
        return True

    def split(self) -> tuple[TdmsPart, ...]:
        """Return nothing: what npTDMS cannot read, it cannot read in pieces."""
        return ()

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
