"""miniSEED records, read and written by libmseed (pymseed)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daq.devices.seedlink.packets import RECORD_SIZE
from daq.protocols.errors import RemoteProtocolError
from daq.python_process import install_command

try:
    from pymseed import MiniSEEDError, MS3Record, nslc2sourceid, sourceid2nslc
except ImportError as error:  # an optional dependency
    raise ImportError(
        f"SeedLink needs pymseed, which is not installed; run: {install_command('seedlink')}"
    ) from error

if TYPE_CHECKING:
    from numpy.typing import NDArray

    SampleArray: TypeAlias = NDArray[np.int32] | NDArray[np.float32] | NDArray[np.float64]

TEXT, STEIM_2 = 0, 11
"""miniSEED encodings."""
_MAX_DENOMINATOR = 100_000
"""Of sampling rates: records have them as a float, or as a factor and a multiplier."""


@dataclass(frozen=True, slots=True, eq=False)
class WaveRecord:
    """One record with samples.

    Attributes
    ----------
    network, station, location, channel : str
        Codes; the location may be empty.
    start_ns : int
        UTC of the first sample, in ns since 1970.
    sampling_rate : Fraction
        In Hz.
    counts : ndarray, shape (n_samples,)
        int32, float32 or float64, as recorded.
    """

    network: str
    station: str
    location: str
    channel: str
    start_ns: int
    sampling_rate: Fraction
    counts: SampleArray

    @property
    def stream_id(self) -> str:
        """The four codes, joined by dots."""
        return f"{self.network}.{self.station}.{self.location}.{self.channel}"


def decode_record(payload: bytes) -> WaveRecord | None:
    """Decode a miniSEED record; return None if it holds no samples, such as a log.

    Raises
    ------
    RemoteProtocolError
        If the record is invalid.
    """
    try:
        record = MS3Record.parse(payload, unpack_data=True)
        if not record.samplecnt or record.sampletype not in {"i", "f", "d"}:
            return None
        codes = sourceid2nslc(record.sourceid)
        rate = Fraction(record.samprate).limit_denominator(_MAX_DENOMINATOR)
        counts: Any = np.array(record.np_datasamples)  # a copy: the record owns the memory
    except (MiniSEEDError, ValueError, OverflowError) as error:
        raise RemoteProtocolError(f"a miniSEED record that cannot be read: {error}") from error
    if rate <= 0 or not len(counts):
        return None
    return WaveRecord(*codes, record.starttime, rate, counts)


def encode_record(record: WaveRecord) -> list[bytes]:
    """Encode samples as miniSEED 2 records of 512 bytes, Steim 2; int32 only."""
    made = MS3Record(reclen=RECORD_SIZE, encoding=STEIM_2)
    made.formatversion = 2
    made.sourceid = nslc2sourceid(record.network, record.station, record.location, record.channel)
    made.samprate = float(record.sampling_rate)
    made.starttime = record.start_ns
    return list(made.generate(record.counts.astype(np.int32), "i"))


def encode_log(text: str) -> bytes:
    """Encode a miniSEED 2 record of text, as in version 3's reply to INFO."""
    made = MS3Record(reclen=RECORD_SIZE, encoding=TEXT)
    made.formatversion = 2
    made.sourceid = nslc2sourceid("SL", "INFO", "", "INF")
    made.samprate = 0.0
    made.starttime = 0
    (payload,) = made.generate(text.encode("ascii"), "t")
    return bytes(payload)
