"""The check list: what is found in samples whose faults are known, and what is not checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from daq.bench.model import DataSheet
from daq.devices.interface import DeviceInformation
from daq.preflight.findings import Check, CheckFinding, CheckOutcome, CheckRow, Problem
from daq.preflight.preflight import check_list, is_complete
from daq.preflight.preview import SensorPreview, arrivals
from daq.protocols.block import Block, HostTime
from estimator.checks.sensitivities import Cause
from estimator.types import FloatArray
from tests.tui.example_snapshot import demo_bench
from tui.output.check_list import MERGED, lines

RATE = 200.0
BENCH = demo_bench()
SENSORS = tuple(
    each.model_copy(
        update={"serial_number": f"S{each.name}", "data_sheet": DataSheet(full_scale=100.0)}
    )
    for each in BENCH.sensors
)


def previews(
    seconds: float = 10.0, *, shared: float = 1e-3, turned: bool = False, seed: int = 3
) -> list[SensorPreview]:
    """Return three sensors in one motion, each with its own noise."""
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE)
    motion = shared * np.cumsum(rng.normal(size=(n, 3)), axis=0) * 0.05
    turns = Rotation.random(3, rng=seed).as_matrix() if turned else np.stack([np.eye(3)] * 3)
    return [
        SensorPreview(
            sensor,
            DeviceInformation(sensor.name, serial_number=sensor.serial_number),
            motion @ turn.T + 1e-5 * rng.normal(size=(n, 3)),
            last_ns=10**10,
            measured_rate=RATE,
        )
        for sensor, turn in zip(SENSORS, turns, strict=True)
    ]


def findings(sensors: list[SensorPreview]) -> list[CheckFinding]:
    return [row.finding for row in check_list(BENCH, sensors) if row.finding is not None]


def failures(sensors: list[SensorPreview]) -> list[tuple[Problem, str, str]]:
    rows = check_list(BENCH, sensors)
    found = [row.finding for row in rows if row.outcome is CheckOutcome.FAILED]
    return [(each.problem, each.sensor, each.channel) for each in found if each is not None]


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_sound_bench_passes_every_check(seed: int, turned: bool) -> None:
    assert check_list(BENCH, previews(turned=turned, seed=seed)) == tuple(map(CheckRow, Check))


def in_unit(each: SensorPreview, unit: str, samples: FloatArray | None = None) -> SensorPreview:
    """Return a sensor whose channels have another unit."""
    channels = tuple(replace(c, unit=unit) for c in each.sensor.channels)
    sheet = DataSheet(full_scale=100.0, unit="m/s²")
    sensor = each.sensor.model_copy(update={"channels": channels, "data_sheet": sheet})
    return replace(each, sensor=sensor, samples=each.samples if samples is None else samples)


@pytest.mark.parametrize("turned", [False, True])
def test_a_sound_bench_of_several_units_passes_every_check(turned: bool) -> None:
    a, b, c = previews(turned=turned)
    velocity = np.cumsum(c.samples, axis=0) / RATE
    sensors = [in_unit(a, "g", a.samples / 9.80665), b, in_unit(c, "m/s", velocity)]
    assert check_list(BENCH, sensors) == tuple(map(CheckRow, Check))


@pytest.mark.parametrize(("unit", "cause"), [("g", Cause.GRAVITY), ("mm/s²", Cause.GAIN_SWITCH)])
def test_a_sensitivity_of_another_unit_is_named(unit: str, cause: Cause) -> None:
    a, b, c = previews()
    assert failures([in_unit(a, unit), b, c]) == [(Problem.SENSITIVITY, "A", "")]
    found = [each for each in findings([in_unit(a, unit), b, c]) if each.cause is not None]
    assert [each.cause for each in found] == [cause]


def test_enough_samples_are_awaited() -> None:
    assert is_complete(previews())
    assert not is_complete(previews(2.0))
    rows = check_list(BENCH, previews(2.0))
    unknown = {row.check for row in rows if row.outcome is CheckOutcome.NOT_CHECKED}
    assert unknown >= {Check.CHANNELS, Check.HUM, Check.SENSITIVITIES, Check.POLARITY, Check.MOTION}
    assert all(row.outcome is not CheckOutcome.FAILED for row in rows)


def test_each_fault_is_found_where_it_is() -> None:
    a, b, c = previews()
    samples = a.samples.copy()
    samples[:, 1] = 7.0
    at = np.arange(len(b.samples)) / RATE
    hums = b.samples + np.array([0.0, 0.0, 1.0]) * np.sin(2 * np.pi * 50 * at)[:, None]
    sensors = [
        replace(a, samples=samples, measured_rate=190.0, n_missing=120),
        replace(b, samples=hums, is_clipping=True),
        replace(c, trouble="sensor 'C' on /dev/ttyUSB2: no answer", information=None),
    ]
    assert failures(sensors) == [
        (Problem.TROUBLE, "C", ""),
        (Problem.RATE, "A", ""),
        (Problem.MISSING, "A", ""),
        (Problem.DEAD, "A", "Y"),
        (Problem.CLIPPING, "B", ""),
        (Problem.HUM, "B", "Z"),
    ]
    # Two sensors without a third say nothing of each other: one line, whatever is moot.
    rows = check_list(BENCH, sensors)
    (left_out,) = (row.finding for row in rows if row.outcome is CheckOutcome.NOT_CHECKED)
    assert left_out == CheckFinding(Problem.LEFT_OUT, "C", text="motion, sensitivities, polarity")
    assert {row.check for row in rows} == set(Check) - {
        *(Check.MOTION, Check.SENSITIVITIES, Check.POLARITY),
    }
    silent = replace(a, samples=a.samples[:0])
    assert failures([silent, b, c])[0] == (Problem.NO_SAMPLES, "A", "")


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("late", [0, 30])
def test_a_channel_in_g_is_named_with_its_factor(late: int, turned: bool) -> None:
    a, b, c = previews(turned=turned)
    b = replace(b, samples=b.samples * np.array([1, 1 / 9.80665, 1]))
    n = len(b.samples) - late
    b = replace(b, samples=b.samples[:n], last_ns=10**10 - late * 5_000_000)
    found = [each for each in findings([a, b, c]) if each.problem is Problem.SENSITIVITY]
    assert [(each.sensor, each.channel, each.against) for each in found] == [("B", "Y", ("A", "C"))]
    assert found[0].value == pytest.approx(1 / 9.80665, rel=0.03)
    assert found[0].cause is Cause.GRAVITY


@pytest.mark.parametrize(("factor", "cause"), [(2.0, Cause.FACTOR_TWO), (10.4, Cause.GAIN_SWITCH)])
def test_a_whole_sensor_may_be_off(factor: float, cause: Cause) -> None:
    a, b, c = previews(turned=True)
    found = failures([a, b, replace(c, samples=c.samples * factor)])
    assert found == [(Problem.SENSITIVITY, "C", "")]  # one cause, one row
    (one, *_) = findings([a, b, replace(c, samples=c.samples * factor)])
    assert one.cause is cause


def test_weak_motion_shows_no_sensitivities() -> None:
    sensors = previews(shared=1e-9)
    assert failures(sensors) == []
    unknown = {row.check for row in check_list(BENCH, sensors) if row.finding is not None}
    assert unknown == {Check.MOTION, Check.SENSITIVITIES, Check.POLARITY}


@pytest.mark.parametrize("late", [0, 30])
def test_a_sensor_on_another_floor_is_found_however_late_its_samples_are(late: int) -> None:
    a, b, c = previews()
    b = replace(b, samples=b.samples[: len(b.samples) - late], last_ns=10**10 - late * 5_000_000)
    assert findings([a, b, c]) == []
    other = np.random.default_rng(9).normal(size=c.samples.shape) * 1e-3
    assert (Problem.ALONE, "C", "") in failures([a, b, replace(c, samples=other)])


@pytest.mark.parametrize(
    ("late", "rate"), [(-1.3, 50.0), (-0.12, 128.0), (0.12, 200.0), (1.3, 128.0)]
)
def test_devices_that_send_packets_late_or_have_another_rate_share_the_motion(
    late: float, rate: float
) -> None:
    """A Güralp digitizer beside an accelerometer that sends each sample was said to be alone."""
    rng = np.random.default_rng(5)
    spectrum = rng.normal(size=(600, 3)) + 1j * rng.normal(size=(600, 3))
    frequency = 0.02 + np.arange(600) / 25.0  # up to 24 Hz, over more than the recording
    sensors = []
    for each, own, shift in zip(previews(), (RATE, RATE, rate), (0.0, 0.0, late), strict=True):
        times = shift - np.arange(round(10 * own))[::-1] / own
        motion = np.real(np.exp(2j * np.pi * np.outer(times, frequency)) @ spectrum) * 1e-3
        motion += 1e-3 * rng.normal(size=motion.shape)
        sensor = each.sensor.model_copy(update={"sampling_rate": own})
        sensors.append(replace(each, sensor=sensor, samples=motion, measured_rate=own))
    found = findings(sensors)
    assert [each.problem for each in found if each.problem is not Problem.TOO_SLOW] == []


def test_polled_samples_are_put_at_even_instants() -> None:
    times_ns = np.cumsum(np.random.default_rng(1).integers(2_000_000, 30_000_000, 400))
    sensor = SENSORS[0]
    blocks = [
        Block(
            sensor.name,
            n,
            np.full((1, len(sensor.channels)), at_ns * 1e-3),
            HostTime(at_ns, 0),
            instants_ns=np.array([at_ns]),
        )
        for n, at_ns in enumerate(times_ns.tolist())
    ]
    seen = SensorPreview.of(sensor, None, blocks)
    steps = np.diff(seen.samples * sensor.channels[0].sensitivity, axis=0)
    np.testing.assert_allclose(steps, 1e6 / sensor.sampling_rate, rtol=1e-6)
    assert (seen.n_missing, seen.last_ns) == (0, times_ns[-1])


def test_gains_of_samples_polled_unevenly_are_not_compared() -> None:
    a, b, c = previews()
    polled = replace(c, samples=1.3 * c.samples, is_polled=True, arrival_scatter=0.2 / RATE)
    assert failures([a, b, polled]) == []
    unknown = [each for each in findings([a, b, polled]) if each.problem is Problem.UNEVEN]
    assert [each.sensor for each in unknown] == ["C", "C"]  # sensitivities, polarity
    assert failures([a, b, replace(polled, arrival_scatter=0.0)]) != []


def test_identities_are_compared_and_unknown_ones_are_no_success() -> None:
    a, b, c = previews()
    other = replace(a, information=DeviceInformation("A", serial_number="X"), trouble="expected SA")
    rows = check_list(BENCH, [other, replace(b, information=DeviceInformation("B")), c])
    found = [row.finding for row in rows if row.check is Check.IDENTITY]
    assert [each and each.problem for each in found] == [
        Problem.WRONG_DEVICE,
        Problem.NO_SERIAL_NUMBER,
    ]
    (left_out,) = [row.finding for row in rows if row.check is Check.PORTS]
    assert (left_out and left_out.problem, left_out and left_out.sensor) == (Problem.LEFT_OUT, "A")


def test_nothing_passes_where_nothing_is_sent() -> None:
    trouble = "no answer"
    silent = [
        replace(each, trouble=trouble, information=None, samples=each.samples[:0])
        for each in previews()
    ]
    rows = check_list(BENCH, silent)
    assert {row.check for row in rows if row.outcome is CheckOutcome.PASSED} == {Check.DISK}
    assert [row.outcome for row in rows].count(CheckOutcome.FAILED) == 3


def test_levels_near_full_scale_and_unknown_ones() -> None:
    a, b, c = previews()
    no_sheet: dict[str, Any] = {"data_sheet": None}
    found = findings(
        [
            replace(a, samples=a.samples + np.array([0, 95.0, 0])),
            replace(b, sensor=b.sensor.model_copy(update=no_sheet | {"driver": "nidaqmx"})),
            replace(c, sensor=c.sensor.model_copy(update=no_sheet)),  # its driver knows
        ]
    )
    assert found[0].problem is Problem.NEAR_FULL_SCALE
    assert (found[0].sensor, found[0].channel) == ("A", "Y")
    assert found[0].value == pytest.approx(0.95, abs=0.01)
    assert [e.sensor for e in found if e.problem is Problem.NO_FULL_SCALE] == ["B"]
    beyond = replace(c, samples=c.samples + np.array([0, 0, 14.0 * 9.80665]))
    beyond = replace(beyond, sensor=c.sensor.model_copy(update=no_sheet))
    (near,) = (e for e in findings([a, b, beyond]) if e.problem is Problem.NEAR_FULL_SCALE)
    assert (near.sensor, near.channel) == ("C", "Z")
    assert near.value == pytest.approx(14 / 15, abs=0.01)


def test_mains_of_all_sensors_may_be_motion() -> None:
    at = np.arange(2000) / RATE
    mains = np.sin(2 * np.pi * 50 * at)[:, None]
    found = findings([replace(each, samples=each.samples + mains) for each in previews()])
    assert {each.problem for each in found} == {Problem.COMMON_HUM}


def test_poor_clocks_are_found_and_uneven_ones_are_unknown() -> None:
    a, b, c = previews()
    found = findings(
        [
            replace(a, measured_rate=RATE * 1.004, rate_error=5e-4, arrival_scatter=0.3),
            replace(b, measured_rate=RATE * 1.004),
            replace(c, measured_rate=199.9, rate_error=1e-3),
        ]
    )
    assert [(f.problem, f.sensor) for f in found] == [
        (Problem.RATE, "B"),
        (Problem.UNEVEN, "A"),
        (Problem.CLOCK, "B"),
    ]
    assert found[2].value == pytest.approx(4000)


def test_an_offset_is_neither_right_nor_wrong() -> None:
    a, b, c = previews()
    up, tilted = np.array([0.0, 0.0, 9.8]), np.array([7.0, 0.0, 1.0])
    (found,) = findings(
        [a, replace(b, samples=b.samples + up), replace(c, samples=c.samples + tilted)]
    )
    assert (found.problem, found.sensor) == (Problem.OFFSET, "C")
    assert found.value == pytest.approx(50**0.5, abs=0.01)


@pytest.mark.parametrize(
    ("columns", "signs", "problem", "channel"),
    [
        ([1, 0, 2], [1, 1, 1], Problem.SWAPPED, "X and Y"),
        ([0, 2, 1], [1, 1, 1], Problem.SWAPPED, "Y and Z"),
        ([0, 1, 2], [1, 1, -1], Problem.REVERSED, "Z"),
        ([0, 1, 2], [-1, -1, 1], None, ""),  # turned by half a turn
        ([1, 2, 0], [1, 1, 1], None, ""),  # a rotation as well
    ],
)
def test_swapped_and_reversed_channels_are_told_from_turned_sensors(
    columns: list[int], signs: list[int], problem: Problem | None, channel: str
) -> None:
    a, b, c = previews()
    found = failures([a, replace(b, samples=b.samples[:, columns] * signs), c])
    assert found == ([] if problem is None else [(problem, "B", channel)])


def test_a_vertical_channel_without_gravity_has_been_swapped() -> None:
    a, b, c = previews()  # A has directions: Z is up
    (found,) = failures([replace(a, samples=a.samples + np.array([9.8, 0.1, 0.2])), b, c])
    assert found == (Problem.SWAPPED, "A", "Z and X")
    assert failures([replace(a, samples=a.samples + np.array([0.3, 0.1, 9.8])), b, c]) == []


def test_single_channels_upside_down_are_reversed() -> None:
    vertical = [
        replace(
            each,
            sensor=each.sensor.model_copy(update={"channels": each.sensor.channels[2:]}),
            samples=each.samples[:, 2:],
        )
        for each in previews()
    ]
    assert failures(vertical) == []
    a, b, c = vertical
    assert failures([a, b, replace(c, samples=-c.samples)]) == [(Problem.REVERSED, "C", "Z")]


def test_a_disk_without_room_fails() -> None:
    year = check_list(BENCH, previews(), duration=1e13)
    (found,) = (row.finding for row in year if row.check is Check.DISK)
    assert found is not None
    assert found.problem is Problem.DISK_FULL
    assert found.wanted == pytest.approx(4 * 9 * 200 * 1e13)


@pytest.mark.parametrize(
    ("late", "expected"),
    [
        (lambda at: 0.0 * at, None),
        (lambda at: 0.025 * at, Problem.RATE),
        (lambda at: 0.35 * np.maximum(at / 10 - 0.6, 0) / 0.4, Problem.UNEVEN),
        (lambda at: 0.25 * (np.floor(at / 2.5) % 2), Problem.UNEVEN),
    ],
    ids=["right", "another rate", "a backlog at the end", "held up now and then"],
)
def test_a_rate_that_a_busy_host_reads_is_not_called_wrong(
    late: Callable[[FloatArray], FloatArray], expected: Problem | None
) -> None:
    """Ten seconds of blocks of 0.1 s, and by how much they are read late."""
    rng = np.random.default_rng(3)
    at = np.linspace(0.0, 10.0, 101)
    read = at + late(at) + rng.uniform(0, 0.004, at.size)
    counts = np.zeros((20, 3), np.int32)
    blocks = [
        Block("A", 20 * n, counts, HostTime(round(each * 1e9), 0)) for n, each in enumerate(read)
    ]
    known = arrivals(blocks)
    a, b, c = previews()
    a = replace(a, measured_rate=known.rate, rate_error=known.error, arrival_scatter=known.scatter)
    (row,) = [each for each in check_list(BENCH, [a, b, c]) if each.check is Check.RATES]
    assert (None if row.finding is None else row.finding.problem) == expected


def test_one_cause_of_all_channels_of_a_sensor_is_one_row() -> None:
    a, b, c = previews()
    at = np.arange(len(b.samples)) / RATE
    hum = 0.01 * np.sin(2 * np.pi * 50 * at)[:, None]
    found = failures([replace(a, samples=0 * a.samples), replace(b, samples=b.samples + hum), c])
    assert (Problem.DEAD, "A", "") in found
    assert (Problem.HUM, "B", "") in found
    assert sum(problem in {Problem.DEAD, Problem.HUM} for problem, _, _ in found) == 2
    one = np.array([1.0, 0.0, 0.0])
    assert failures([a, replace(b, samples=b.samples + hum * one), c]) == [(Problem.HUM, "B", "X")]


def test_counts_that_wrap_repeat_or_lack_codes_are_found() -> None:
    """From raw counts: no full scale is known."""
    rng = np.random.default_rng(5)
    at = np.arange(2000) / RATE
    swell = np.rint(40_000 * np.sin(2 * np.pi * 0.7 * at) + rng.normal(0, 9, 2000))
    noise = np.rint(rng.normal(0, 3000, (2000, 3)))
    held = noise[(np.arange(2000) * 0.4).astype(int)]
    wrapped = noise.copy()
    wrapped[:, 0] = (swell + 32768) % 65536 - 32768
    stuck = noise.copy()
    stuck[:, 2] = stuck[:, 2].astype(np.int64) & ~(1 << 4)
    found = []
    for sensor, counts in zip(SENSORS, (wrapped, held, stuck), strict=True):
        now = HostTime(10**10, 10**10)
        blocks = [Block(sensor.name, 0, counts.astype(np.int32), now)]
        found.append(SensorPreview.of(sensor, None, blocks))
    of_counts = {Problem.WRAPPING, Problem.REPEATS, Problem.STUCK_BIT}
    known = {
        (each.problem, each.sensor, each.channel): each
        for each in findings(found)
        if each.problem in of_counts
    }
    assert set(known) == {
        (Problem.WRAPPING, "A", "X"),
        (Problem.REPEATS, "B", ""),
        (Problem.STUCK_BIT, "C", "Z"),
    }
    assert known[Problem.WRAPPING, "A", "X"].value == 16
    repeats = known[Problem.REPEATS, "B", ""]
    assert repeats.value == pytest.approx(80.0, rel=0.01)
    assert repeats.wanted == RATE


@pytest.mark.parametrize("problem", sorted(MERGED))
def test_what_is_not_checked_of_several_sensors_is_one_sentence(problem: Problem) -> None:
    rows = [CheckRow(Check.RATES, CheckFinding(problem, name)) for name in "AB"]
    (line,) = lines(rows)
    assert "A and B" in line.plain
    assert "because A and B" not in line.plain  # is, or are
