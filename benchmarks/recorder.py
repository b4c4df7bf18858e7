"""The largest bench, through real sockets into HDF5: what is lost (nothing), what it costs.

One process plays all devices (Epson accelerometers behind serial-to-network adapters that send
every 50 ms), another is the recorder, and only that one is measured. A usual bench is also recorded
and estimated by `huddle run` in a terminal: both of its processes, once they are under way.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import pty
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.row import Row, peak_memory
from daq.bench.channel import Channel
from daq.bench.loading import parse
from daq.bench.model import Bench, Sensor
from daq.devices.epson import commands
from daq.estimation.follow import SHORTEST_INTERVAL, follow
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.python_process import python_command
from daq.recorder.recorder import record
from daq.recorder.recorder import run as run_to_its_end
from daq.recording.monitor import RecordingStatus
from daq.recording.repair import verify

SEND_INTERVAL = 0.05
AXES = tuple(Channel(name=axis, sensitivity=commands.COUNTS_PER_UNIT) for axis in "xyz")


PERIOD = 1 << 16
"""Samples after which the played motion and noise repeat: more than an estimate has here, for of
averages of the same segments no dimension is right, and all are tried."""


class Noise:
    """What the played sensors read: motion of a million counts.

    Each sensor adds noise of its own, a hundredth of the motion.
    """

    def __init__(self, sampling_rate: float) -> None:
        self.sampling_rate = sampling_rate
        rng = np.random.default_rng(1)
        self._motion = rng.normal(0, 1e6, (PERIOD, 3))
        self._counts: dict[str, NDArray[np.float64]] = {}

    def at_rate(self, sampling_rate: float) -> Noise:
        """Return such noise at another rate."""
        return Noise(sampling_rate)

    def counts(self, sensor: str, first: int, n: int) -> NDArray[np.float64]:
        """Return counts, shape (n, 3)."""
        if sensor not in self._counts:
            rng = np.random.default_rng([*sensor.encode()])
            own = rng.normal(0, 1e4, self._motion.shape)
            self._counts[sensor] = self._motion + own
        return self._counts[sensor].take(np.arange(first, first + n), axis=0, mode="wrap")

    def temperature(self, _: str, now: float) -> float:
        """Return the temperature in °C."""
        del now
        return 23.0

    def times(self, _: str, first: int, n: int) -> NDArray[np.float64]:
        """Return when samples are taken, in s."""
        return np.arange(first, first + n) / self.sampling_rate

    def first_sample_after(self, _: str, now: float) -> int:
        """Return the sample that is taken next."""
        return int(np.ceil(now * self.sampling_rate))


async def play(n_sensors: int, sampling_rate: float) -> None:
    """Be the devices until standard input is closed."""
    from sim_devices.devices.epson import EpsonDevice  # noqa: PLC0415
    from sim_devices.devices.interface import ChannelSpec, DeviceSpec, Line  # noqa: PLC0415
    from sim_devices.faults import LineFaults  # noqa: PLC0415
    from sim_devices.server import serve  # noqa: PLC0415  (only the process that plays them)
    from sim_devices.server.serve import WorldClock  # noqa: PLC0415

    serve.MIN_INTERVAL = SEND_INTERVAL
    clock = WorldClock(time.monotonic_ns())
    source: Any = Noise(sampling_rate)
    channels = tuple(ChannelSpec(axis, commands.COUNTS_PER_UNIT) for axis in "xyz")
    served = []
    for number in range(n_sensors):
        name = f"s{number:02}"
        spec = DeviceSpec((name,), "epson", "tcp", sampling_rate, {name: channels})
        line = Line(EpsonDevice(spec, source), "tcp")
        one = serve.Served(line, clock, LineFaults((), name, begin=0.0), lambda *_: None)
        await one.port.open()
        served.append(one)
    print(json.dumps([one.port.address for one in served]), flush=True)
    await asyncio.to_thread(sys.stdin.read)
    for one in served:
        await one.close()


def measure(bench_file: str, path: str, duration: float) -> None:
    """Be the recorder, and say what it took."""
    bench = parse(Path(bench_file).read_text(encoding="utf-8"))
    begin: list[float] = []

    def used() -> float:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return usage.ru_utime + usage.ru_stime

    def acknowledged(_: object) -> None:
        if not begin:  # everything is connected and flows
            begin.extend((used(), time.monotonic()))

    recording = partial(record, bench, path, duration=duration, acknowledged=acknowledged)
    status = run_to_its_end(recording)
    cpu = (used() - begin[0]) / (time.monotonic() - begin[1])
    memory = peak_memory()
    missing = sum(sensor.missing for sensor in status.sensors.values())
    samples = sum(sensor.samples for sensor in status.sensors.values())
    print(json.dumps({"cpu": cpu, "memory": memory, "missing": missing, "samples": samples}))


@contextlib.contextmanager
def played(n_sensors: int, sampling_rate: float) -> Iterator[Bench]:
    """Give a bench of devices that are played."""
    command = python_command("benchmarks.recorder", "play", str(n_sensors))
    with subprocess.Popen(
        [*command, str(sampling_rate)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as player:
        assert player.stdout is not None
        ports = json.loads(player.stdout.readline())
        sensors = tuple(
            Sensor(
                name=f"s{number:02}",
                driver="epson",
                port=port,
                sampling_rate=sampling_rate,
                channels=AXES,
                settings={"temperature_stabilisation": False},
            )
            for number, port in enumerate(ports)
        )
        yield Bench(name="played", sampling_rate=sampling_rate, sensors=sensors)


def case(n_sensors: int, sampling_rate: float, duration: float) -> dict[str, float]:
    """Record a bench of so many triaxial sensors; return what it took."""
    with tempfile.TemporaryDirectory() as folder, played(n_sensors, sampling_rate) as bench:
        bench_file, path = Path(folder) / "bench.toml", Path(folder) / "r.h5"
        bench_file.write_text(bench.text, encoding="utf-8")
        command = python_command("benchmarks.recorder", "record", str(bench_file))
        said = subprocess.run(
            [*command, str(path), str(duration)], check=True, stdout=subprocess.PIPE, text=True
        ).stdout
        found: dict[str, float] = json.loads(said)
        report = verify(path)
        found["bad"] = sum(len(sensor.bad_blocks) for sensor in report.sensors)
        found["size"] = path.stat().st_size
        return found


def live(n_sensors: int, sampling_rate: float, *, begin: float, duration: float) -> list[Row]:
    """Record and estimate a bench by `huddle run`; return what that takes after `begin` s."""
    with tempfile.TemporaryDirectory() as folder, played(n_sensors, sampling_rate) as bench:
        bench_file, path = Path(folder) / "bench.toml", Path(folder) / "r.h5"
        bench_file.write_text(bench.text, encoding="utf-8")
        command = python_command("tui", "run", str(bench_file), "--out", str(path))
        command += ["--duration", str(begin + duration + 30)]
        with (
            _terminal() as screen,
            subprocess.Popen(command, stdout=screen, stderr=screen) as huddle,
        ):
            while not path.exists():
                time.sleep(SHORTEST_INTERVAL)
            time.sleep(begin)
            (recorder,) = _children(huddle.pid)
            processes = (huddle.pid, recorder)
            before, since = [_work_of(pid) for pid in processes], time.monotonic()
            delays = _delays(path, until=since + duration)
            passed = time.monotonic() - since
            share = [
                100 * (_work_of(pid) - work) / passed
                for pid, work in zip(processes, before, strict=True)
            ]
            huddle.send_signal(signal.SIGINT)  # the rest of the recording shows nothing
            huddle.wait()
    what = f"{n_sensors} triaxial sensors × {sampling_rate:g} Hz, recorded and estimated"
    note = f"huddle run {share[0]:.2f} %, its recorder {share[1]:.2f} %"
    late = f"{what}: a segment is in the estimate after its end by"
    seen, worked = delays.seen[1:], delays.worked[1:]  # the first has what was recorded before
    return [
        Row(f"{what}: one core", sum(share), "%", at_most=5.0, note=note),
        Row(late, float(np.median(seen)), "s", at_most=2.0, note=f"median of {len(seen)}"),
        Row(late, max(seen), "s", at_most=2.0, note="longest"),
        Row(f"{what}: processor time of an estimate", float(np.median(worked)), "s", note="median"),
        Row(f"{what}: processor time of an estimate", max(worked), "s", 2.0, note="longest"),
    ]


class _Delays:
    """An observer that notes how late segments are in what it sees, and what they cost."""

    def __init__(self, until: float) -> None:
        self.cancelled = threading.Event()
        self.seen: list[float] = []
        """Seconds from the end of a segment to the estimate that has it."""
        self.worked: list[float] = []
        """Processor time of this process since the estimate before, in s."""
        self._until, self._work = until, time.process_time()

    def status(self, status: RecordingStatus) -> None:
        """Look whether it is time to end."""
        del status
        if time.monotonic() > self._until:
            self.cancelled.set()

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Note when the last segment of the estimate ended, and what was done since."""
        del settings
        self.seen.append(time.time() - snapshot.start_utc_ns * 1e-9 - snapshot.elapsed)
        self.worked.append(time.process_time() - self._work)
        self._work = time.process_time()

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Ignore segments that no estimate has yet."""

    def progress(self, done: int, total: int) -> None:
        """Ignore what was recorded before."""


def _delays(path: Path, *, until: float) -> _Delays:
    """Follow a recording by the loop of the application."""
    found = _Delays(until)
    follow(path, Settings(), found, cancelled=found.cancelled)
    return found


@contextlib.contextmanager
def _terminal() -> Iterator[int]:
    """Give a terminal, for what is drawn on one; somebody looks at it."""
    near, far = pty.openpty()

    def look() -> None:
        with contextlib.suppress(OSError):
            while os.read(near, 65536):
                pass

    looking = threading.Thread(target=look)
    looking.start()
    try:
        yield far
    finally:
        os.close(far)
        looking.join()
        os.close(near)


def _threads(pid: int) -> list[Path]:
    return list(Path(f"/proc/{pid}/task").iterdir())


def _children(pid: int) -> list[int]:
    return [
        int(child) for task in _threads(pid) for child in (task / "children").read_text().split()
    ]


def _work_of(pid: int) -> float:
    """Return the processor time of a process so far, in s."""
    return sum(int((task / "schedstat").read_text().split()[0]) for task in _threads(pid)) * 1e-9


def run(*, smallest: bool = False) -> list[Row]:
    """Return what the largest and a usual bench take."""
    rows = []
    benches = ((64, 1000.0, 20.0, None), (5, 200.0, 10.0, 5.0))
    for n_sensors, rate, duration, most_cpu in ((3, 200.0, 2.0, None),) if smallest else benches:
        found = case(n_sensors, rate, duration)
        what = f"{n_sensors} triaxial sensors × {rate:g} Hz for {duration:g} s"
        per_sample = found["size"] / (found["samples"] * 3)
        rows += [
            Row(f"{what}: samples lost or damaged", found["missing"] + found["bad"], "", 0),
            Row(
                f"{what}: recorded",
                found["samples"],
                "samples",
                at_least=n_sensors * rate * duration,
            ),
            Row(f"{what}: one core", found["cpu"] * 100, "%", most_cpu, note="recorder alone"),
            Row(f"{what}: memory", found["memory"], "MB"),
            Row(f"{what}: file", per_sample, "bytes/count", note="white noise, 21 bits"),
        ]
    begin, duration = (12.0, 18.0) if smallest else (15.0, 30.0)
    return [*rows, *live(3 if smallest else 5, 200.0, begin=begin, duration=duration)]


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["play", n, rate]:
            asyncio.run(play(int(n), float(rate)))
        case ["record", bench_file, path, duration]:
            measure(bench_file, path, float(duration))
