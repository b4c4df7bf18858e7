"""SeedLink over TLS with programs that we did not write: EarthScope's slinktool and ringserver.

Both are built by `make` (https://github.com/EarthScope) and have to be on the path.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from daq.devices.registry import driver_type
from daq.devices.seedlink.decoder import WaveRecord, encode_record
from daq.errors import WrongDeviceError
from daq.host_clock import SystemClock
from daq.protocols.block import Block
from sim_devices.server.serve import self_signed
from tests.acceptance.ringserver import Feeder
from tests.devices import serving
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import device, spec
from tests.waiting import limit, wait_until

pytestmark = pytest.mark.peer
RATE = 100
CHANNELS = ("HNZ", "HNN", "HNE")
HELPER = """#!/bin/sh
[ "$AUTH_USERNAME $AUTH_PASSWORD" = "lab secret" ] && answer=true || answer=false
echo "{\\"authenticated\\": $answer}"
"""


@pytest.mark.devices
@pytest.mark.skipif(shutil.which("slinktool") is None, reason="needs slinktool")
@pytest.mark.parametrize("is_known", [True, False])
def test_slinktool_reads_our_server(tmp_path: Path, is_known: bool) -> None:
    (tmp_path / "credentials").write_text("lab secret", encoding="utf-8")
    settings = {"network": "XX", "station": "STA", "channels": list(CHANNELS)}
    security = {"tls": True, "credentials": str(tmp_path / "credentials")}
    table = device("A", "seedlink", port="tcp", settings={**settings, **security})
    said = b""
    with serving(spec(table, speed=4.0)) as (one,):
        access = {
            "SEEDLINK_USERNAME": "lab",
            "SEEDLINK_PASSWORD": "secret" if is_known else "wrong",
        }
        number = one.port.rpartition(":")[2]
        with subprocess.Popen(
            ["slinktool", "-T", "-p", "-S", "XX_STA", f"localhost:{number}"],
            env={**os.environ, **access, "LIBSLINK_CA_CERT_FILE": one.settings["ca_file"]},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ) as client:
            assert client.stdout is not None
            while said.count(b"FDSN:XX_STA") < 6 and b"not accepted" not in said:
                piece = os.read(client.stdout.fileno(), 65536)
                if not piece:
                    break
                said += piece
            client.kill()
    assert (b"AUTH not accepted" in said) != is_known, said
    if is_known:
        assert {f"XX_STA_00_H_N_{c}".encode() for c in "ZNE"} <= {
            line.partition(b",")[0].removeprefix(b"FDSN:") for line in said.splitlines()
        }


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[int, str]]:
    """Run ringserver, which gets records all the time; yield its port and certificate."""
    (tmp_path / "ring").mkdir()
    _, certificate = self_signed(tmp_path)
    helper = tmp_path / "helper"
    helper.write_text(HELPER, encoding="utf-8")
    helper.chmod(0o755)
    with contextlib.ExitStack() as stack:
        probes = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        number, feed = (one.getsockname()[1] for one in probes)
    environment = {
        "RS_TLS_CERT_FILE": certificate,
        "RS_TLS_KEY_FILE": str(tmp_path / "key.pem"),
        "RS_AUTH_COMMAND": f"{helper} -",  # 4.5.3 crashes where it has no argument
        "RS_AUTH_REQUIRED_FOR_STREAMS": "1",
    }
    sizes = ["-Rd", str(tmp_path / "ring"), "-Rs", "10M"]
    with subprocess.Popen(
        ["ringserver", *sizes, "-SL", f"{number} TLS", "-DL", str(feed)],
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        ended = threading.Event()
        wait_until(lambda: _listens(feed), "ringserver listens", seconds=30)
        feeding = threading.Thread(target=_feed, args=(feed, ended))
        feeding.start()
        yield number, certificate
        ended.set()
        feeding.join()
        process.terminate()


def _listens(number: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", number)) == 0


def _feed(number: int, ended: threading.Event) -> None:
    """Send a second of samples, three times their index plus that of the channel, ever again."""
    begin = time.time_ns() // 10**9
    with socket.create_connection(("127.0.0.1", number)) as link:
        Feeder.ask(link, b"ID test:huddle:1:x")
        for index in itertools.count():
            start = begin + index
            samples = np.arange(index * RATE, (index + 1) * RATE, dtype=np.int32)
            for c, name in enumerate(CHANNELS):
                made = WaveRecord(
                    "XX", "STA", "", name, start * 10**9, Fraction(RATE), 3 * samples + c
                )
                for packed in encode_record(made):
                    head = f"WRITE XX_STA__{name}/MSEED {start}000000 {start}990000 A {len(packed)}"
                    Feeder.ask(link, head.encode(), packed)
            if ended.wait(0.02):
                return


@pytest.mark.skipif(shutil.which("ringserver") is None, reason="needs ringserver")
async def test_our_driver_reads_ringserver(server: tuple[int, str], tmp_path: Path) -> None:
    number, certificate = server
    driver, found = driver_type("seedlink"), []
    settings = {"network": "XX", "station": "STA", "tls": True, "ca_file": certificate}
    settings["credentials"] = str(tmp_path / "credentials")
    port = f"seedlink://localhost:{number}"
    chosen = sensor_at(port, "seedlink", rate=RATE, channels=CHANNELS, settings=settings)
    (tmp_path / "credentials").write_text("lab wrong", encoding="utf-8")
    with pytest.raises(WrongDeviceError, match="'AUTH …', got 'ERROR AUTH"):
        async with driver.open([chosen], SystemClock()):
            pass
    (tmp_path / "credentials").write_text("lab secret", encoding="utf-8")
    async with (
        asyncio.timeout(limit(60)),
        driver.open([chosen], SystemClock()) as session,
        contextlib.aclosing(session.read()) as items,  # type: ignore[type-var]
    ):
        assert session.information[0].details["protocol"] == "SeedLink 4, encrypted"
        async for item in items:
            found += [item] if isinstance(item, Block) else []
            if found and found[-1].end_sample >= 10 * RATE:
                break
    counts = np.concatenate([block.counts for block in found])
    first = int(counts[0, 0])
    expected = first + 3 * np.arange(len(counts))[:, None] + np.arange(3)
    np.testing.assert_array_equal(counts, expected)
