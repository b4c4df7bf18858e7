"""Stated times that step, and rates that only a part of a recording keeps, up to the noise.

The digitizers are those of `tests.peers.digitizer`, which share no code with the drivers.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.clocks.aligned_recording import AlignedRecording
from daq.devices.seedlink.decoder import SeedLinkDecoder, StreamSelection
from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import RASPBERRY_SHAKE, TextFormat
from daq.errors import CannotAlignError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import Block, BlockFlag, DeviceItem, HostTime
from daq.recorder.block_writer import BlockWriter
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.writer import RecordingWriter
from daq.results.facts.clocks import ClockSet
from daq.results.result import Result
from tests.daq.clocks.recordings import ORIGIN, Sensor, later, write
from tests.peers.digitizer import CODES, START, Digitizer, seedlink
from tests.peers.text_logger import CHANNELS as TEXT_CHANNELS
from tests.peers.text_logger import TextLogger

RATE, SECONDS, SNR = 100, 160.0, 1e3
SETTINGS = Settings(segment=4.0, methods=("three-sensor",))
CHANNELS = tuple(Channel(name=code, sensitivity=1.0) for code in CODES)


def counts(n_sensors: int, n_samples: int) -> list[np.ndarray]:
    rng = np.random.default_rng(11)
    motion = 30_000 * rng.standard_normal((n_samples, 3))
    noise = 30_000 / np.sqrt(SNR) * rng.standard_normal((n_sensors, n_samples, 3))
    return [np.round(motion + each).astype(np.int32) for each in noise]


def arrival(seconds: float) -> HostTime:
    utc = round(START.timestamp() * 1e9) + round(seconds * 1e9)
    return HostTime(5_000_000_000_000 + round(seconds * 1e9), utc)


def estimated(path: Path, items: list[DeviceItem]) -> Snapshot:
    """Record what drivers yield, and estimate."""
    layouts = [SensorLayout(name, CHANNELS, RATE, np.dtype(np.int32)) for name in "ABC"]
    file = RecordingWriter.create(path, sensors=layouts, created=arrival(0))
    writer = BlockWriter(file, dict.fromkeys("ABC", float(RATE)))
    arrived = sorted(items, key=lambda item: item.received.monotonic_ns)
    writer.write([*arrived])
    writer.close(arrival(SECONDS + 1), "the end")
    return estimate([path], SETTINGS)


@pytest.mark.parametrize(
    ("size", "packets"),
    [
        (-0.5, True),
        (3600.0, False),
        *(pytest.param(s, p, marks=pytest.mark.long) for s in (-20.0, 0.3) for p in (True, False)),
    ],
)
def test_a_result_names_when_the_clock_of_a_text_logger_was_set(
    tmp_path: Path, size: float, *, packets: bool
) -> None:
    """Rows and datacast, whose times are not their clock."""
    items: list[DeviceItem] = []
    for name, samples in zip("ABC", counts(3, round(SECONDS * RATE)), strict=True):
        logger = TextLogger(SECONDS, steps=((100.0, size),) if name == "B" else (), seed=ord(name))
        logger.samples = samples
        if packets or name != "B":  # to read a packet costs less than to read its rows
            shake = replace(RASPBERRY_SHAKE, channel_names=TEXT_CHANNELS)
            decoder, sent = TextDecoder(name, shake, sampling_rate=RATE), logger.packets()
            receive = decoder.receive_datagram
        else:
            rows = TextFormat(columns=(1, 2, 3), time_column=0, whole=True)
            decoder, sent = TextDecoder(name, rows, sampling_rate=RATE), logger.rows(0.5)
            receive = decoder.receive
        for data, seconds in sent:
            items += receive(data, arrival(seconds))
    snapshot = estimated(tmp_path / "r.h5", items)
    (fact,) = [each for each in Result(snapshot, SETTINGS).facts if isinstance(each, ClockSet)]
    (setting,) = fact.settings
    assert fact.sensors == ("B",)
    assert setting.step == pytest.approx(size, abs=1e-3)
    assert (setting.utc_ns - arrival(100.0).utc_ns) * 1e-9 == pytest.approx(0, abs=0.3)
    true = 2 * (30_000**2 / SNR) / RATE
    for mean in Result(snapshot, SETTINGS).means("three-sensor", (1.0, 40.0)):
        assert mean.low[0] < 1.1 * true
        assert mean.high[0] > true / 1.1


@pytest.mark.parametrize(
    "steps",
    [
        {"B": ((100.0, -0.5),)},
        pytest.param({"B": ((60.0, 3600.0),), "C": ((110.0, -20.0),)}, marks=pytest.mark.long),
        pytest.param({"A": ((50.0, 0.02), (110.0, -2.0))}, marks=pytest.mark.long),
        pytest.param({"C": ((120.0, -3600.0),)}, marks=pytest.mark.long),
    ],
)
def test_noise_is_right_where_clocks_of_digitizers_are_set(
    tmp_path: Path, steps: dict[str, tuple[tuple[float, float], ...]]
) -> None:
    items: list[DeviceItem] = []
    for name, samples in zip("ABC", counts(3, round(SECONDS * RATE)), strict=True):
        digitizer = Digitizer(SECONDS, RATE, steps=steps.get(name, ()), seed=ord(name))
        digitizer.samples = samples
        chosen = StreamSelection("XX", "STA", tuple(("*", code) for code in CODES), 3)
        decoder = SeedLinkDecoder({name: chosen}, {name: np.dtype(np.int32)}, hold=10.0)
        for sent in digitizer.records():
            items += decoder.receive(seedlink(sent, RATE, sent.number), arrival(sent.arrival))
    snapshot = estimated(tmp_path / "r.h5", items)
    means = Result(snapshot, SETTINGS).means("three-sensor", (1.0, 40.0))
    true = 2 * (30_000**2 / SNR) / RATE
    for mean in means:
        assert 0.8 < mean.mean[0] / true < 1.25
        assert mean.low[0] < 1.1 * true
        assert mean.high[0] > true / 1.1
        assert mean.high[0] / mean.low[0] < 1.5


def lossy(path: Path, *, rate: float = float(RATE), lost: int = 0) -> None:
    """Write sensors of which B loses samples in silence after 200 of 300 s, or samples oddly."""
    made = {}
    for name, samples in zip("ABC", counts(3, 30_000), strict=True):
        made[name] = Sensor(samples, rate=rate if name == "B" else RATE, nominal=RATE)

    def late(block: Block) -> Block:
        is_late = block.sensor == "B" and block.first_sample > 20_000
        return replace(block, received=later(block.received, is_late * round(lost / RATE * 1e9)))

    write(path, made, late)


def test_a_span_before_a_loss_is_estimated_by_its_own_rate(tmp_path: Path) -> None:
    """A recorder of an older version lost 10 s in silence at the 200th second."""
    lossy(tmp_path / "r.h5", lost=1000)
    start = datetime.fromtimestamp(ORIGIN.utc_ns * 1e-9, UTC)
    settings = Settings(
        segment=4.0,
        methods=("three-sensor",),
        start=start,
        end=start + timedelta(seconds=190),
        clocks="arrivals",
    )
    snapshot = estimate([tmp_path / "r.h5"], settings)
    assert abs(snapshot.clocks[1].ppm) < 50


def test_a_finished_recording_can_be_given_its_rate(tmp_path: Path) -> None:
    lossy(tmp_path / "r.h5", rate=101.0)
    with pytest.raises(CannotAlignError, match="101"):
        estimate([tmp_path / "r.h5"], SETTINGS)
    settings = Settings(
        segment=4.0, methods=("three-sensor",), sampling_rates={"B": 101.0}, clocks="arrivals"
    )
    with Recording.open(tmp_path / "r.h5") as recording:
        rates = [sensor.sampling_rate for sensor in recording.sensors]
        snapshot = estimate([recording], settings)
        assert [sensor.sampling_rate for sensor in recording.sensors] == rates != [100.0, 101.0]
    assert abs(snapshot.clocks[1].ppm) < 10


def stating(path: Path, faults: dict[str, tuple[str, float]], *, seconds: float = SECONDS) -> Path:
    """Write sensors that state UTC; half way rows or times of some are wrong, by name.

    "gap": the time steps by so many seconds, and the driver takes it for missing rows; "loss": rows
    of so many seconds are lost in silence, and times follow the count.
    """
    made, n = {}, round(seconds * RATE)
    middle = n // 2
    for name, samples in zip("ABC", counts(3, n), strict=True):
        kind, size = faults.get(name, ("", 0.0))
        lost = round(size * RATE) if kind == "loss" else 0
        gone = slice(middle, middle + lost)
        made[name] = Sensor(np.delete(samples, gone, axis=0), utc=True, restarts=(middle,))

    def wrong(block: Block) -> Block:
        kind, size = faults.get(block.sensor, ("", 0.0))
        first, late, flags = block.first_sample, 0, block.flags
        if first >= middle:
            flags &= ~BlockFlag.CLOCK_RESTART
            late = round(size * 1e9)
        ahead = late if kind == "gap" else 0
        if ahead and first == middle:
            flags |= BlockFlag.MISSING_ESTIMATED
        assert block.device_counter is not None
        return replace(
            block,
            first_sample=first + round(ahead * RATE / 1e9),
            flags=flags,
            device_counter=block.device_counter + ahead,
            received=later(block.received, late - ahead),
        )

    return write(path, made, wrong)


@pytest.mark.parametrize(
    "faults",
    [
        {"B": ("gap", 2.0)},
        {"B": ("loss", 0.5)},
        pytest.param({"C": ("gap", 20.0)}, marks=pytest.mark.long),
        pytest.param({"A": ("gap", 0.3), "C": ("loss", 2.0)}, marks=pytest.mark.long),
        pytest.param({"B": ("gap", 0.02)}, marks=pytest.mark.long),
        pytest.param({"B": ("loss", 0.01)}, marks=pytest.mark.long),
        pytest.param({"B": ("loss", 20.0)}, marks=pytest.mark.long),
        pytest.param({"B": ("gap", 3600.0)}, marks=pytest.mark.long),
    ],
)
def test_noise_is_right_where_stated_times_and_counts_contradict_the_motion(
    tmp_path: Path, faults: dict[str, tuple[str, float]]
) -> None:
    settings = replace(SETTINGS, segment=2.0)
    snapshot = estimate([stating(tmp_path / "r.h5", faults)], settings)
    true = 2 * (30_000**2 / SNR) / RATE
    for mean in Result(snapshot, settings).means("three-sensor", (1.0, 40.0)):
        assert mean.low[0] < 1.1 * true
        assert mean.high[0] > true / 1.1
        assert mean.high[0] / mean.low[0] < 1.5
    found = {clock.sensor: [one.step for one in clock.settings] for clock in snapshot.clocks}
    set_by = {
        name: [pytest.approx(size, abs=1e-3)] * (kind == "gap" and size < 3600)
        for name, (kind, size) in faults.items()
    }
    assert found == {name: set_by.get(name, []) for name in "ABC"}


# --- a clock that cannot be one is refused ---------------------------------------------------


@pytest.mark.parametrize(
    ("ppm", "refused"), [(-800_000.0, True), (2500.0, True), (-900.0, False), (100.0, False)]
)
def test_a_rate_beyond_1000_ppm_is_refused(tmp_path: Path, ppm: float, *, refused: bool) -> None:
    path, rate, n_samples = tmp_path / "r.h5", 100.0, 12_000
    channels = (Channel(name="x", sensitivity=1.0),)
    layouts = [SensorLayout(n, channels, rate, np.dtype("i4"), clock=n) for n in "AB"]
    rng = np.random.default_rng(1)
    with ArrayWriter(path, sensors=layouts, created=HostTime(10**12, 10**18)) as writer:
        for name, error in (("A", 0.0), ("B", ppm)):
            ends = np.arange(100, n_samples + 1, 100) / (rate * (1 + error * 1e-6))
            counts = rng.integers(-100, 100, (n_samples, 1)).astype(np.int32)
            received = np.round(ends * 1e9).astype(np.int64)
            writer.samples(name, counts, block_rows=100, received_ns=received)
    with Recording.open(path) as recording:
        if refused:
            with pytest.raises(CannotAlignError, match=r"sensor 'B' sent .* samples per second"):
                AlignedRecording(recording)
        else:
            AlignedRecording(recording)
