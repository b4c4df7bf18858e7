"""Checks before a test: what is found in samples whose faults are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.preflight.findings import Problem
from daq.preflight.preflight import check_before_test, is_complete
from daq.preflight.preview import SensorPreview
from tests.tui.example_snapshot import demo_bench

RATE = 200.0
SENSORS = demo_bench().sensors


def previews(seconds: float = 10.0, *, shared: float = 1e-3) -> list[SensorPreview]:
    """Return three sensors in one motion, turned a little, each with its own noise."""
    rng = np.random.default_rng(3)
    n = round(seconds * RATE)
    motion = shared * np.cumsum(rng.normal(size=(n, 3)), axis=0) * 0.05
    return [
        SensorPreview(
            sensor,
            None,
            motion + 1e-5 * rng.normal(size=(n, 3)),
            last_ns=10**10,
            measured_rate=RATE,
        )
        for sensor in SENSORS
    ]


def test_a_sound_bench_has_no_findings() -> None:
    assert check_before_test(previews()) == ()
    assert is_complete(previews())
    assert not is_complete(previews(2.0))


def test_each_fault_is_found_where_it_is() -> None:
    a, b, c = previews()
    samples = a.samples.copy()
    samples[:, 1] = 7.0
    at = np.arange(len(b.samples)) / RATE
    hums = b.samples + np.array([0.0, 0.0, 1.0]) * np.sin(2 * np.pi * 50 * at)[:, None]
    found = check_before_test(
        [
            replace(a, samples=samples, measured_rate=190.0, n_missing=12),
            replace(b, samples=hums, is_clipping=True),
            replace(c, trouble="sensor 'C' on /dev/ttyUSB2: no answer"),
        ]
    )
    assert [(f.problem, f.sensor, f.channel) for f in found] == [
        (Problem.RATE, "A", ""),
        (Problem.MISSING, "A", ""),
        (Problem.DEAD, "A", "Y"),
        (Problem.CLIPPING, "B", ""),
        (Problem.HUM, "B", "Z"),
        (Problem.TROUBLE, "C", ""),
    ]
    assert [f.prevents for f in found] == [True, False, True, True, False, True]
    silent = replace(a, samples=a.samples[:0])
    assert check_before_test([silent])[0].problem is Problem.NO_SAMPLES


@pytest.mark.parametrize("late", [0, 30])
def test_a_sensor_on_another_floor_is_found_however_late_its_samples_are(late: int) -> None:
    a, b, c = previews()
    b = replace(b, samples=b.samples[: len(b.samples) - late], last_ns=10**10 - late * 5_000_000)
    assert check_before_test([a, b, c]) == ()
    other = np.random.default_rng(9).normal(size=c.samples.shape) * 1e-3
    (found,) = check_before_test([a, b, replace(c, samples=other)])
    assert (found.problem, found.sensor) == (Problem.ALONE, "C")


def test_where_no_sensor_shares_motion_none_is_called_alone() -> None:
    assert check_before_test(previews(shared=1e-9)) == ()


def test_poor_clocks_and_offsets_are_found_and_prevent_nothing() -> None:
    a, b, c = previews()
    found = check_before_test(
        [
            replace(a, measured_rate=RATE * 1.004, rate_error=5e-4, arrival_scatter=0.3),
            replace(b, samples=b.samples + np.array([0.0, 0.0, 9.8]), measured_rate=RATE * 1.004),
            replace(
                c,
                samples=c.samples + np.array([7.0, 0.0, 1.0]),
                measured_rate=199.9,
                rate_error=1e-3,
            ),
        ]
    )
    assert [(f.problem, f.sensor) for f in found] == [
        (Problem.CLOCK, "A"),
        (Problem.UNEVEN, "A"),
        (Problem.CLOCK, "B"),
        (Problem.OFFSET, "C"),
    ]
    assert found[0].value == pytest.approx(4000)
    assert found[3].value == pytest.approx(50**0.5, abs=0.01)
    assert not any(f.prevents for f in found)


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
    found = check_before_test([a, replace(b, samples=b.samples[:, columns] * signs), c])
    wanted = [] if problem is None else [(problem, "B", channel)]
    assert [(f.problem, f.sensor, f.channel) for f in found] == wanted


def test_a_vertical_channel_without_gravity_has_been_swapped() -> None:
    a, b, c = previews()  # A has directions: Z is up
    (found,) = check_before_test([replace(a, samples=a.samples + np.array([9.8, 0.1, 0.2])), b, c])
    assert (found.problem, found.sensor, found.channel) == (Problem.SWAPPED, "A", "Z and X")
    assert (
        check_before_test([replace(a, samples=a.samples + np.array([0.3, 0.1, 9.8])), b, c]) == ()
    )
