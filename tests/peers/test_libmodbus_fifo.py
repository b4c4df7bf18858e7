"""Our driver reads a block FIFO that libmodbus serves, over pseudo-terminals made by socat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.devices.registry import driver_type
from daq.protocols.block import BlockFlag
from tests.daq.devices.reading import record
from tests.peers.libmodbus import build, ready, serial_cable
from tests.sensors import sensor_at

pytestmark = pytest.mark.peer

RATE = 2000.0


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the libmodbus program."""
    return build("fifo_peer.c", tmp_path_factory.mktemp("libmodbus"))


@pytest.mark.parametrize("header", ["size", "left"])
async def test_our_driver_reads_a_fifo_of_libmodbus(
    peer: Path, tmp_path: Path, header: str
) -> None:
    """Every sample once, in order, whichever meaning the first register has."""
    with (
        serial_cable(tmp_path) as (ours, theirs),
        ready(str(peer), theirs, header),
    ):
        settings = {"header": header, "baud_rate": 230400}
        sensor = sensor_at(ours, "fifo", rate=RATE, settings=settings)
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
