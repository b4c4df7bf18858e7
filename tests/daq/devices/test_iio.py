"""Linux IIO devices: what overflows in the board is a gap of exact length, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.model import Sensor
from daq.devices.iio.driver import IioSession
from daq.devices.iio.protocol import IioDevice, ScanElement, ScanLayout
from daq.devices.interface import DeviceInformation
from daq.devices.registry import driver_type
from daq.errors import WrongDeviceError
from daq.protocols.block import BlockFlag, DeviceItem, HostTime, Quantity, Reading
from sim_devices.server.launch import RunningDevice
from tests.daq.devices.found import blocks_of, events_of, indices
from tests.daq.devices.reading import reading, record
from tests.devices import serving
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import device, sensors, spec

pytestmark = pytest.mark.devices

RATE = 100.0
DRIVER = driver_type("iio")
TABLE = device("A", "iio", port="tcp", sampling_rate=RATE)
ELEMENTS = (
    ScanElement.of("accel_x", 0, "le:s32/32>>0", ()),
    ScanElement.of("timestamp", 1, "le:s64/64>>0", ()),
)


def of(running: RunningDevice, **settings: Any) -> Sensor:  # noqa: ANN401
    (one,) = sensors(running, TABLE, settings=settings)
    return one


async def test_any_channels_in_any_order() -> None:
    with serving(spec(TABLE, speed=4.0)) as (running,):
        plain, _ = await record(DRIVER, of(running), 50, speed=4.0)
        inputs = ("accel_z", "accel_x", "accel_y")
        turned, _ = await record(DRIVER, of(running, inputs=inputs), 50, speed=4.0)
    first = {block.device_counter: block for block in plain}
    assert plain[0].counts.shape[1] == 3
    assert turned[0].device_counter not in first
    assert turned[0].counts.std(axis=0).min() > 0


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"device": "adxl357"}, r"there are: adxl355 \(iio:device0\); set settings.device"),
        (
            {"inputs": ("accel_x", "accel_y", "gyro_z")},
            "has the channels accel_x, accel_y, accel_z",
        ),
        ({"inputs": ("accel_x",)}, "expected 3 of them"),
    ],
)
async def test_another_device_is_refused(settings: dict[str, Any], said: str) -> None:
    with serving(spec(TABLE)) as (running,), pytest.raises(WrongDeviceError, match=said):
        await record(DRIVER, of(running, **settings), 1)


async def test_the_temperature_is_read_between_two_buffers() -> None:
    readings: list[Reading] = []
    with serving(spec(TABLE, speed=60.0)) as (running,):
        async with reading(DRIVER, [of(running)], speed=60.0) as items:
            async for item in items:
                readings += [item] if isinstance(item, Reading) else []
                if len(readings) == 2:
                    break
    assert all(one.quantity is Quantity.TEMPERATURE for one in readings)
    assert all(abs(one.value - 25.0) <= 0.6 for one in readings)
    minutes = [one.received.monotonic_ns // 60_000_000_000 for one in readings]
    assert minutes[1] == minutes[0] + 1


def decoded(
    *buffers: Sequence[float] | NDArray[np.int64],
    jitter: float = 0.0,
    arrivals: Sequence[float] | None = None,
    stated: NDArray[np.float64] | None = None,
) -> list[DeviceItem]:
    """Return what becomes of scans at these numbers of a sample, their values.

    Each buffer arrives with its last scan, or when the number of ``arrivals`` is sampled. The board
    states these times, or ``stated`` by the number of the scan.
    """
    session = IioSession(
        cast("Any", None),  # nothing is read
        sensor_at("iio://x", "iio", rate=RATE, channels="x"),
        IioDevice("iio:device0", "x", ELEMENTS, ()),
        ("accel_x",),
        information=(DeviceInformation("A", sampling_rate=RATE),),
        patience=1.0,
    )
    layout, rng = ScanLayout(ELEMENTS), np.random.default_rng(1)
    found: list[DeviceItem] = []
    for numbers, arrival in zip(buffers, arrivals or [n[-1] for n in buffers], strict=True):
        late = rng.uniform(-jitter, jitter, len(numbers)) / RATE
        seconds = (
            np.array(numbers) / RATE + late + 1.8e9 if stated is None else stated[np.array(numbers)]
        )
        times = np.rint(seconds * 1e9).astype(np.int64)
        scans = layout.encode({"accel_x": np.array(numbers, np.int64), "timestamp": times})
        found += session._blocks(scans, HostTime(round(arrival / RATE * 1e9), 0))  # noqa: SLF001
    return found


@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_lost_scans_are_gaps_where_the_times_have_them(jitter: float) -> None:
    """Within a buffer and between two; the value of each scan is its number."""
    first = [*range(3)], [*range(3, 6)], [*range(6, 13), *range(17, 30)]
    numbers = *first, [*range(30, 40), *range(140, 150)], [*range(150, 160)], [*range(190, 200)]
    blocks = blocks_of(decoded(*numbers, jitter=jitter))
    for block in blocks:
        assert block.counts[:, 0].tolist() == list(range(block.first_sample, block.end_sample))
        assert BlockFlag.MISSING_ESTIMATED not in block.flags
    assert [b.first_sample for b in blocks if b.reason] == [17, 140, 190]
    assert BlockFlag.CLOCK_RESTART in blocks[0].flags


@pytest.mark.parametrize("step", [-3600.0, -0.3, -0.02, 0.02, 0.3, 3600.0])
def test_scans_of_a_clock_that_is_set_are_all_kept(step: float) -> None:
    """Buffers of 0.2 s, which arrive 0.5 ms late on average."""
    rng = np.random.default_rng(7)
    numbers = np.arange(4000)
    seconds = numbers / RATE + rng.uniform(0, 1e-4, len(numbers))
    stated = 1.8e9 + seconds + step * (numbers >= 2007)
    buffers = np.split(numbers, range(20, 4000, 20))
    arrivals = [float(n[-1] + RATE * rng.exponential(5e-4)) for n in buffers]
    found = decoded(*buffers, arrivals=arrivals, stated=stated)
    blocks = blocks_of(found)
    assert np.array_equal(indices(blocks), numbers)
    assert np.array_equal(np.concatenate([b.counts[:, 0] for b in blocks]), numbers)
    assert [item.kind for item in events_of(found)] == ["reset"]


@pytest.mark.parametrize("n_lost", [5, 60, 900])
def test_scans_lost_in_steady_buffers_are_an_exact_gap(n_lost: int) -> None:
    rng = np.random.default_rng(8)
    numbers = np.array([n for n in range(4000) if not 2007 <= n < 2007 + n_lost])
    buffers = np.split(numbers, range(20, len(numbers), 20))
    arrivals = [float(n[-1] + RATE * rng.exponential(5e-4)) for n in buffers]
    blocks = blocks_of(decoded(*buffers, arrivals=arrivals))
    assert [b.first_sample for b in blocks if b.reason] == [2007 + n_lost]
    assert not any(b.flags & BlockFlag.MISSING_ESTIMATED for b in blocks)
    assert all(b.counts[:, 0].tolist() == [*range(b.first_sample, b.end_sample)] for b in blocks)


def test_scans_lost_while_the_network_was_held_up_are_a_gap() -> None:
    """The board's buffer was read late, and had overflowed."""
    found = decoded([0, 1, 2], [3, 4, 5], [6, 7], [1006, 1007], arrivals=[2, 5, 1006, 1007])
    blocks = blocks_of(found)
    assert [b.first_sample for b in blocks if b.reason] == [1006]
    assert len(blocks) == len(found)
