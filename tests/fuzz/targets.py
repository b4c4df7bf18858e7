"""What is fuzzed: one function a decoder, which any bytes must leave as it should be.

Received bytes may raise RemoteProtocolError and nothing else, and once valid frames resume every
one of them must be decoded. The first byte of an input says how the rest is cut into reads.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from daq.devices.epson import commands
from daq.devices.epson.burst import BurstDecoder
from daq.devices.epson.commands import BurstFormat, CommandDecoder, Read
from daq.devices.guralp import brp, gcf, scream
from daq.devices.guralp.decoders import ScreamDecoder, SerialDecoder
from daq.devices.labjack import packets
from daq.devices.labjack.packets import Packet
from daq.devices.labjack.registers import AduFinder, decode_feedback
from daq.devices.labjack.stream import StreamDecoder
from daq.devices.modbus import rtu
from daq.devices.modbus.fifo_protocol import FifoDecoder
from daq.devices.modbus.registers_protocol import RegisterDecoder, RegisterMap
from daq.devices.seedlink import packets as seedlink
from daq.devices.seedlink.decoder import (
    SeedLinkDecoder,
    StreamSelection,
    WaveRecord,
    decode_record,
    encode_record,
)
from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import RASPBERRY_SHAKE, TextFormat
from daq.protocols.block import Block, Event, HostTime
from daq.protocols.errors import RemoteProtocolError

LATER = 10**6
"""Host seconds after which the valid frames come: whatever came before is long past."""


class NotDecodedError(Exception):
    """Valid frames were lost."""


def _at(seconds: float) -> HostTime:
    return HostTime(round(seconds * 1e9), round(seconds * 1e9))


def _reads(fuzzed: bytes) -> Iterator[tuple[bytes, HostTime]]:
    size = fuzzed[0] + 1 if fuzzed else 1
    for k, start in enumerate(range(1, len(fuzzed), size)):
        yield fuzzed[start : start + size], _at(k / 10)


def _feed(receive: Callable[[bytes, HostTime], Iterable[object]], fuzzed: bytes) -> list[object]:
    found: list[object] = []
    for read, at in _reads(fuzzed):
        with contextlib.suppress(RemoteProtocolError):
            found += list(receive(read, at))
    return found


def _demand(found: Sequence[object], n_samples: int) -> None:
    """Raise unless so many samples are in blocks of rising index."""
    blocks = [item for item in found if isinstance(item, Block)]
    if sum(block.n_samples for block in blocks) < n_samples:
        raise NotDecodedError(f"{n_samples} samples sent, got {[b.n_samples for b in blocks]}")
    ends = [block.end_sample for block in blocks]
    if any(block.first_sample < end for block, end in zip(blocks[1:], ends, strict=False)):
        raise NotDecodedError("blocks overlap")
    if any(len(item.text.encode()) > 200 for item in found if isinstance(item, Event)):
        raise NotDecodedError("an event of more than 200 bytes")


ALL = BurstFormat.of("flag", "temperature", "x", "y", "z", "count", "checksum")
BURSTS = commands.encode_bursts(
    ALL, flag=0x8E00, temperature=2637, x=np.arange(20), y=-1, z=0x0D80, count=np.arange(20)
)


def epson_bursts(fuzzed: bytes) -> None:
    """Bursts of an accelerometer."""
    decoder = BurstDecoder(
        "A", ALL, fields=("x", "y", "z"), sampling_rate=200.0, full_scale_counts=2**27
    )
    _feed(decoder.receive, fuzzed)
    # zeros end what looked like a frame begun
    _demand(decoder.receive(bytes(ALL.size) + BURSTS, _at(LATER)), 20)


def epson_commands(fuzzed: bytes) -> None:
    """Commands, as the device hears them."""
    decoder = CommandDecoder()
    for read, _ in _reads(fuzzed):
        decoder.receive(read)
    decoder.receive(bytes([commands.DELIMITER] * 3))
    if decoder.receive(commands.read(commands.ID))[-1] != Read(0x4C):
        raise NotDecodedError("a read was not heard")
    commands.find_reply(fuzzed, 0x4C)


WITMOTION = RegisterMap.of({"preset": "witmotion"}, 3)


def polled_registers(fuzzed: bytes) -> None:
    """Poll replies of any length with any values."""
    decoder = RegisterDecoder("A", WITMOTION, sampling_rate=20.0)
    for read, at in _reads(fuzzed):
        values = struct.unpack(f">{len(read) // 2}H", read[: len(read) // 2 * 2])
        with contextlib.suppress(RemoteProtocolError):
            decoder.receive(values, at, at)
    decoder.flush()
    found: list[object] = []
    for k in range(40):
        held = WITMOTION.encode(np.array([k, 0, 0]), time_ns=10**18 + k * 50_000_000)
        at = _at(LATER + 1 + k / 20)
        found += decoder.receive([held[0x30 + r] for r in range(7)], at, at)
    _demand(found, 40)


SYSTEM = gcf.SystemId("DEMO")


def _gcf(k: int) -> gcf.SampleBlock:
    counts = np.arange(40, dtype=np.int32) * 1000 + k
    start = (1_790_000_000 + k) * 10**9
    return gcf.SampleBlock(SYSTEM, "DEMOZ0", start, Fraction(40), counts)


FRAMES = b"".join(brp.encode_frame(k, gcf.encode_block(_gcf(k))) for k in range(4))


def guralp_serial(fuzzed: bytes) -> None:
    """Framed GCF blocks over a serial line."""
    decoder = SerialDecoder({"A": ["DEMOZ0"]}, replies=False)
    found = _feed(decoder.receive, fuzzed)
    # a block of the future may have been among them: what is valid now may be too late
    found += decoder.receive(bytes(2048) + FRAMES, _at(LATER))
    _demand(found, 0)


def gcf_block(fuzzed: bytes) -> None:
    """One GCF block."""
    with contextlib.suppress(RemoteProtocolError):
        gcf.decode_block(fuzzed)


SCREAM = [scream.encode_packet(scream.Packet(k, "DEMO", _gcf(k))) for k in (0, 1, 2, 4, 3)]


def scream_tcp(fuzzed: bytes) -> None:
    """Packets of a Scream server, over TCP."""
    decoder = ScreamDecoder({"A": ["DEMOZ0"]})
    _demand(_feed(decoder.receive, fuzzed), 0)
    decoder.receive(bytes(2048) + b"".join(SCREAM), _at(LATER))


def scream_udp(fuzzed: bytes) -> None:
    """Datagrams of a Scream server."""
    decoder = ScreamDecoder({"A": ["DEMOZ0"]})
    found: list[object] = []
    for k, start in enumerate(range(0, len(fuzzed), len(SCREAM[0]))):
        found += decoder.receive_datagram(fuzzed[start : start + len(SCREAM[0])], _at(k / 10))
        if k % 3 == 2 and decoder.missing:
            decoder.not_available(decoder.missing[0])
    _demand(found, 0)


PACKETS, LATER_PACKETS = (
    b"".join(
        packets.encode_packet(Packet(np.arange(40, dtype=np.uint16), transaction=first + k))
        for k in range(5)
    )
    for first in (0, 30_000)
)


def labjack_stream(fuzzed: bytes) -> None:
    """Spontaneous packets of a LabJack."""
    decoder = StreamDecoder({"A": [0, 2, 4, 6]}, scan_list=[0, 2, 4, 6], scan_rate=1000.0)
    _feed(decoder.receive, fuzzed)
    # zeros end what looked like a packet begun
    _demand(decoder.receive(bytes(1100) + LATER_PACKETS + bytes(1100), _at(LATER)), 50)


def labjack_registers(fuzzed: bytes) -> None:
    """Modbus TCP frames, both ways."""
    finder = AduFinder()
    for read, _ in _reads(fuzzed):
        with contextlib.suppress(RemoteProtocolError):
            list(finder.receive(read))
    for decode in (packets.decode_response, decode_feedback):
        with contextlib.suppress(RemoteProtocolError):
            decode(fuzzed)


def fifo(fuzzed: bytes) -> None:
    """Read replies of a block FIFO."""
    decoder = FifoDecoder("A", 7812.0)
    for read, at in _reads(fuzzed):
        decoder.request()
        with contextlib.suppress(RemoteProtocolError):
            decoder.receive(read, at)
            size = min(len(read), rtu.MAX_FRAME - 6) & 0xFE
            whole = rtu.encode(1, bytes((4, size)) + read[:size])
            decoder.receive(whole, at)
        if decoder.waiting:
            decoder.timed_out(at)


ROWS = TextFormat(columns=(0, 1, 2), counter_column=3, time_column=4)


def text_rows(fuzzed: bytes) -> None:
    """Rows of text with counter and time."""
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    _feed(decoder.receive, fuzzed)


TIMED = TextFormat(columns=(1, 2), time_column=0)


def text_times(fuzzed: bytes) -> None:
    """Rows of text with a time and no counter."""
    decoder = TextDecoder("A", TIMED, sampling_rate=10.0)
    found = _feed(decoder.receive, fuzzed)
    rows = [f"{LATER + k / 10:.1f},{k},0\n" for k in range(80)]
    # what was fuzzed may have had a time among these: of the later ones each must come
    settled = decoder.receive(("\n" + "".join(rows[:40])).encode(), _at(LATER + 4))
    later = decoder.receive("".join(rows[40:]).encode(), _at(LATER + 8))
    _demand(later, 40)
    _demand([*found, *settled, *later], 40)


THREE = replace(RASPBERRY_SHAKE, channel_names=("EHZ", "EHN", "EHE"))


def text_datagrams(fuzzed: bytes) -> None:
    """Packets of three channels, a datagram each, in any order."""
    decoder = TextDecoder("A", THREE, sampling_rate=100.0)
    _demand(_feed(decoder.receive_datagram, fuzzed), 0)


def text_packets(fuzzed: bytes) -> None:
    """Packets of a Raspberry Shake."""
    decoder = TextDecoder("A", RASPBERRY_SHAKE, sampling_rate=100.0)
    _feed(decoder.receive, fuzzed)
    packets = [
        f"{{'EHZ', {LATER + k / 4:.3f}, {', '.join(map(str, range(25)))}}}" for k in range(16)
    ]
    decoder.receive(b"}", _at(LATER))  # ends what was begun
    # what was fuzzed may have had a time among these: of the later ones each must come
    settled = [x for p in packets[:8] for x in decoder.receive(p.encode(), _at(LATER + 2))]
    later = [x for p in packets[8:] for x in decoder.receive(p.encode(), _at(LATER + 4))]
    _demand(later, 8 * 25)
    _demand([*settled, *later], 8 * 25)


def _seedlink(version: seedlink.Version, station: str, k: int) -> bytes:
    start = (1_790_000_000 + k) * 10**9
    counts = np.arange(100, dtype=np.int32) * 1000 + k
    wave = WaveRecord("XX", station, "00", "HNZ", start, Fraction(100), counts)
    (payload,) = encode_record(wave)
    return seedlink.encode_packet(seedlink.Packet(k + 1, payload, f"XX_{station}"), version)


def seedlink_record(fuzzed: bytes) -> None:
    """One record."""
    with contextlib.suppress(RemoteProtocolError):
        decode_record(fuzzed)


def _seedlink_target(version: seedlink.Version) -> Callable[[bytes], None]:
    def run(fuzzed: bytes) -> None:
        """Packets of one station; after another connection those of a second one."""
        stations = {"A": "A", "B": "B"}
        decoder = SeedLinkDecoder(
            {
                name: StreamSelection("XX", one, (("*", "HNZ"),), 1)
                for name, one in stations.items()
            },
            dict.fromkeys(stations, np.dtype(np.int32)),
            hold=5.0,
        )
        decoder.begin(version)
        for read, at in _reads(fuzzed):
            try:
                decoder.receive(read, at)
            except RemoteProtocolError:
                decoder.begin(version)
        decoder.begin(version)
        found = [
            x
            for k in range(20)
            for x in decoder.receive(_seedlink(version, "B", k), _at(LATER + k))
        ]
        _demand([x for x in found if getattr(x, "sensor", "") == "B"], 20 * 100)

    return run


SEEDLINK: dict[seedlink.Version, bytes] = {
    version: b"".join(_seedlink(version, "A", k) for k in range(4)) for version in (3, 4)
}
TARGETS: dict[str, tuple[Callable[[bytes], None], list[bytes]]] = {
    "epson_bursts": (epson_bursts, [b"\xff" + BURSTS, b"\x10" + BURSTS[5:], bytes(60)]),
    "epson_commands": (epson_commands, [b"\x02" + commands.read(commands.ID) * 3]),
    "polled_registers": (polled_registers, [b"\x0d" + bytes(range(70)), b"\x0d" + b"\xff" * 56]),
    "guralp_serial": (guralp_serial, [b"\xff" + FRAMES, b"\x07" + FRAMES[30:]]),
    "gcf_block": (gcf_block, [gcf.encode_block(_gcf(0))]),
    "scream_tcp": (scream_tcp, [b"\xff" + b"".join(SCREAM[:3])]),
    "scream_udp": (scream_udp, [b"".join(SCREAM[:3]), SCREAM[0] + b"".join(SCREAM[3:])]),
    "labjack_stream": (labjack_stream, [b"\xff" + PACKETS, b"\x05" + PACKETS[9:]]),
    "labjack_registers": (labjack_registers, [b"\xff" + bytes.fromhex("000100000006ff0400000002")]),
    "fifo": (fifo, [b"\x10" + rtu.encode(1, bytes((4, 8)) + struct.pack(">4H", 3, 1, 2, 3))]),
    "text_rows": (text_rows, [b"\xff1,2,3,0,10.0\n2,3,4,1,10.1\n", b"\x03-1e5,nan,inf,x,1\n"]),
    "text_times": (text_times, [b"\xff10.0,1,2\n10.1,2,3\n10.1,2,3\n", b"\x091e5,1,1\n9.9,0,0\n"]),
    "text_datagrams": (
        text_datagrams,
        [b"\x13" + b"".join(b"{'EH%c', 10.%d, 1}  " % (c, k) for k in range(3) for c in b"ZNE")],
    ),
    "seedlink_record": (seedlink_record, [SEEDLINK[3][8:520]]),
    "seedlink_3": (_seedlink_target(3), [b"\xff" + SEEDLINK[3], b"\x28" + SEEDLINK[3][:700]]),
    "seedlink_4": (_seedlink_target(4), [b"\xff" + SEEDLINK[4], b"\x28" + SEEDLINK[4][:700]]),
    "text_packets": (text_packets, [b"\xff{'EHZ', 1582315130.292, 14168, 14927, 7}"]),
}
"""Name → what to run, and inputs to begin with."""
