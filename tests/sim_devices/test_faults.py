"""The fault script strikes what it says, and our drivers and links survive every kind of it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.bench_file import parse as parse_bench
from daq.devices.epson import commands
from daq.devices.interface import Session
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, DeviceError, NoAnswerError, NotConnectedError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, Event
from sim_devices.devices.interface import ChannelSpec, DeviceSpec, Source
from sim_devices.errors import ScenarioError
from sim_devices.faults import LineFaults, SampleFaults, parse
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.daq.devices.reading import reading, record
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import device, scenario, sensors, spec
from tui.simulation.devices import specification, with_faults

pytestmark = pytest.mark.devices

UNIT = bytes(range(20))


def strike(**fault: Any) -> list[bytes]:  # noqa: ANN401 -- a line of a script
    """Return what becomes of four units, the first of which the fault strikes."""
    faults = LineFaults(parse([{"at": 1.0, **fault}]), "A")
    assert faults.next_due() == 1.0
    assert faults.send([UNIT], 0.5) == [UNIT]
    faults.act(1.0)
    return faults.send([UNIT] * 4, 1.0)


def slipping(*script: dict[str, Any]) -> tuple[Source, Source]:
    """Return a sensor whose device's counter slips, and the same sensor without."""
    one = DeviceSpec(("A",), "text", "pty", 200.0, {"A": (ChannelSpec("x", 1e6),) * 3})
    world = scenario("A")
    return Source(world, one, faults=SampleFaults(parse(list(script)))), Source(world, one)


def test_samples_are_lost_or_counted_twice_without_the_counter_saying_so() -> None:
    slipped, sound = slipping(
        {"kind": "skip", "at": 1.0, "count": 3}, {"kind": "repeat", "at": 2.0, "count": 20}
    )
    whole = np.concatenate([slipped.counts("A", k, 50) for k in range(0, 600, 50)])
    true = sound.counts("A", 0, 700)
    expected = [*range(200), *range(203, 400), *range(380, 400), *range(400, 583)]
    np.testing.assert_allclose(whole, true[expected], rtol=1e-12)  # products of matrices
    np.testing.assert_allclose(slipped.counts("A", 390, 20), whole[390:410], rtol=1e-12)
    times, true_times = slipped.times("A", 0, 600), sound.times("A", 0, 700)
    at = np.array(expected)
    at[397:417] = 399  # what is counted again comes at once
    np.testing.assert_array_equal(times, true_times[at])
    assert slipped.first_sample_after("A", 2.5) == 517
    assert sound.first_sample_after("A", 2.5) == 500


def test_random_repetitions_differ_from_device_to_device_and_are_the_same_in_every_run() -> None:
    (fault,) = parse([{"kind": "reset", "at": 10.0, "every": 30.0, "spread": 20.0}])
    times = {}
    for name in "AB":
        times[name] = np.array(
            [t for t, _ in zip(fault.times(name=name), range(200), strict=False)]
        )
        begin = times[name][57] - 0.001
        later = fault.times(begin, name=name)
        assert [next(later) for _ in range(3)] == times[name][57:60].tolist()
    late = times["A"] - (10.0 + 30.0 * np.arange(200))
    assert late.min() >= 0
    assert late.max() <= 20
    assert late.std() == pytest.approx(20 / 12**0.5, rel=0.15)
    assert np.abs(times["A"] - times["B"]).max() > 5


async def test_stated_utc_comes_in_steps() -> None:
    """Of 0.1 ms, although the device could state microseconds."""
    table = device("A", "text", sampling_rate=100.0, port="tcp", settings={"time_column": 3})
    script = [{"kind": "coarse", "at": 0.0, "level": 1e-2}]
    with serving(spec(table, speed=4.0) | {"faults": script}) as (one,):
        (sensor,) = sensors(one, table, settings={"time_column": 3})
        async with AsyncExitStack() as stack:
            session = await stack.enter_async_context(
                driver_type("text").open([sensor], host_clock(4.0))
            )
            n_blocks = 0
            async for item in session.read():
                if isinstance(item, Block):
                    assert item.device_counter is not None
                    assert item.device_counter % 10**7 == 0
                    n_blocks += 1
                if n_blocks == 3:
                    break


def test_faults_change_units() -> None:
    assert strike(kind="drop", count=2) == [UNIT] * 2
    assert strike(kind="cut", count=4) == [UNIT[:8] + UNIT[12:], *[UNIT] * 3]
    assert strike(kind="duplicate", count=2) == [UNIT] * 6
    assert strike(kind="merge") == [UNIT, UNIT, UNIT]  # two halves of one content
    garbage, *rest = strike(kind="garbage", count=7)
    assert (len(garbage), rest) == (7, [UNIT] * 4)
    (changed, *rest) = strike(kind="corrupt", count=3)
    assert sum(a != b for a, b in zip(changed, UNIT, strict=True)) == 3
    assert strike(kind="checksum")[0] == UNIT[:-2] + bytes([UNIT[-2] ^ 1]) + UNIT[-1:]


def test_late_units_keep_their_order() -> None:
    faults = LineFaults(parse([{"kind": "late", "at": 1.0, "duration": 0.5}]), "A")
    faults.act(1.0)
    assert faults.send([b"a", b"b"], 1.0) == []
    assert faults.next_due() == 1.5
    assert faults.send([b"c"], 1.2) == []
    assert faults.act(1.5) == ([], [b"a", b"b", b"c"])
    assert faults.send([b"d"], 1.6) == [b"d"]


def delays(**fault: Any) -> np.ndarray[Any, np.dtype[np.float64]]:  # noqa: ANN401 -- as above
    """Return by how much each of 2000 units, 37 ms apart, is kept back, in s."""
    faults = LineFaults(parse([{"at": 0.0, "duration": 1e6, **fault}]), "A")
    faults.act(0.0)
    late = []
    for number in range(2000):
        now = 0.037 * (number + 1)
        if not faults.send([UNIT], now):
            late.append(faults.next_due() - now)
            assert faults.act(faults.next_due())[1] == [UNIT]
        else:
            late.append(0.0)
    return np.array(late)


def test_latencies_are_exponential_or_up_to_the_next_poll() -> None:
    late = delays(kind="latency", level=1e-3)
    assert late.mean() == pytest.approx(1e-3, rel=4 / np.sqrt(2000))
    assert late.std() == pytest.approx(1e-3, rel=4 * np.sqrt(2 / 2000))
    late = delays(kind="batching", level=16e-3)
    polls = (0.037 * np.arange(1, 2001) + late) / 16e-3
    assert np.ptp((polls + 0.5 - polls[0]) % 1) < 1e-6  # all at one phase
    assert late.max() <= 16e-3
    assert late.mean() == pytest.approx(8e-3, rel=0.1)  # 37 ms meets 16 phases in turn


def test_a_stalled_device_sends_nothing_and_returns() -> None:
    faults = LineFaults(parse([{"kind": "stall", "at": 1.0, "duration": 0.5, "every": 2.0}]), "A")
    faults.act(1.0)
    assert faults.send([UNIT], 1.4) == []
    assert faults.send([UNIT], 1.5) == [UNIT]
    assert faults.next_due() == 3.0


def test_faults_before_the_start_of_the_device_are_skipped() -> None:
    script = parse([{"kind": "drop", "at": 1.0, "every": 2.0}, {"kind": "reset", "at": 4.0}])
    assert LineFaults(script, "A", begin=6.0).next_due() == 7.0


def test_lasting_faults_may_begin_before_the_start_of_the_device() -> None:
    script = parse([{"kind": "stall", "at": 0.0, "duration": 5.0}])
    for begin, sent in ((4.0, []), (6.0, [UNIT])):
        faults = LineFaults(script, "A", begin=begin)
        faults.act(begin)
        assert faults.send([UNIT], begin) == sent


def test_a_script_has_the_same_effect_in_every_run() -> None:
    script = {"kind": "corrupt", "count": 5}
    assert strike(**script) == strike(**script) != strike(**script, seed=1)


@pytest.mark.parametrize("cut", [100, 33, 1])
def test_faults_change_samples(cut: int) -> None:
    script: list[dict[str, Any]] = [
        {"kind": "spike", "at": 0.205, "level": 1000.0, "channel": 0},
        {"kind": "spike", "at": 0.395, "every": 0.3, "level": -7.0, "channel": 1},
        {"kind": "dead", "at": 0.495, "duration": 0.1, "channel": 2},
        {"kind": "clip", "at": 0.795, "duration": 0.1, "level": 2.0},
        {"kind": "dead", "at": 0.0, "sensors": ["B"]},
    ]
    if cut == 1:  # one sample at a time cannot tell when the one before was
        script = script[2:]
    faults = SampleFaults(parse(script))
    times = np.arange(100) / 100
    pieces = [
        faults.apply("A", np.full((len(some), 3), 5.0), some)
        for some in np.split(times, range(cut, 100, cut))
    ]
    counts = np.concatenate(pieces)
    wanted = np.full((100, 3), 5.0)
    if cut > 1:
        wanted[21, 0] += 1000
        wanted[[40, 70], 1] -= 7
    wanted[50:60, 2] = 0
    wanted[80:90] = 2
    np.testing.assert_array_equal(counts, wanted)


def test_a_moved_sensor_shares_no_motion_and_keeps_its_noise() -> None:
    script = parse([{"kind": "moved", "at": 10.0, "duration": 10.0, "sensors": ["A"]}])
    channels = tuple(ChannelSpec(name, 1.0) for name in "XYZ")
    table = DeviceSpec(("A",), "text", "pty", 200.0, {"A": channels})
    model = scenario("AB")
    found = Source(model, table, faults=SampleFaults(script)).counts("A", 0, 6000)
    here, elsewhere = (World(model, floor=floor).samples("A", 0, 6000) for floor in (0, 1))
    moved = slice(2000, 4000)
    np.testing.assert_array_equal(found[moved], elsewhere[moved])
    np.testing.assert_array_equal(np.delete(found, moved, axis=0), np.delete(here, moved, axis=0))
    noise = World(model).noise("A", 0, 6000)
    motion = np.stack([here - noise, elsewhere - noise])
    power = np.einsum("fnc,gnc->fgc", motion, motion)
    coherence = power[0, 1] / np.sqrt(power[0, 0] * power[1, 1])
    assert np.abs(coherence).max() < 0.1  # six times the error of 6000 samples
    np.testing.assert_allclose(power[1, 1], power[0, 0], rtol=0.2)


def test_errors_in_a_script_are_reported() -> None:
    with pytest.raises(ScenarioError, match="batching has level 0; expected seconds above 0"):
        parse([{"kind": "batching", "at": 1.0}])
    with pytest.raises(ScenarioError) as caught:
        parse([{"kind": "drop"}, {"kind": "melt", "at": -1}])
    assert "faults[1].at" in str(caught.value)
    assert "faults[2].kind = 'melt'" in str(caught.value)
    assert "faults[2].at = -1" in str(caught.value)


DRIVER = driver_type("epson")
SPEED = 8.0
RETRY = 0.05
"""Before a device that could not be opened is tried again, s."""
EVERYTHING = [
    {"kind": kind, "at": 16.0 + k / 3, "every": 3.0, "count": 3}
    for k, kind in enumerate(
        ("drop", "cut", "corrupt", "checksum", "garbage", "duplicate", "merge", "late")
    )
]
EVERYTHING[-1]["duration"] = 0.2
EVERYTHING += [
    {"kind": "stall", "at": 18.9, "every": 3.0, "duration": 0.2},
    {"kind": "jitter", "at": 17.5, "every": 7.0, "duration": 1.0, "level": 0.05},
]


@asynccontextmanager
async def connected(sensor: Sensor, clock: SystemClock) -> AsyncIterator[Session]:
    """Open a sensor however often it takes, as the recorder does."""
    async with AsyncExitStack() as stack:
        while True:
            try:
                session = await stack.enter_async_context(DRIVER.open([sensor], clock))
                break
            except DeviceError:
                await asyncio.sleep(RETRY)
        yield session


async def test_every_received_sample_has_its_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each received sample is the world's at its index: so every gap is exact."""
    monkeypatch.setattr("daq.protocols.sample_counter.SLACK", SPEED)  # a second of a busy machine
    table = device("A", settings={"first_count": 64000})
    log = tmp_path / "struck"
    world = spec(table, speed=SPEED) | {"faults": EVERYTHING, "fault_log": str(log)}
    blocks: list[Block] = []
    events: list[Event] = []
    with serving(world) as (one,):
        (sensor,) = sensors(one, table)
        async with connected(sensor, host_clock(SPEED)) as session:
            async for item in session.read():
                if isinstance(item, Block):
                    blocks.append(item)
                elif isinstance(item, Event):
                    events.append(item)
                if blocks and blocks[-1].end_sample > 3500:
                    break
    struck = [json.loads(line) for line in log.read_text().splitlines()]
    assert {one["kind"] for one in struck} == {fault["kind"] for fault in EVERYTHING}
    assert {event.kind for event in events} == {"checksum", "resynchronised"}
    assert not any(BlockFlag.MISSING_ESTIMATED in block.flags for block in blocks)
    found = {
        block.first_sample + row: tuple(counts)
        for block in blocks
        for row, counts in enumerate(block.counts[:, :3].tolist())
    }
    assert len(found) == sum(block.n_samples for block in blocks)  # none twice
    truth = np.rint(World(scenario("A")).samples("A", 0, 600 * 200) * commands.COUNTS_PER_UNIT)
    place = {tuple(row): index for index, row in enumerate(truth.astype(int).tolist())}
    begin = place[found[0]]
    assert {place.get(counts, -1) - index for index, counts in found.items()} == {begin}
    lost = blocks[-1].end_sample - len(found)
    meanwhile = [one["kind"] for one in struck if one["at"] > begin / 200]
    stalled = meanwhile.count("stall") * 0.2 * 200
    others = len(meanwhile) - meanwhile.count("stall") - meanwhile.count("jitter")
    assert stalled > 0
    assert (
        0.7 * stalled <= lost <= 1.3 * stalled + 4 * others
    )  # a strike takes three frames, or two


@pytest.mark.parametrize(
    ("kind", "port", "error"),
    [
        ("disconnect", "pty", NotConnectedError),
        ("disconnect", "tcp", NotConnectedError),
        ("reset", "pty", NoAnswerError),
    ],
)
async def test_faults_that_end_a_session(kind: str, port: str, error: type[Exception]) -> None:
    table = device("A", port=port)
    fault = {"kind": kind, "at": 8.0, "every": 12.0, "duration": 1.0}
    with serving(spec(table, speed=SPEED) | {"faults": [fault]}) as (one,):
        (sensor,) = sensors(one, table)
        clock = host_clock(SPEED)
        ended = sampled = False
        while True:
            try:
                async with DRIVER.open([sensor], clock) as session:
                    async for _ in session.read():
                        sampled = True
                        if ended:
                            return  # it came back, under the same name
            except (NotConnectedError, NoAnswerError) as came:
                ended = ended or (sampled and isinstance(came, error))
            sampled = False
            await asyncio.sleep(RETRY)


def test_a_script_in_a_file_joins_the_bench(tmp_path: Path) -> None:
    template = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    bench = parse_bench(template)
    script = tmp_path / "faults.toml"
    script.write_text('[[faults]]\nkind = "drop"\nat = 3.0\n', encoding="utf-8")
    wanted = [{"kind": "drop", "at": 3.0}]
    assert specification(with_faults(bench, script), speed=1.0)["faults"] == wanted
    script.write_text("[[faults]]\nat = -3.0\n", encoding="utf-8")
    with pytest.raises(BenchFileError, match=r"(?s)faults\.toml: faults\[1\].*at = -3"):
        with_faults(bench, script)


@pytest.mark.parametrize(
    ("script", "said"),
    [
        (b"faults = 5", r"faults = 5: expected a list"),
        (b"faults = [5]", r"faults\[1\] = 5: "),
        (b"[[fault]]\nat = 3.0", r"fault: unknown key; expected \[\[faults\]\]"),
        (b'[[faults]]\nkind = "dead"\nat = 1\nwhen = 3', r"faults\[1\]\.when = 3: .*expected kind"),
        (b'[[faults]]\nkind = "drop"\nat = 1\nsensors = ["NOPE"]', r"'NOPE': .*expected A, B, C"),
        (b'[[faults]]\nkind = "drop"\nat = 1\nsensors = []', r"sensors = \[\]: "),
        (b'[[faults]]\nkind = "dead"\nat = 1\nchannel = 3', r"channel = 3: expected 0 to 2"),
        (b"# \xff\nfaults = []", r"expected a fault script"),
        (b"faults = ", r"expected a fault script"),
        (None, r"cannot be read"),
    ],
)
def test_a_script_without_effect_is_refused(
    tmp_path: Path, script: bytes | None, said: str
) -> None:
    template = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    path = tmp_path / "faults.toml"
    if script is not None:
        path.write_bytes(script)
    with pytest.raises(BenchFileError, match=r"faults\.toml: .*" + said):
        with_faults(parse_bench(template), path)


@pytest.mark.parametrize("faults", [5, [{"kind": "drop", "at": 1.0, "sensors": ["NOPE"]}]])
def test_a_script_in_the_bench_file_is_checked_as_well(faults: object) -> None:
    template = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    bench = parse_bench(template)
    bench = bench.model_copy(update={"simulation": bench.simulation | {"faults": faults}})
    with pytest.raises(BenchFileError, match=r"simulation: faults.* = .*expected"):
        specification(bench, speed=1.0)


# --- links that recover ----------------------------------------------------------------------


RATE = 200.0
AGE = 5.0


def table(name: str, driver: str, **changes: Any) -> dict[str, Any]:  # noqa: ANN401
    channels = [{"name": axis, "sensitivity": 3e5} for axis in "ZNE"]
    return device(name, driver, channels={name: channels}, **changes)


TABLES = [table("A", "guralp"), table("B", "guralp", port="udp"), table("L", "labjack", port="tcp")]
HURT = ("drop", "corrupt", "cut", "garbage", "duplicate", "merge", "checksum")
FAULTS: list[dict[str, Any]] = [
    {"kind": kind, "at": AGE + 3 + 2.3 * i, "every": 17.0, "sensors": ["A"]}
    for i, kind in enumerate(HURT)
]
FAULTS += [
    {"kind": kind, "at": AGE + 3 + 2.3 * i, "every": 7.0, "count": 2, "sensors": ["B"]}
    for i, kind in enumerate(("drop", "corrupt", "duplicate"))
]
# as soon as somebody reads: again and again
FAULTS += [{"kind": "overflow", "at": AGE, "every": 6.0, "duration": 1.5, "sensors": ["L"]}]
FAULTS += [{"kind": "drop", "at": AGE + 3, "every": 6.0, "count": 2, "sensors": ["L"]}]


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving({**spec(*TABLES, speed=SPEED, age=AGE), "faults": FAULTS}) as devices:
        yield devices


@pytest.mark.parametrize("index", [0, 1])
async def test_a_link_that_recovers_loses_nothing(
    running: tuple[RunningDevice, ...], index: int
) -> None:
    """Frames over a serial line are refused and come again; packets over UDP are asked for."""
    (sensor,) = sensors(running[index], TABLES[index])
    blocks, events = await record(driver_type("guralp"), sensor, 25 * 200, speed=SPEED)
    hurt = [e for e in events if e.kind in {"checksum", "resynchronised"}]
    assert hurt, "the faults did strike"
    assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
    assert not any(b.reason for b in blocks)
    start_ns = blocks[0].device_counter or 0
    assert all((b.device_counter or 0) == start_ns + b.first_sample * 5_000_000 for b in blocks)
    assert np.isfinite(np.concatenate([b.counts for b in blocks]).std())


async def test_a_digitizer_counts_what_it_lost(
    running: tuple[RunningDevice, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Overflows of 1.5 s and lost packets, each gap by the device's own clock."""
    monkeypatch.setattr("daq.protocols.sample_counter.SLACK", SPEED)  # a second of a busy machine
    blocks: list[Block] = []
    events: list[Event] = []
    async with (
        asyncio.timeout(60),
        reading(driver_type("labjack"), sensors(running[2], TABLES[2]), speed=SPEED) as items,
    ):
        async for item in items:
            if isinstance(item, Event):
                events.append(item)
            if not isinstance(item, Block):
                continue
            blocks.append(item)
            # an overflow in which the stream began lies before its first block
            if {b.reason for b in blocks[1:]} >= {"buffer overflow", "lost packet"}:
                break
    assert {e.kind for e in events} == {"overflow", "resynchronised"}
    start = (blocks[0].device_counter or 0) - blocks[0].first_sample * 200_000  # it may begin full
    assert all((b.device_counter or 0) == start + b.first_sample * 200_000 for b in blocks)
    assert all(BlockFlag.MISSING_ESTIMATED not in b.flags for b in blocks)
    overflow = next(i for i, b in enumerate(blocks) if i and b.reason == "buffer overflow")
    missing = blocks[overflow].first_sample - blocks[overflow - 1].end_sample
    assert missing >= 1.5 * RATE - 1  # more where a lost packet falls together with it
    lost = next(i for i, b in enumerate(blocks) if i and b.reason == "lost packet")
    assert blocks[lost].first_sample - blocks[lost - 1].end_sample >= 20
