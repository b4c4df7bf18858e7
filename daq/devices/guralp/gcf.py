"""Güralp Compressed Format (GCF): one block of one stream, to and from bytes.

Theory of operation
-------------------
A block is at most 1024 bytes, big-endian (Güralp SWA-RFC-GCFR; DM24 operator's guide, chapter 8)::

    0  system ID   u32   base 36, see SystemId
    4  stream ID   u32   base 36: four characters of serial number, component, output tap
    8  date        u32   15 bits of days since 1989-11-17, 17 bits of seconds of the day
    12 TTL         u8    filter table reference
    13 SPS         u8    sampling rate code, 0 for a block of text
    14 compression u8    low 3 bits: 4 x 8, 2 x 16 or 1 x 32 bit differences per record;
                         above 250 Hz, the other bits are the numerator of a fractional start
    15 records     u8    number of 4-byte records
    16 FIC i32, first differences (the first is 0), RIC i32

FIC is the first sample, RIC the last: a block is damaged if its differences do not lead from FIC to
RIC. Serial links may omit the unused bytes after the RIC. They may also send differences of 3 bytes
with the code for 32 bits; only the length of the block distinguishes the two. Differences wrap at
the width of the samples (32 bits, or 24 for 3-byte differences).

A leap second is second 86400 of its day. POSIX time has no leap second: it gets the number of the
second before, and a block that spans one overlaps the next block by one second.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from daq.protocols.errors import RemoteProtocolError

BLOCK_SIZE = 1024
HEADER_SIZE = 16
EPOCH_S = 627_264_000  # 1989-11-17T00:00:00Z
_DAY_S = 86_400
_NS = 1_000_000_000
_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"

Width = Literal[8, 16, 24, 32]

_SPECIAL_RATES: dict[int, tuple[Fraction, int]] = {
    157: (Fraction(1, 10), 1),
    161: (Fraction(1, 8), 1),
    162: (Fraction(1, 5), 1),
    164: (Fraction(1, 4), 1),
    167: (Fraction(1, 2), 1),
    171: (Fraction(400), 8),
    174: (Fraction(500), 2),
    175: (Fraction(800), 16),
    176: (Fraction(1000), 4),
    179: (Fraction(2000), 8),
    181: (Fraction(4000), 16),
    182: (Fraction(625), 5),
    191: (Fraction(1250), 5),
    193: (Fraction(2500), 10),
    194: (Fraction(5000), 20),
}

RATES: Mapping[int, tuple[Fraction, int]] = MappingProxyType(
    {code: (Fraction(code), 1) for code in range(1, 251)} | _SPECIAL_RATES
)
"""SPS code to (sampling rate in Hz, denominator of the fractional second of a block's start)."""

_CODES = {rate: code for code, (rate, _) in RATES.items()}
_WIDTHS: dict[int, Width] = {1: 32, 2: 16, 4: 8}  # compression code: width of a difference
_CODE_OF_WIDTH: dict[Width, int] = {32: 1, 24: 1, 16: 2, 8: 4}


class SystemForm(IntEnum):
    """Packing of the system ID: determines its maximum number of characters."""

    PLAIN = 0
    EXTENDED = 1
    DOUBLE_EXTENDED = 2


_ID_BITS = {SystemForm.PLAIN: 31, SystemForm.EXTENDED: 26, SystemForm.DOUBLE_EXTENDED: 21}


@dataclass(frozen=True, slots=True)
class SystemId:
    """System that a block comes from.

    Only the extended forms hold ``gain`` (0, 1, 2, 4 … 64) and ``digitizer`` (the type bit).
    """

    text: str
    form: SystemForm = SystemForm.PLAIN
    gain: int = 0
    digitizer: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """Samples of one stream, the first at ``start_ns`` UTC; ``counts`` has shape (n_samples,)."""

    system: SystemId
    stream_id: str
    start_ns: int
    sampling_rate: Fraction
    counts: NDArray[np.int32]
    ttl: int = 0


@dataclass(frozen=True, slots=True)
class StatusBlock:
    """Status text of a digitizer: GPS, clock, mass positions."""

    system: SystemId
    stream_id: str
    start_ns: int
    text: str


def encode_id(text: str) -> int:
    """Return the number of an ID of at most six characters 0–9, A–Z."""
    if not text or len(text) > 6 or any(character not in _DIGITS for character in text):
        raise ValueError(f"{text!r} is no GCF identifier: expected 1 to 6 characters 0-9, A-Z")
    return int(text, 36)


def decode_id(number: int) -> str:
    """Return the characters of an ID without leading zeros."""
    characters = ""
    while number or not characters:
        number, digit = divmod(number, 36)
        characters = _DIGITS[digit] + characters
    return characters


def serial_number(stream_id: str) -> str:
    """Return the serial number in a stream ID: up to four characters before component and tap."""
    return stream_id[:-2].rjust(4, "0")


def component(stream_id: str) -> str:
    """Return the component in a stream ID: its last character but one."""
    return stream_id[-2:-1]


def encode_system_id(system: SystemId) -> int:
    """Encode a system ID in its form."""
    number = encode_id(system.text)
    if number >> _ID_BITS[system.form]:
        raise ValueError(f"system ID {system.text!r} is too long for form {system.form.name}")
    if system.form is SystemForm.PLAIN:
        return number
    if system.gain not in (0, 1, 2, 4, 8, 16, 32, 64) or system.digitizer not in (0, 1):
        raise ValueError(f"{system}: gain is 0 or a power of 2 to 64, digitizer is 0 or 1")
    number |= 1 << 31 | system.gain.bit_length() << 27 | system.digitizer << 26
    return number | 1 << 30 if system.form is SystemForm.DOUBLE_EXTENDED else number


def decode_system_id(number: int) -> SystemId:
    """Decode a system ID of any form."""
    if not number >> 31:
        return SystemId(decode_id(number))
    form = SystemForm.DOUBLE_EXTENDED if number >> 30 & 1 else SystemForm.EXTENDED
    code = number >> 27 & 7
    text = decode_id(number & (1 << _ID_BITS[form]) - 1)
    return SystemId(text, form, 1 << code >> 1, number >> 26 & 1)


def decode_block(data: bytes) -> SampleBlock | StatusBlock:
    """Decode one block, complete or cut after its RIC.

    Raises
    ------
    RemoteProtocolError
        If the block is too short or too long, has an unknown sampling rate or compression, declares
        more samples than it holds, or its differences do not lead from FIC to RIC.
    """
    if not HEADER_SIZE <= len(data) <= BLOCK_SIZE:
        raise RemoteProtocolError(f"a GCF block of {len(data)} bytes; expected 16 to {BLOCK_SIZE}")
    raw_system, raw_stream, date, ttl, sps, format_, records = struct.unpack_from(">IIIBBBB", data)
    system = decode_system_id(raw_system)
    stream_id = decode_id(raw_stream)
    second = date & 0x1FFFF
    start_s = EPOCH_S + (date >> 17) * _DAY_S + second - (second == _DAY_S)
    if sps == 0:
        text = data[HEADER_SIZE : HEADER_SIZE + 4 * records].split(b"\0")[0]
        return StatusBlock(system, stream_id, start_s * _NS, text.decode("ascii", "replace"))
    if sps not in RATES:
        raise RemoteProtocolError(f"GCF stream {stream_id}: unknown sampling rate code {sps}")
    rate, parts = RATES[sps]
    numerator = (format_ >> 4) + ((format_ & 8) << 1) if parts > 1 else 0
    if numerator >= parts:
        raise RemoteProtocolError(f"GCF stream {stream_id}: start at {numerator}/{parts} s")
    counts = _decode_samples(data, stream_id, compression=format_ & 7, records=records)
    start_ns = start_s * _NS + numerator * _NS // parts
    return SampleBlock(system, stream_id, start_ns, rate, counts, ttl)


def _decode_samples(
    data: bytes, stream_id: str, *, compression: int, records: int
) -> NDArray[np.int32]:
    width = _WIDTHS.get(compression)
    n_samples = compression * records
    if width is None:
        raise RemoteProtocolError(f"GCF stream {stream_id}: unknown compression {compression}")
    if width == 32 and len(data) == 24 + 3 * n_samples:
        width = 24
    end = 20 + n_samples * width // 8
    if not n_samples or end + 4 > len(data):
        raise RemoteProtocolError(
            f"GCF stream {stream_id}: {n_samples} samples of {width} bits in {len(data)} bytes"
        )
    first, last = (int.from_bytes(data[i : i + 4], "big", signed=True) for i in (16, end))
    counts = np.cumsum(_differences(data[20:end], width), dtype=np.int64)
    counts += first - counts[0]  # a first difference other than 0 has no defined meaning
    modulus = 1 << (24 if width == 24 else 32)
    half = modulus >> 1
    counts = (counts + half) % modulus - half
    if counts[-1] != last or counts[0] != first:
        raise RemoteProtocolError(
            f"GCF stream {stream_id}: differences end at {counts[-1]}; expected {last}, the RIC"
        )
    return counts.astype(np.int32)


def _differences(data: bytes, width: Width) -> NDArray[np.int32]:
    if width == 24:
        triples = np.frombuffer(data, np.uint8).reshape(-1, 3)
        padded = np.zeros((len(triples), 4), np.uint8)
        padded[:, :3] = triples
        return padded.view(">i4")[:, 0].astype(np.int32) >> np.int32(8)
    return np.frombuffer(data, f">i{width // 8}").astype(np.int32)


def narrowest(counts: NDArray[np.int32]) -> Width:
    """Return the smallest width of differences that can hold these samples."""
    differences = np.diff(counts.astype(np.int64))
    reach = int(np.abs(differences).max(initial=0))
    if reach <= 127 and len(counts) % 4 == 0:
        return 8
    if reach <= 32767 and len(counts) % 2 == 0:
        return 16
    return 32


def max_samples(width: Width) -> int:
    """Return the maximum number of samples in a block with differences of this width."""
    return 8000 // width if width != 24 else 255


def encode_block(block: SampleBlock, *, width: Width | None = None) -> bytes:
    """Encode a block, cut after its RIC (pad with zeros to 1024 bytes for files and networks).

    Parameters
    ----------
    block : SampleBlock
    width : 8, 16, 24, 32 or None
        Bits of a difference; None selects the narrowest possible of 8, 16 and 32.

    Raises
    ------
    ValueError
        If the samples do not fit, or GCF has no code for the sampling rate or start.
    """
    counts = block.counts
    width = width or narrowest(counts)
    code = _CODE_OF_WIDTH[width]
    records, odd = divmod(len(counts), code)
    if odd or not 0 < len(counts) <= max_samples(width):
        raise ValueError(f"{len(counts)} samples do not fill a block of {width}-bit differences")
    if block.sampling_rate not in _CODES:
        raise ValueError(f"GCF has no code for {block.sampling_rate} Hz")
    sps = _CODES[block.sampling_rate]
    parts = RATES[sps][1]
    numerator, rest = divmod(block.start_ns % _NS * parts, _NS)
    if rest:
        raise ValueError(f"at {block.sampling_rate} Hz a block starts on a 1/{parts} s of UTC")
    wide = counts.astype(np.int64)
    differences = wide - np.concatenate((wide[:1], wide[:-1]))
    if not _fits(wide if width == 24 else differences, width):
        raise ValueError(f"samples or differences need more than {width} bits")
    body = differences.astype(">i4").view(np.uint8).reshape(-1, 4)[:, 4 - width // 8 :].tobytes()
    format_ = code | (numerator & 15) << 4 | (numerator & 16) >> 1
    head = _header(block.system, block.stream_id, block.start_ns) + bytes(
        (block.ttl, sps, format_, records)
    )
    return head + struct.pack(">i", counts[0]) + body + struct.pack(">i", counts[-1])


def _fits(values: NDArray[np.signedinteger], width: Width) -> bool:
    # Differences wrap at the width of the samples, so any 32-bit difference fits.
    return width == 32 or bool(
        (values >= -1 << (width - 1)).all() and (values < 1 << (width - 1)).all()
    )


def encode_status(block: StatusBlock) -> bytes:
    """Encode a block of text, cut after its last record."""
    text = block.text.encode("ascii")[: BLOCK_SIZE - HEADER_SIZE]
    records = -(-len(text) // 4)
    head = _header(block.system, block.stream_id, block.start_ns)
    return head + bytes((0, 0, 4, records)) + text.ljust(4 * records, b"\0")


def _header(system: SystemId, stream_id: str, start_ns: int) -> bytes:
    days, seconds = divmod(start_ns // _NS - EPOCH_S, _DAY_S)
    if not 0 <= days < 1 << 15:
        raise ValueError(f"GCF has no date for {start_ns / _NS} s since 1970")
    return struct.pack(">III", encode_system_id(system), encode_id(stream_id), days << 17 | seconds)
