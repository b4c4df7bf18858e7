"""ObsPy decodes GCF blocks of our simulated digitizer, and we read GCF that ObsPy wrote."""

from __future__ import annotations

import asyncio
import io
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.devices.guralp import brp, gcf, scream
from daq.devices.guralp.decoders import ScreamDecoder, SerialDecoder
from daq.devices.guralp.gcf import SampleBlock
from daq.devices.registry import driver_type
from daq.protocols.block import Block, HostTime
from sim_devices.devices.guralp import Digitizer
from sim_devices.devices.interface import ChannelSpec, DeviceSpec, Source
from sim_devices.world.world import World
from tests.daq.devices.reading import record
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import scenario
from tests.tcp import served

pytestmark = pytest.mark.peer

obspy: Any = pytest.importorskip("obspy", reason="obspy (extra 'formats') is not installed")

AT = HostTime(0, 0)
START = 1_795_219_200  # 2026-11-21T00:00:00Z
STREAMS = ("DEMOZ2", "DEMON2", "DEMOE2")


def read(blocks: bytes) -> Any:  # noqa: ANN401 -- ObsPy has no types
    return obspy.read(io.BytesIO(blocks), format="GCF")


@pytest.mark.parametrize(
    ("rate", "sensitivity", "width"),
    [
        (100.0, 1e3, 8),
        (100.0, 1e5, 16),
        (200.0, 1e9, 32),
        (400.0, 1e7, None),
        (1000.0, 1e7, None),
        (4000.0, 1e7, None),
    ],
)
def test_obspy_reads_our_digitizer(rate: float, sensitivity: float, width: int | None) -> None:
    """To the exact start and every sample, whatever the compression."""
    channels = tuple(ChannelSpec(name, sensitivity) for name in "ZNE")
    spec = DeviceSpec(
        sensors=("A",),
        driver="guralp",
        port="pty",
        sampling_rate=rate,
        channels={"A": channels},
        settings={"streams": STREAMS, "system_id": "GURA", "width": width},
        utc_ns=START * 10**9 - 300_000_000,  # the world began between two seconds
    )
    world = scenario("A", sampling_rate=rate)
    digitizer = Digitizer(spec, Source(world, spec))
    digitizer.start(0.0)
    seconds = 12 if rate < 1000 else 2
    blocks = [b for b in digitizer.blocks(seconds + 0.301) if isinstance(b, SampleBlock)]
    found = read(b"".join(digitizer.encoded(b).ljust(1024, b"\0") for b in blocks))
    assert len(found) == 3
    table = world.to_dict()
    table["sensors"]["A"]["clock"] = {"offset": 0.3}
    n = found[0].stats.npts
    assert n >= seconds * rate * 0.8
    truth = World(type(world).from_dict(table)).samples("A", 0, n) * sensitivity
    for column, (component, stream) in enumerate(zip("ZNE", STREAMS, strict=True)):
        trace = next(t for t in found if t.stats.channel.endswith(component))
        assert trace.stats.starttime == obspy.UTCDateTime(START)
        assert trace.stats.sampling_rate == rate
        assert trace.stats.gcf.stream_id == stream
        assert trace.stats.gcf.system_id == "GURA"
        assert trace.stats.npts == n
        whole = np.clip(np.rint(truth[:, column]), -(2**23) + 1, 2**23 - 1)
        np.testing.assert_array_equal(trace.data, whole)


def written(tmp_path: Path, rate: float, counts: NDArray[np.int32], **more: object) -> list[bytes]:
    """Blocks of three streams as ObsPy writes them, those of one time together."""
    files = []
    for column, component in enumerate("ZNE"):
        header = {"sampling_rate": rate, "starttime": obspy.UTCDateTime(START + 0.5)}
        if rate <= 250:
            header["starttime"] = obspy.UTCDateTime(START)
        header |= {"station": "DEMO", "channel": f"HH{component}"}
        path = tmp_path / f"{component}.gcf"
        trace = obspy.Trace(np.ascontiguousarray(counts[:, column]), header)
        trace.write(str(path), format="GCF", stream_id=f"DEMO{component}2", **more)
        data = path.read_bytes()
        files.append([data[i : i + 1024] for i in range(0, len(data), 1024)])
    order = [(gcf.decode_block(block).start_ns, block) for file in files for block in file]
    return [block for _, block in sorted(order, key=lambda entry: entry[0])]


def joined(found: list[Any]) -> tuple[NDArray[np.int64], list[Block]]:
    blocks = [b for b in found if isinstance(b, Block)]
    return np.concatenate([b.counts for b in blocks]), blocks


@pytest.mark.parametrize("rate", [1.0, 50.0, 100.0, 250.0, 400.0, 500.0, 1000.0, 2000.0, 5000.0])
@pytest.mark.parametrize("step", [50, 20_000, 3_000_000])
def test_we_read_what_obspy_writes(tmp_path: Path, rate: float, step: int) -> None:
    """Small, middling and large differences: blocks of 8, 16 and 32 bits, of unequal length."""
    rng = np.random.default_rng(int(rate) + step)
    n = int(max(rate, 20)) * 4
    counts = rng.integers(-step, step, (n, 3)).astype(np.int32)
    more = {"sys_type": 1, "gain": 8, "digi": 1, "system_id": "GURA"}
    blocks = written(tmp_path, rate, counts, **more)
    serial, server = SerialDecoder({"A": STREAMS}), ScreamDecoder({"A": STREAMS})
    by_line: list[Any] = []
    by_network: list[Any] = []
    for number, raw in enumerate(blocks):
        block = gcf.decode_block(raw)
        assert isinstance(block, SampleBlock)
        assert (block.system.text, block.system.gain, block.system.digitizer) == ("GURA", 8, 1)
        assert block.sampling_rate == Fraction(rate)
        by_line += serial.receive(brp.encode_frame(number, raw), AT)
        tail = bytes((40, 1)) + number.to_bytes(2, "big") + b"\1X".ljust(49, b"\0")
        by_network += server.receive_datagram(raw + tail, AT)
        assert len(raw + tail) == scream.SIZES[40]
    for found in (by_line, by_network):
        values, read_blocks = joined(found)
        kept = len(values)
        assert kept >= n - 4  # ObsPy drops samples that do not fill the last record
        np.testing.assert_array_equal(values, counts[:kept])
        assert read_blocks[0].device_counter == (2 * START + (rate > 250)) * 10**9 // 2


def test_we_read_a_real_digitizer_as_obspy_does() -> None:
    """ObsPy's own test files, recorded by DM24s."""
    folder = Path(obspy.__file__).parent / "io" / "gcf" / "tests" / "data"
    files = sorted(folder.glob("*.gcf"))
    if not files:
        pytest.skip("this ObsPy comes without its test files")
    for file in files:
        data = file.read_bytes()
        blocks = [gcf.decode_block(data[i : i + 1024]) for i in range(0, len(data), 1024)]
        for trace in read(data):
            ours = [
                b
                for b in blocks
                if isinstance(b, SampleBlock) and b.stream_id == trace.stats.gcf.stream_id
            ]
            np.testing.assert_array_equal(np.concatenate([b.counts for b in ours]), trace.data)
            assert ours[0].start_ns == trace.stats.starttime.ns
            assert ours[0].system.text == trace.stats.gcf.system_id


@pytest.fixture
def frames(tmp_path: Path) -> list[bytes]:
    counts = np.random.default_rng(7).integers(-9000, 9000, (2000, 3)).astype(np.int32)
    return [brp.encode_frame(i, raw) for i, raw in enumerate(written(tmp_path, 100.0, counts))]


async def test_our_driver_reads_what_obspy_wrote(frames: list[bytes]) -> None:
    """Over a real connection, each frame sent when the one before was acknowledged."""
    counts = np.random.default_rng(7).integers(-9000, 9000, (2000, 3))
    replies = bytearray()

    async def send(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for frame in frames:
            writer.write(frame)
            replies.extend(await reader.read(6))
        await reader.read()

    async with served(send) as number:
        port, settings = f"socket://127.0.0.1:{number}", {"streams": STREAMS}
        sensor = sensor_at(port, "guralp", rate=100.0, channels="ZNE", settings=settings)
        blocks, events = await record(driver_type("guralp"), sensor, 2000)
    assert not events
    np.testing.assert_array_equal(np.concatenate([b.counts for b in blocks]), counts)
    assert blocks[0].device_counter == START * 10**9
    # blocks are handed on before they are acknowledged, and this reader stops at the last one
    assert len(brp.decode_replies(replies)) in {len(frames) - 1, len(frames)}
