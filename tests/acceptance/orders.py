"""Three devices of one port come and go in every order, and the server hangs up: sums of rows.

``python -m`` this module runs the 544 orders of CAN nodes and of SeedLink stations through the
recorder into a file, each in a process of its own, and prints what is wrong and the sums. A device
is there from the start or comes later, leaves, and comes back. Arguments: kinds, ``every=8``,
``begin=3``, ``parallel=4``. Nodes and server are of the tests, and share no code with the drivers.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import multiprocessing
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.bench.model import Bench, Sensor
from daq.host_clock import SystemClock
from daq.protocols.block import BlockFlag
from daq.recorder.recorder import record
from daq.recording.reader import Recording
from tests.acceptance.continuity import compared
from tests.daq.devices.can_peer import Peer
from tests.daq.devices.seedlink_peer import PER_RECORD, RATE, Server, value
from tests.waiting import wait_until

LIVES = ("", "c", "l", "lc")
"""A device stays; comes later; leaves; leaves and comes back."""
NAMES = ("AAA", "BBB", "CCC")
SPEED = 8.0
"""Of the SeedLink server."""
Order = tuple[tuple[str, ...], tuple[tuple[int, str], ...]]


def orders() -> Iterator[Order]:
    """Yield lives of the devices, and who does what, in turn; one device is there at first."""
    for lives in itertools.product(LIVES, repeat=3):
        if all(life == "c" for life in lives):
            continue
        events = [n for n, life in enumerate(lives) for _ in life]
        for order in sorted(set(itertools.permutations(events))):
            left = [list(life) for life in lives]
            yield lives, tuple((n, left[n].pop(0)) for n in order)


class Nodes:
    """Nodes of a CAN bus at 50 Hz."""

    rate, speed, pauses, settled = 50.0, 1.0, (0.3, 0.8, 1.4, 2.5), 2.5

    def __init__(self, rng: random.Random) -> None:
        channel = f"orders-{rng.random()}"
        self._peer = Peer(channel, [1, 2, 3], self.rate)
        self._nodes = [self._peer.nodes[number] for number in (1, 2, 3)]
        self.sensors = tuple(
            Sensor(
                name=name,
                driver="epson-can",
                port=f"can://{channel}",
                sampling_rate=self.rate,
                channels=tuple(Channel(name=axis, sensitivity=1.7e6) for axis in "xyz"),
                settings={"node_id": number, "interface": "virtual"},
            )
            for number, name in enumerate(NAMES, 1)
        )

    async def __aenter__(self) -> Nodes:
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self._peer.close)

    def act(self, device: int, what: str) -> str:
        """Let a node leave or come; return when."""
        node = self._nodes[device]
        with self._peer.lock:
            (node.leave if what == "l" else node.come)()
        return f"{NAMES[device]} {what} at {self._peer.tick}"

    def truth(self, device: int, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return which samples rows are."""
        assert (counts[:, 1] == device + 1).all()
        assert (counts[:, 2] == -counts[:, 0]).all()
        return counts[:, 0]

    def sent(self, device: int, first: int) -> NDArray[np.int64]:
        """Return the samples that a device sent; each was asked for."""
        del first
        return np.array(self._nodes[device].sent)


class Stations:
    """Stations of a SeedLink server that refuses, falls silent and hangs up."""

    rate, speed, pauses, settled = float(RATE), SPEED, (0.1, 0.3, 1.0), 1.0

    def __init__(self, rng: random.Random) -> None:
        self._rng, self._server = rng, Server(list(NAMES))

    async def __aenter__(self) -> Stations:
        await self._server.__aenter__()
        self.sensors = tuple(
            Sensor(
                name=name,
                driver="seedlink",
                port=self._server.port,
                sampling_rate=self.rate,
                channels=(Channel(name="HNZ", sensitivity=1e6),),
                settings={"network": "XX", "station": name, "late": 2.0, "patience": 20.0},
            )
            for name in NAMES
        )
        self._making = asyncio.create_task(self._make())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._making.cancel()
        await self._server.__aexit__()

    async def _make(self) -> None:
        began = time.monotonic()
        for turn in itertools.count(1):
            self._server.make()
            due = began + turn * PER_RECORD / self.rate / self.speed
            await asyncio.sleep(max(0.0, due - time.monotonic()))

    def act(self, device: int, what: str) -> str:
        """Let a station leave or come, and hang up at times; return when."""
        server, name = self._server, NAMES[device]
        if what == "l":
            server.away.add(name)
            server.refuses |= {name} if self._rng.random() < 0.5 else set()
        else:
            server.away.discard(name)
            server.refuses.discard(name)
        hangs_up = self._rng.random() < 0.3
        if hangs_up:
            server.hang_up()
        return f"{name} {what}{', hang-up' * hangs_up} at turn {server.n_turns}"

    def truth(self, device: int, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return which samples rows are."""
        return (counts[:, 0] - value(device, 0)) * pow(value(0, 1), -1, 100_003) % 100_003

    def sent(self, device: int, first: int) -> NDArray[np.int64]:
        """Return the samples of a station from the first that was requested."""
        turns = np.array(self._server.made[NAMES[device]])
        made = (turns[:, None] * PER_RECORD + np.arange(PER_RECORD)).ravel()
        return made[made >= first]


KINDS: dict[str, Callable[[random.Random], Nodes | Stations]] = {"can": Nodes, "seedlink": Stations}


def run(kind: str, number: int, order: Order) -> tuple[Counter[str], str]:
    """Record one order; return the sums, and what happened where something is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(_session(kind, number, order, Path(folder, "r.h5")))


async def _session(kind: str, number: int, order: Order, path: Path) -> tuple[Counter[str], str]:
    rng = random.Random(number)
    lives, turns = order
    found, happened = Counter(sessions=1), [f"{kind} {number}: {lives}"]
    async with KINDS[kind](rng) as devices:
        there = {n for n, life in enumerate(lives) if life != "c"}
        for n in {0, 1, 2} - there:
            devices.act(n, "l")
        rows = dict.fromkeys(NAMES, 0)
        stop = asyncio.Event()
        recording = asyncio.create_task(
            record(
                Bench(name="orders", sampling_rate=devices.rate, sensors=devices.sensors),
                path,
                stop=stop,
                anyway=True,
                clock=SystemClock(devices.speed),
                acknowledged=lambda status: rows.update(
                    {name: one.samples for name, one in status.sensors.items()}
                ),
            )
        )
        await _until(lambda: any(rows.values()))
        for n, what in turns:
            await asyncio.sleep(rng.choice(devices.pauses))
            happened.append(devices.act(n, what))
            (there.discard if what == "l" else there.add)(n)
        await asyncio.sleep(devices.settled)
        wanted = {name: rows[name] + round(1.2 * devices.rate) for name in rows}
        back = await _until(lambda: all(rows[NAMES[n]] >= wanted[NAMES[n]] for n in there))
        found["never back"] = not back
        stop.set()
        with contextlib.suppress(asyncio.CancelledError):
            await recording
        with Recording.open(path) as file:
            for n, name in enumerate(NAMES):
                found += _sums(file, name, n, devices)
            if found["never back"] or found["lacking"] or found["wrong"]:
                begin = file.created_at.monotonic_ns
                for event in file.events:
                    at = (event.received.monotonic_ns - begin) / 1e9
                    happened.append(f"{at:.2f} s {event.sensor} {event.kind} {event.text}")
                return found, "\n  ".join([*happened, str(dict(found))])
    return found, ""


def _sums(file: Recording, name: str, n: int, devices: Nodes | Stations) -> Counter[str]:
    sensor = file.sensor(name)
    if not sensor.n_samples:
        return Counter()
    blocks = sensor.blocks[:]
    index = np.concatenate(
        [np.arange(b["first_sample"], b["first_sample"] + b["n_samples"]) for b in blocks]
    )
    truth = devices.truth(n, sensor.counts(0, sensor.n_samples).astype(np.int64))
    assert (np.diff(truth) > 0).all()
    sent = devices.sent(n, int(truth[0]))
    sent = sent[sent <= truth[-1]]
    is_estimated = blocks["flags"] & BlockFlag.MISSING_ESTIMATED != 0
    return compared(index, truth, set(blocks["first_sample"][is_estimated].tolist())) + Counter(
        sent=len(sent), recorded=len(truth), lacking=len(np.setdiff1d(sent, truth))
    )


async def _until(reached: Callable[[], bool]) -> bool:
    with contextlib.suppress(AssertionError):
        await asyncio.to_thread(wait_until, reached, "rows", seconds=120.0)
    return reached()


def main() -> None:
    """Print faults and sums."""
    options = dict(each.split("=") for each in sys.argv[1:] if "=" in each)
    kinds = [each for each in sys.argv[1:] if "=" not in each] or list(KINDS)
    every, begin = int(options.get("every", 1)), int(options.get("begin", 0))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["daq.recorder.recorder", "tests.acceptance.continuity"])
    for kind in kinds:
        total = Counter[str]()
        chosen = list(enumerate(orders()))[begin::every]
        with ProcessPoolExecutor(
            int(options.get("parallel", 4)), mp_context=context, max_tasks_per_child=1
        ) as pool:
            for done in as_completed([pool.submit(run, kind, *each) for each in chosen]):
                found, happened = done.result()
                total += found
                if happened:
                    print(happened, flush=True)
                if total["sessions"] % 25 == 0:
                    print(kind, dict(total), flush=True)
        print(kind, dict(total), flush=True)


if __name__ == "__main__":
    main()
