"""Decoding: how many times faster than its line can deliver each protocol is decoded."""

from __future__ import annotations

import itertools
import struct
import time
from collections.abc import Callable
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from benchmarks.row import Row
from daq.devices.epson import commands
from daq.devices.epson.burst import BurstDecoder
from daq.devices.epson.commands import BurstFormat
from daq.devices.guralp import brp, gcf
from daq.devices.guralp.decoders import SerialDecoder
from daq.devices.labjack import packets, stream
from daq.devices.labjack.packets import Packet
from daq.devices.labjack.stream import StreamDecoder
from daq.devices.modbus import rtu
from daq.devices.modbus.fifo_protocol import FifoDecoder
from daq.devices.modbus.registers_protocol import RegisterDecoder, RegisterMap
from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import RASPBERRY_SHAKE
from daq.protocols.block import HostTime

READ = 4096
"""Bytes a read: what a serial port's buffer in the kernel holds."""
SECONDS = 0.4
"""Processor time that each decoder is given."""
HEADROOM = 20.0
"""Times the line rate every decoder must do: a twentieth of a core a device at the most."""


def _noise(n: int) -> NDArray[np.int64]:
    return np.rint(np.random.default_rng(7).normal(0, 2000, n)).astype(np.int64)


def _epson(n_frames: int) -> bytes:
    noise = _noise(3 * n_frames).reshape(3, -1)
    return commands.encode_bursts(
        EPSON,
        flag=0x8E00,
        temperature=2637,
        x=noise[0],
        y=noise[1],
        z=noise[2],
        count=np.arange(n_frames) % 65536,
    )


EPSON = BurstFormat.of("flag", "temperature", "x", "y", "z", "count", "checksum")


def _epson_decoder() -> BurstDecoder:
    fields = ("x", "y", "z", "temperature")
    return BurstDecoder(
        "A", EPSON, fields=fields, sampling_rate=1000.0, full_scale_counts=15 * 2**24
    )


def _with_garbage(sent: bytes) -> bytes:
    """Change one byte in a hundred."""
    octets = np.frombuffer(sent, np.uint8).copy()
    rng = np.random.default_rng(8)
    octets[rng.integers(0, octets.size, octets.size // 100)] ^= 0x55
    return octets.tobytes()


def _throughput(
    sent: bytes, receive: Callable[[bytes, HostTime], object], rate: float, seconds: float
) -> float:
    """Bytes a second of decoding; ``rate`` bytes a second is how fast host time passes."""
    reads = [sent[start : start + READ] for start in range(0, len(sent), READ)]
    elapsed, done = 0.0, 0
    for k, read in enumerate(itertools.cycle(reads)):
        at = HostTime(round((k + 1) * READ / rate * 1e9), 0)
        begin = time.process_time()
        receive(read, at)
        elapsed += time.process_time() - begin
        done += len(read)
        if elapsed > seconds:
            return done / elapsed
    return 0.0


def _row(
    what: str,
    sent: bytes,
    receive: Callable[[bytes, HostTime], object],
    line: float,
    seconds: float,
) -> Row:
    speed = _throughput(sent, receive, line, seconds)
    note = f"{speed / 1e6:.1f} MB/s, the line {line / 1e3:.3g} kB/s"
    return Row(f"decode {what}", speed / line, "× line rate", at_least=HEADROOM, note=note)


def _guralp() -> bytes:
    """Blocks of 24 seconds of one channel at 40 Hz, framed."""
    system = gcf.SystemId("DEMO")
    frames = []
    for k in range(200):
        counts = np.cumsum(_noise(960) // 100).astype(np.int32)
        block = gcf.SampleBlock(
            system, "DEMOZ0", (1_790_000_000 + 24 * k) * 10**9, Fraction(40), counts
        )
        frames.append(brp.encode_frame(k, gcf.encode_block(block)))
    return b"".join(frames)


def _labjack() -> bytes:
    """Nine inputs and the core timer."""
    rows = np.random.default_rng(9).integers(20000, 40000, (40 * 500, 11)).astype(np.uint16)
    timer = np.arange(len(rows), dtype=np.int64) * 40_000
    rows[:, 0], rows[:, 1] = timer & 0xFFFF, timer >> 16 & 0xFFFF
    samples = rows.ravel()
    encoded = [
        packets.encode_packet(Packet(samples[start : start + 506], transaction=k))
        for k, start in enumerate(range(0, samples.size, 506))
    ]
    return b"".join(encoded)


def _shake() -> bytes:
    counts = _noise(25 * 400).reshape(-1, 25)
    return b"".join(
        f"{{'EHZ', {1_582_315_130 + k / 4:.3f}, {', '.join(map(str, row))}}}".encode()
        for k, row in enumerate(counts.tolist())
    )


def _polled() -> Row:
    """Measure replies of seven registers against the limit of the wire."""
    registers = RegisterMap.of({"preset": "witmotion"}, 3)
    decoder = RegisterDecoder("A", registers, sampling_rate=200.0)
    held = [
        registers.encode(np.array([k, -k, 0]), time_ns=10**18 + k * 5 * 10**6) for k in range(1000)
    ]
    replies = [[one[0x30 + r] for r in range(7)] for one in held]
    begin = time.process_time()
    for k, reply in enumerate(replies):
        at = HostTime(k * 5 * 10**6, 0)
        decoder.receive(reply, at, at)
    polls = len(replies) / (time.process_time() - begin)
    note = f"{polls:.0f} polls/s; 921600 baud carry 209/s"
    return Row("decode polled registers", polls / 209, "× line rate", at_least=HEADROOM, note=note)


def _fifo(seconds: float) -> Row:
    """Whole reads of 123 words against 3 Mbaud."""
    decoder = FifoDecoder("A", 7812.0)
    words = struct.pack(">124H", 3690, *range(123))
    reply = rtu.encode(1, bytes((4, len(words))) + words)
    elapsed, done, k = 0.0, 0, 0
    while elapsed <= seconds:
        k += 1
        decoder.level = 3690
        decoder.request()
        begin = time.process_time()
        decoder.receive(reply, HostTime(k * 5_000_000, 0))
        elapsed += time.process_time() - begin
        done += len(reply)
    line = 7812 * 6  # what the device samples; the wire could carry six times that
    note = f"{done / elapsed / 1e6:.1f} MB/s, the device {line / 1e3:.3g} kB/s"
    speed = done / elapsed / line
    return Row("decode a block FIFO", speed, "× line rate", at_least=HEADROOM, note=note)


def _single_frames() -> Row:
    """Processor time when every frame at 1000 Hz is a read of its own."""
    sent, decoder = _epson(4000), _epson_decoder()
    reads = [sent[start : start + 24] for start in range(0, len(sent), 24)]
    begin = time.process_time()
    for k, read in enumerate(reads):
        decoder.receive(read, HostTime(k * 10**6, 0))
    share = (time.process_time() - begin) / len(reads) * 1000
    return Row("decode Epson, each frame at 1000 Hz a read", 100 * share, "% of a core")


def run(*, smallest: bool = False) -> list[Row]:
    """Measure every decoder."""
    seconds = 0.0 if smallest else SECONDS
    line = 460800 / 10
    sent = _epson(65536)
    return [
        _row("Epson bursts", sent, _epson_decoder().receive, line, seconds),
        _row(
            "Epson bursts, 1 % of bytes wrong",
            _with_garbage(sent),
            _epson_decoder().receive,
            line,
            seconds,
        ),
        _single_frames(),
        _row(
            "LabJack stream, 9 inputs and timer",
            _labjack(),
            StreamDecoder(
                {name: [0 + 6 * k, 2 + 6 * k, 4 + 6 * k] for k, name in enumerate("ABC")},
                scan_list=[*stream.TIMER_ADDRESSES, *range(0, 18, 2)],
                scan_rate=1000.0,
            ).receive,
            1000 * 11 * 2,
            seconds,
        ),
        _row("Güralp GCF", _guralp(), SerialDecoder({"A": ["DEMOZ0"]}).receive, 11520, seconds),
        _row(
            "Raspberry Shake text",
            _shake(),
            TextDecoder("A", RASPBERRY_SHAKE, sampling_rate=100.0).receive,
            100 * 7.5,
            seconds,
        ),
        _fifo(seconds),
        _polled(),
    ]
