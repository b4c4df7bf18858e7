"""A recorder that is stopped by SIGSTOP, and a logger of another hand that does not wait."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from daq.protocols.block import EventKind
from daq.recording.reader import Recording

RATE = 200.0
BEFORE, AFTER = 8.0, 9.0


class Logger:
    """Sends a row every 5 ms: its number and filling; a row that finds the line full is lost."""

    def __init__(self) -> None:
        self.sent: list[int] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        self.port = f"socket://127.0.0.1:{self._listening.getsockname()[1]}"
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        """End, and wait for the thread."""
        self._ends.set()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join()

    def _serve(self) -> None:
        try:
            line, _ = self._listening.accept()
        except OSError:
            return
        with line:
            line.setblocking(False)
            rest, number, begin = b"", 0, time.monotonic()
            while not self._ends.wait(max(0.0, begin + number / RATE - time.monotonic())):
                row = b"%d,%0400d\n" % (number, number * 7919 % 30_011)
                try:
                    if rest:
                        rest = rest[line.send(rest) :]
                    if not rest:
                        rest = row[line.send(row) :]
                        self.sent.append(number)
                except BlockingIOError:
                    pass
                except OSError:
                    return
                number += 1


@pytest.fixture
def logger() -> Iterator[Logger]:
    one = Logger()
    yield one
    one.close()


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="SIGSTOP")
@pytest.mark.parametrize("stop", [1.0, 20.0])
def test_a_stopped_recorder_keeps_every_row_that_arrived(
    logger: Logger, tmp_path: Path, stop: float
) -> None:
    bench, path = tmp_path / "bench.toml", tmp_path / "r.h5"
    bench.write_text(
        f'name = "one"\nsampling_rate = {RATE}\n'
        f'[[sensors]]\nname = "B"\ndriver = "text"\nport = "{logger.port}"\n'
        '[[sensors.channels]]\nname = "X"\nsensitivity = 1.0\n'
        '[[sensors.channels]]\nname = "Y"\nsensitivity = 1.0\n'
    )
    command = [sys.executable, "-m", "tui", "record", str(bench), "--out", str(path)]
    with subprocess.Popen([*command, "--until-stopped"], stderr=subprocess.DEVNULL) as recorder:
        while not path.exists():
            assert recorder.poll() is None
            time.sleep(0.05)
        time.sleep(BEFORE)
        recorder.send_signal(signal.SIGSTOP)
        time.sleep(stop)
        recorder.send_signal(signal.SIGCONT)
        time.sleep(AFTER)
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait() == 0
    with Recording.open(path) as recording:
        (sensor,) = recording.sensors
        numbers = sensor.counts(0, sensor.n_samples)[:, 0].astype(int)
        spans = [(int(b["first_sample"]), int(b["n_samples"])) for b in sensor.blocks]
        index = np.concatenate([np.arange(first, first + n) for first, n in spans])
        gaps = sensor.gaps
        overflows = [one for one in recording.events if one.kind == EventKind.OVERFLOW]
    sent = np.array(logger.sent)
    assert np.isin(numbers, sent).all()
    inside = sent[(sent >= numbers[0]) & (sent <= numbers[-1])]
    assert numbers.tolist() == inside.tolist()  # what was sent, and nothing else
    lost = int(numbers[-1] - numbers[0] + 1 - len(numbers))
    assert gaps["estimated"].all()
    assert len(gaps) == len(overflows) == (lost > 0)
    assert (lost > 0) == (stop > 10)
    off = (index - index[0]) - (numbers - numbers[0])
    assert np.count_nonzero(np.abs(off) > 0.3 * RATE) <= RATE * (lost > 0)  # near the gap
