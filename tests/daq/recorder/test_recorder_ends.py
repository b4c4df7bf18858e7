"""How a recorder ends that the disk refuses, or that is interrupted: each in its own process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.bench.end_condition import EndCondition
from daq.caveats import Caveat
from daq.recording.reader import Recording
from daq.recording.repair import verify
from tests.scripted_driver import counts
from tests.waiting import python

pytestmark = pytest.mark.virtual_time


FULL_DISK = """
import asyncio, resource, signal, sys
from daq.errors import RecordingError
from daq.recorder.recorder import record
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block

async def main():
    clock, driver = ManualClock(), PlayedDriver({"a": PlayedDevice()})
    for first in range(0, 1_000_000, 1000):
        driver.devices["a"].items.put_nowait(block("a", first, 1000, clock.now()))
    await record(bench("a"), sys.argv[1], clock=clock, drivers=driver.find)

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
try:
    asyncio.run(main())
except RecordingError as error:
    print(error, flush=True)
"""


def test_a_full_disk_ends_the_run_with_an_error(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    # A process of its own: HDF5 may crash the interpreter when it exits with what it cannot write.
    said = python(FULL_DISK, path)
    safe = "0 s of every sensor are safe"  # the disk refused before the first commit
    assert said.stdout == f"{path}: cannot be written: File too large; {safe}\n", said.stderr
    report = verify(path)
    assert report.intact
    assert not report.closed
    assert not path.with_stem("r-2").exists()  # which the disk refused, too


REFUSED_ONCE = """
import asyncio, os, resource, signal, sys
from daq.caveats import Caveat
from daq.recorder import recorder
from daq.host_clock import HostTime
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block, counts

N = 300

async def main():
    clock, driver = ManualClock(), PlayedDriver({name: PlayedDevice() for name in "abc"})
    stop, sent = asyncio.Event(), 0
    samples = []

    def acknowledged(status):
        nonlocal sent
        samples.append(status.sensors["a"].samples)
        if status.path.endswith("-2.h5"):
            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)  # the disk takes files again
        if sent == N and samples[-1] >= 1000 * (N - 1):
            stop.set()
        for _ in range(min(10, N - sent)):
            clock.advance(10.0)
            for name in "abc":
                at = clock.now()
                driver.devices[name].items.put_nowait(block(name, 1000 * sent, 1000, at))
            sent += 1

    recorder.caveats_of = lambda _: [Caveat.SIMULATED]
    status = await recorder.record(
        bench(*"abc"), sys.argv[1], clock=clock, drivers=driver.find, stop=stop,
        acknowledged=acknowledged, attributes={"until": "5 %"},
    )
    assert samples == sorted(samples)
    print(status.closed, status.sensors["a"].samples, status.path, flush=True)
    os._exit(0)  # as the command does: HDF5 cannot free what the disk refused

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, unlimited[1]))
asyncio.run(main())
"""


def test_a_recording_continues_in_another_file_after_a_disk_error(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    said = python(REFUSED_ONCE, path)
    following = path.with_stem("r-2")
    assert said.stdout.split()[::2] == ["True", str(following)], said.stderr
    assert "cannot be written: File too large; the recording continues in" in said.stderr
    assert "failed and is repeated: File too large" in said.stderr
    assert "buf = 0x" not in said.stderr  # an address, as HDF5 has it
    with Recording.open(path) as first, Recording.open(following) as second:
        assert not first.closed
        assert second.closed
        assert second.continues == first.run_id
        assert second.until == first.until == EndCondition.of_text("5 %")
        assert second.caveats == first.caveats == (Caveat.SIMULATED,)
        texts = [event.text for event in second.events]
        assert f"continues {path}: cannot be written: File too large" in texts
        for name in "abc":
            one, two = first.sensor(name), second.sensor(name)
            assert two.blocks["first_sample"][0] == 0
            expected = counts(0, 300_000)
            n = one.n_samples
            assert n > 1000
            assert np.array_equal(one.counts(), expected[:n])
            assert np.array_equal(two.counts(), expected[len(expected) - two.n_samples :])
            assert two.n_samples >= len(expected) - n  # nothing is lost between them


STUBBORN = """
import asyncio, functools, signal, sys
from daq.recorder import connection
from daq.recorder import recorder
from tests.scripted_driver import PlayedDevice, PlayedDriver, bench

def interrupt(status):
    if not status.closed:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

connection.CLOSE_TIMEOUT, recorder.CANCEL_TIMEOUT = 0.1, 0.3
if "windows" in sys.argv:
    def not_here(*_):
        raise NotImplementedError
    asyncio.SelectorEventLoop.add_signal_handler = not_here
device = PlayedDevice(may_end=asyncio.Event() if "stubborn" in sys.argv else None)
driver = PlayedDriver({"a": device})
recording = functools.partial(
    recorder.record, bench("a"), sys.argv[1], acknowledged=interrupt, drivers=driver.find
)
print(recorder.run(recording).closed, flush=True)
"""


@pytest.mark.parametrize("how", ["stubborn", "windows"])
def test_interrupted_twice_a_run_ends_properly_whatever_its_driver_does(
    tmp_path: Path, how: str
) -> None:
    path = tmp_path / "r.h5"
    said = python(STUBBORN, path, how)
    assert (said.returncode, said.stdout) == (0, "True\n"), said.stderr
    assert verify(path).closed
