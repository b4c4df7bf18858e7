"""Sound cards: PortAudio on ALSA's file plugin, which plays a file as a card without a clock.

No card is here, so how a real one overflows is tested at the callback; docs/hardware-checks.md says
what only a card shows.
"""

from __future__ import annotations

import importlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.devices.registry import driver_type
from daq.devices.sound import FULL_SCALE, Capture
from daq.errors import BenchFileError
from daq.host_clock import SystemClock
from daq.protocols.block import BlockFlag
from tests.sensors import sensor_at
from tests.waiting import python

RATE = 8000.0
DRIVER = driver_type("sound")
ALSA = Path("/usr/share/alsa/alsa.conf")
N_SAMPLES = 1_000_000
CARD = """
pcm.bench_card {{
  type file
  slave.pcm "null"
  file "/dev/null"
  infile "{file}"
  format "raw"
  hint {{ show on description "Bench card" }}
}}
"""
READ = """
import asyncio, contextlib, json, sys
import numpy as np
from daq.devices.registry import driver_type
from daq.errors import HuddleError
from daq.host_clock import SystemClock
from daq.protocols.block import Block
from tests.sensors import sensor_at


def sensor(name, port, **settings):
    return sensor_at(port, "sound", name, rate=8000.0, channels="xy", settings=settings)


async def main(port, n):
    bench = [sensor("A", port, inputs=(3, 1)), sensor("B", port, inputs=(2, 4))]
    found = []
    async with driver_type("sound").open(bench, SystemClock()) as session:
        models = [one.model for one in session.information]
        async with contextlib.aclosing(session.read()) as blocks:
            async for block in blocks:
                rows = block.counts.tolist()
                found.append([block.sensor, block.first_sample, rows, int(block.flags)])
                if block.end_sample >= n:
                    break
    return {"models": models, "blocks": found}


try:
    print(json.dumps([asyncio.run(main(sys.argv[1], int(sys.argv[2]))) for _ in range(2)]))
except HuddleError as error:
    print(json.dumps(str(error)))
"""


def has_portaudio() -> bool:
    try:
        importlib.import_module("sounddevice")
    except (ImportError, OSError):
        return False
    return ALSA.exists()


def played() -> np.ndarray[Any, Any]:
    """Return what the card has: four inputs, each sample once."""
    index = np.arange(N_SAMPLES)[:, None]
    return ((index * 4 + np.arange(4)) * 256).astype(np.int32)


def read(folder: Path, port: str, n_samples: int) -> Any:  # noqa: ANN401
    """Read the card in a process of its own: ALSA reads its configuration once."""
    (folder / "card.raw").write_bytes(played().astype("<i4").tobytes())
    (folder / "asound.conf").write_text(CARD.format(file=folder / "card.raw"), encoding="utf-8")
    environment = {**os.environ, "ALSA_CONFIG_PATH": f"{ALSA}:{folder / 'asound.conf'}"}
    done = python(READ, port, n_samples, env=environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.peer
@pytest.mark.skipif(not has_portaudio(), reason="PortAudio or ALSA is not installed")
def test_each_sensor_has_its_inputs(tmp_path: Path) -> None:
    """Twice: the card is free again after a session."""
    for session in read(tmp_path, "audio://bench_card", 3000):
        assert session["models"] == ["bench_card"] * 2
        for name, columns in (("A", [2, 0]), ("B", [1, 3])):
            blocks = [block for block in session["blocks"] if block[0] == name]
            assert BlockFlag.CLOCK_RESTART & blocks[0][3]
            for _, first, counts, _ in blocks:
                np.testing.assert_array_equal(
                    counts, played()[first : first + len(counts)][:, columns]
                )


@pytest.mark.skipif(not has_portaudio(), reason="PortAudio or ALSA is not installed")
def test_a_card_that_is_not_there_is_named(tmp_path: Path) -> None:
    said = read(tmp_path, "audio://Scarlett", 1)
    assert "none has 'Scarlett' in its name; sound cards:" in said
    assert "'A', 'B' on audio://Scarlett" in said


@pytest.mark.parametrize("is_timed", [True, False])
def test_an_overflow_is_a_gap(is_timed: bool) -> None:
    now_ns = 0
    clock = SystemClock(monotonic_ns=lambda: now_ns, always_ns=lambda: now_ns)
    capture = Capture(clock, RATE, [1, 0])
    block = np.zeros((800, 2), np.int32)
    for k, (at, overflowed) in enumerate([(0.0, False), (0.1, False), (0.35, True), (0.45, False)]):
        now_ns = round((at + 0.1) * 1e9)
        block[:, 0] = k
        capture.received(block, 100.0 + at if is_timed else 0.0, overflowed=overflowed)
    found = [capture.read() for _ in range(4)]
    assert [one.missing for one in found if one] == [0, 0, 1200, 0]
    assert found[2] is not None
    assert BlockFlag.MISSING_ESTIMATED in found[2].flags
    assert "overflow" in found[2].reason
    assert [one.counts[0].tolist() for one in found if one] == [[0, k] for k in range(4)]


def test_clipping_is_flagged() -> None:
    capture = Capture(SystemClock(), RATE, [0])
    for extreme in (FULL_SCALE, -(2**31), FULL_SCALE - 1):
        capture.received(np.array([[0], [extreme]], np.int32), 0.0, overflowed=False)
    flags = [one.flags for one in (capture.read() for _ in range(3)) if one]
    assert [BlockFlag.CLIPPED in flag for flag in flags] == [True, True, False]


@pytest.mark.parametrize(
    ("port", "inputs", "said"),
    [
        ("/dev/snd", None, "expected audio://"),
        ("audio://", (1,), "one for each of the sensor's"),
        ("audio://", (1, 1), "1 is already an input of sensor 'A'"),
    ],
)
def test_impossible_settings_are_refused(
    port: str, inputs: tuple[int, ...] | None, said: str
) -> None:
    settings = {} if inputs is None else {"inputs": inputs}
    one = sensor_at(port, "sound", rate=RATE, channels="xy", settings=settings)
    assert hasattr(DRIVER, "check")
    with pytest.raises(BenchFileError, match=said):
        DRIVER.check([one])
