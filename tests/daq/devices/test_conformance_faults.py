"""Every driver in every mode, recorded through what goes wrong on its line.

All modes are recorded at once, each with its own faults, over and over until every kind has struck
every device and all have gone on. Then what was recorded is held against the world: each sample in
its place, and what was sampled meanwhile a gap. (That nothing is lost that was sent is the matter
of tests.acceptance.)
"""

from __future__ import annotations

import asyncio
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.model import Bench
from daq.errors import DeviceError
from daq.protocols.block import BlockFlag
from daq.recorder.connection import MAX_RETRY_DELAY
from daq.recorder.recorder import RecorderStatus, record
from daq.recording.reader import Recording, SensorRecord
from tests.daq.devices.driver_modes import CASES, Served, serving_all, world_clock
from tests.devices import host_clock, run

pytestmark = [pytest.mark.devices, pytest.mark.timeout(240)]

SPEED = 4.0
BEGIN = 15.0
"""World time by which the recorder has started, s."""
SPACING = 2.0
"""Between two faults of one device, s; and beyond it, where a device may have to be set up anew:"""
SLOWER = {"registers rtu": 3.0}
"""Instead, where a reply that is lost is waited for so long."""
LONGER = {"merge": 2.0, "stall": 3.0, "overflow": 2.0, "reset": 8.0, "disconnect": 9.0}
"""After a reset so long that the next fault meets a device that sends again."""
KINDS = {
    "connected", "disconnected", "late", "stalled", "resynchronised", "checksum", "reset",
    "overflow", "status", "refused",
}  # fmt: skip
"""Of events, as ``daq.protocols.block`` has them."""
ROUNDS = 3
"""What has not struck by then need not: now and then a busy host has nothing to be struck."""
PATIENCE = 180.0
HELD_UP = 1.0
"""What a busy host may be held up, s: drivers bear it, and most estimated lengths are less off."""

_PACKETS: dict[str, dict[str, Any]] = {
    "drop": {},
    "duplicate": {"count": 2},
    "late": {"duration": 0.6},
    "stall": {"duration": 1.6},
    "disconnect": {"duration": 4.0},
}
"""What can happen to what comes whole or not at all."""
_GARBAGE = {"garbage": {"count": 40}, **_PACKETS}
_XOR = {"cut": {}, "corrupt": {}, "checksum": {}, **_GARBAGE}
"""Where bytes come one by one, and eight bits tell that one was changed."""
_CHECKED = {"merge": {}, **_XOR, "cut": {"count": 5}, "corrupt": {"count": 4}}
_RESET: dict[str, dict[str, Any]] = {"reset": {}}
_LABJACK = {"overflow": {"duration": 1.5}, **_RESET, **_GARBAGE}
FAULTS: dict[str, dict[str, dict[str, Any]]] = {
    "epson": _RESET | _CHECKED,
    "registers rtu": _RESET | {k: _CHECKED[k] for k in ("merge", "corrupt", "garbage", *_PACKETS)},
    "registers tcp": _RESET | _PACKETS,
    "labjack": _LABJACK,
    "labjack polled": {k: keys for k, keys in _LABJACK.items() if k != "drop"},  # a stall is that
    "guralp serial": _RESET | _CHECKED,
    "scream udp": _RESET | _GARBAGE,
    "scream tcp": _RESET | _GARBAGE,
    "fifo": _CHECKED,  # what a power failure takes is not always noticed: no "reset"
    "fifo tcp": _CHECKED,
    "seedlink 4": _RESET | _GARBAGE,
    "seedlink 3": _RESET | _GARBAGE,
    "seedlink tls": _RESET | _GARBAGE,
    "iio": {  # the reply that a stall takes is waited for until the end
        "late": {"duration": 0.6},
        "overflow": {"duration": 1.5},
        "stall": {"duration": 1.6},
        **_RESET,
        "disconnect": {"duration": 4.0},
    },
    "text serial": _RESET | _XOR,
    "text tcp": _RESET | _PACKETS,
    "text udp": _RESET | _GARBAGE,
}
"""What strikes each mode's device, in this order."""
COUNT_ON = (
    "epson",
    "labjack",
    "labjack polled",
    "guralp serial",
    "scream udp",
    "scream tcp",
    "seedlink 4",
    "seedlink 3",
    "seedlink tls",
)
"""Gaps are exact, also over a pulled cable; but for one at most after a power failure."""


def places(mode: str) -> dict[str, float]:
    """Return when each kind strikes a mode's device, s after a round begins; and when it ends."""
    found, at = {}, 0.0
    for kind in FAULTS[mode]:
        found[kind] = at
        at += SLOWER.get(mode, SPACING) + LONGER.get(kind, 0.0)
    return {**found, "end": at}


ROUND = max(places(mode)["end"] for mode in FAULTS) + 0.37


def script() -> list[dict[str, Any]]:
    """Return the fault script: one kind after the other at each device, all pulled out last."""
    return [
        {
            "kind": kind,
            "sensors": CASES[mode].get("sensors", [f"{mode} 1"]),
            "at": BEGIN + ROUND - places(mode)["end"] + places(mode)[kind] + 0.1 * turn,
            "every": ROUND,
            **keys,
        }
        for turn, (mode, kinds) in enumerate(FAULTS.items())
        for kind, keys in kinds.items()
    ]


async def _recorded(served: Served, path: Path) -> dict[str, list[str]]:
    """Record all modes; return the faults of each one's device since all were being recorded."""
    world = world_clock(served.world)
    stop = asyncio.Event()
    begun = done = math.inf
    struck: dict[str, list[str]] = {}
    when_struck: dict[str, int] = {}

    def look(status: RecorderStatus) -> None:
        nonlocal begun, done, struck, when_struck
        now, samples = world.now(), {name: one.samples for name, one in status.sensors.items()}
        if begun == math.inf and min(samples.values()):
            begun = now
        if when_struck:
            if all(samples[name] > before for name, before in when_struck.items()):
                stop.set()
            return
        struck = {m: [one["kind"] for one in served.struck(m) if one["at"] > begun] for m in CASES}
        everything = all(set(kinds) == set(struck[mode]) for mode, kinds in FAULTS.items())
        if everything or now > begun + ROUNDS * ROUND:
            done = min(done, now)
        if now > done + LONGER["disconnect"]:  # what grows from now on is there again
            when_struck = samples

    sensors = tuple(sensor for mode in CASES for sensor in served.sensors(mode))
    bench = Bench(name="all", sampling_rate=20.0, sensors=sensors)
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                await record(bench, path, clock=host_clock(SPEED), stop=stop, acknowledged=look)
            except* DeviceError:  # something went wrong just when it was to begin
                await asyncio.to_thread(path.unlink, missing_ok=True)
            else:
                return struck


def test_every_mode_is_tested() -> None:
    assert set(FAULTS) == set(CASES)


@pytest.mark.long
def test_each_sample_has_its_index(
    tmp_path: Path, subtests: pytest.Subtests, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One test, for all modes are recorded once."""
    for module in ("protocols.sample_counter", "devices.labjack.stream"):
        monkeypatch.setattr(f"daq.{module}.SLACK", 2 * HELD_UP * SPEED)
    monkeypatch.setattr("daq.devices.labjack.driver.SLACK", 2 * HELD_UP * SPEED)
    monkeypatch.setattr("daq.recorder.connection.MAX_RETRY_DELAY", MAX_RETRY_DELAY / SPEED)
    path = tmp_path / "all.h5"
    with serving_all(speed=SPEED, faults=script()) as served:
        struck = run(_recorded(served, path))
        with Recording.open(path) as recording:
            for mode, sensor in itertools.product(CASES, recording.sensors):
                if sensor.name not in served.device(mode).sensors:
                    continue
                with subtests.test(sensor=sensor.name):
                    assert len(set(struck[mode])) > len(FAULTS[mode]) / 2
                    kinds = [e.kind for e in recording.events if e.sensor == sensor.name]
                    assert set(kinds) <= KINDS
                    if "disconnect" in struck[mode] and "udp" not in mode:
                        assert kinds.count("connected") >= 2
                    hold_against_the_world(served, mode, sensor)


def hold_against_the_world(served: Served, mode: str, sensor: SensorRecord) -> None:
    """See that each recorded sample is in its place."""
    blocks, counts = sensor.blocks, sensor.counts()
    assert len(counts) == blocks["n_samples"].sum()
    rows = np.cumsum(blocks["n_samples"]) - blocks["n_samples"]
    index = np.arange(len(counts)) + np.repeat(blocks["first_sample"] - rows, blocks["n_samples"])
    holes = np.flatnonzero(np.diff(index) != 1)
    assert (np.diff(index)[holes] > 1).all(), "none twice, none back"
    gaps = sensor.gaps[sensor.gaps["first_sample"] < index[-1]]  # but for the one of a lost device
    assert len(counts) > 0.1 * gaps["missing"].sum()
    assert np.array_equal(gaps["first_sample"], index[holes] + 1)
    assert np.array_equal(gaps["missing"], np.diff(index)[holes] - 1)

    anew = BlockFlag.MISSING_ESTIMATED
    if mode not in COUNT_ON:
        anew |= BlockFlag.CLOCK_RESTART
    parts = np.split(np.arange(len(index)), rows[1:][(blocks["flags"][1:] & anew) != 0])
    world = np.concatenate(
        [served.assert_felt(mode, sensor.name, index[part], counts[part]) for part in parts]
    )
    apart = np.diff(world)
    assert apart.min() >= (0 if mode.startswith("registers") else 1)
    off = np.diff(world - index)  # by the host's clock: the latency of the first block after it
    far_off = np.abs(off) > HELD_UP * SPEED * sensor.sampling_rate
    assert np.count_nonzero(far_off) <= len(parts) / 2
    if mode in COUNT_ON:
        kinds = {"reset"}
        if mode.startswith(("scream", "seedlink")):  # late arrivals confirm few gaps
            kinds = set(FAULTS[mode])
        assert len(parts) <= 1 + sum(one["kind"] in kinds for one in served.struck(mode))
