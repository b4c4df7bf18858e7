"""Our driver reads a block FIFO that libmodbus serves, over pseudo-terminals made by socat."""

from __future__ import annotations

import shutil
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.bench import Channel, Sensor
from daq.drivers.registry import driver_type
from daq.protocols.block import BlockFlag
from tests.drivers.reading import record

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.peer

RATE = 2000.0


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the libmodbus program."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to build the libmodbus peer with")
    program = tmp_path_factory.mktemp("libmodbus") / "peer"
    source = Path(__file__).with_name("fifo_peer.c")
    built = subprocess.run(
        [compiler, "-I/usr/include/modbus", str(source), "-lmodbus", "-o", str(program)],
        capture_output=True,
        text=True,
        check=False,
    )
    if built.returncode and "modbus.h" in built.stderr:
        pytest.skip("libmodbus (Debian: libmodbus-dev) is not installed")
    assert built.returncode == 0, built.stderr
    return program


@contextmanager
def serving(*command: str) -> Iterator[None]:
    """Run the server until the context ends."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            yield
        finally:
            server.terminate()


@contextmanager
def serial_cable(folder: Path) -> Iterator[tuple[str, str]]:
    """Two pseudo-terminals joined by socat."""
    if shutil.which("socat") is None:
        pytest.skip("socat (Debian: socat) is not installed")
    ends = (str(folder / "one"), str(folder / "other"))
    with subprocess.Popen(["socat", *(f"pty,raw,echo=0,link={end}" for end in ends)]) as socat:
        try:
            deadline = time.monotonic() + 5
            while not all(Path(end).exists() for end in ends):
                assert time.monotonic() < deadline, "socat made no pseudo-terminals"
            yield ends
        finally:
            socat.terminate()


@pytest.mark.parametrize("header", ["size", "left"])
async def test_our_driver_reads_a_fifo_of_libmodbus(
    peer: Path, tmp_path: Path, header: str
) -> None:
    """Every sample once, in order, whichever meaning the first register has."""
    with (
        serial_cable(tmp_path) as (ours, theirs),
        serving(str(peer), theirs, header),
    ):
        sensor = Sensor(
            name="A",
            driver="fifo",
            port=ours,
            sampling_rate=RATE,
            settings={"header": header, "baud_rate": 115200},
            channels=tuple(Channel(name=name, sensitivity=835.35) for name in "xyz"),
        )
        blocks, events = await record(driver_type("fifo"), sensor, 3000)
    assert not events
    assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
    assert blocks[0].flags & BlockFlag.CLOCK_RESTART
    counts = np.concatenate([b.counts for b in blocks])
    number = counts[0, 0] + np.arange(len(counts))
    expected = (number[:, None] * [1, 2, 3]).astype(np.int16)  # as 16-bit words wrap
    np.testing.assert_array_equal(counts, expected)
    # as fast as it fills: by the host's clock, the samples of the time; a busy host lags a little
    elapsed = (blocks[-1].received.monotonic_ns - blocks[0].received.monotonic_ns) * 1e-9
    n_samples = blocks[-1].end_sample - blocks[0].end_sample
    assert (elapsed - 0.5) * RATE < n_samples < elapsed * RATE + 200
