"""Record nine channels from a real ringserver that is killed and cut off, and account for all.

    python -m tests.acceptance.ringserver PROGRAM [MINUTES]

PROGRAM is a ringserver (https://github.com/EarthScope/ringserver), which is not part of the
project. It runs in a network namespace, so this needs root and iproute2. Three stations of three
channels share one motion; their noise is white and known. Records go to ringserver over DataLink.
Some are never sent: they are the gaps that the recording must have. In turns, the server is killed
and started again, and the packets between it and the recorder are dropped.
"""

from __future__ import annotations

import ctypes
import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pymseed
from scipy.signal import lfilter

import huddle
from daq.recording.reader import Recording

RATE, PER_RECORD = 100.0, 100
STATIONS, CHANNELS = ("S1", "S2", "S3"), ("HNZ", "HNN", "HNE")
NOISE = 50.0
"""Standard deviation of each channel's noise, counts."""
HOLES = {"S2": range(70, 74), "S3": range(150, 151)}
"""Records of a station, counted from the first, that are never sent."""
SPACE, OUTSIDE, INSIDE = "huddle-ring", "10.231.7.1", "10.231.7.2"
PORT = 18000
LINK = "huddle0"

BENCH = "sampling_rate = 100.0\nname = 'ringserver'\n" + "".join(
    f"""
[[sensors]]
name = "{station}"
driver = "seedlink"
port = "seedlink://{INSIDE}:{PORT}"
settings = {{ network = "XX", station = "{station}", channels = ["HN?"], patience = 15.0 }}
"""
    + "".join(
        f'[[sensors.channels]]\nname = "{name[-1]}"\nunit = "m/s2"\nsensitivity = 1e5\n'
        for name in CHANNELS
    )
    for station in STATIONS
)


def counts_of(n_samples: int) -> np.ndarray:
    """Return what the channels feel, in counts, shape (3 stations, 3 channels, n_samples)."""
    generator = np.random.default_rng(20261122)
    motion = lfilter([1.0], [1.0, -0.97], 300.0 * generator.standard_normal((3, n_samples)))
    noise = NOISE * generator.standard_normal((3, 3, n_samples))
    return np.rint(motion[None] + noise).astype(np.int32)


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


class Server:
    """The ringserver in its namespace."""

    def __init__(self, program: str, folder: Path) -> None:
        self._command = [
            *("ip", "netns", "exec", SPACE, program),
            *("-Rd", str(folder), "-Rs", "50M", "-L", str(PORT), "-DL", "16000"),
        ]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it; it takes up what a server that ended before has kept."""
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT
        )

    def end(self, signal: str) -> None:
        """End it by a signal, and wait."""
        if self._process is not None:
            subprocess.run(["pkill", f"-{signal}", "-x", "ringserver"], check=False)
            self._process.wait()


class Feeder:
    """Sends each record when its last sample has been taken; keeps what the server cannot take."""

    def __init__(self, counts: np.ndarray, begin: float) -> None:
        self._counts, self._begin = counts, begin
        self._socket: socket.socket | None = None
        self.index = 0
        """The record being sent."""

    def _connect(self) -> socket.socket:
        link = socket.create_connection(("127.0.0.1", 16000), timeout=5)
        self.ask(link, b"ID test:huddle:1:x")
        return link

    @staticmethod
    def ask(link: socket.socket, header: bytes, payload: bytes = b"") -> bytes:
        """Send a DataLink packet and return the header of its reply; raises ConnectionError."""
        link.sendall(b"DL" + bytes([len(header)]) + header + payload)
        prefix = link.recv(3, socket.MSG_WAITALL)
        if len(prefix) < 3:
            raise ConnectionError("ringserver closed the connection")
        answer = link.recv(prefix[2], socket.MSG_WAITALL)
        if answer.startswith((b"OK", b"ERROR")):
            size = int(answer.split()[2])
            text = link.recv(size, socket.MSG_WAITALL) if size else b""
            if answer.startswith(b"ERROR"):
                raise ConnectionError(text.decode())
        return answer

    def _records(self, index: int) -> list[tuple[str, bytes, float]]:
        found = []
        for s, station in enumerate(STATIONS):
            if index in HOLES.get(station, ()):
                continue
            for c, channel in enumerate(CHANNELS):
                data = self._counts[s, c, index * PER_RECORD : (index + 1) * PER_RECORD]
                start = self._begin + index * PER_RECORD / RATE
                record = pymseed.MS3Record()
                record.sourceid = f"FDSN:XX_{station}__{channel[0]}_{channel[1]}_{channel[2]}"
                record.reclen, record.formatversion = 512, 2
                record.samprate, record.encoding = RATE, pymseed.DataEncoding.STEIM2
                record.starttime = round(start * 1e9)
                found += [
                    (f"XX_{station}__{channel}/MSEED", packed, start)
                    for packed in record.generate(list(map(int, data)), "i")
                ]
        return found

    def send(self, index: int, until: float) -> None:
        """Send a second of all stations, trying again until the server takes it."""
        self.index = index
        for name, record, start in self._records(index):
            us = round(start * 1e6)
            header = f"WRITE {name} {us} {us + 990_000} A {len(record)}".encode()
            while time.time() < until:
                try:
                    self._socket = self._socket or self._connect()
                    self.ask(self._socket, header, record)
                    break
                except OSError:
                    self._socket = None
                    time.sleep(0.5)


def disturb(server: Server, feeder: Feeder, killed: list[int], stop: threading.Event) -> None:
    """Each half minute end the server, or drop its packets, or kill it, in turns."""
    turn = 0
    while not stop.wait(30):
        turn += 1
        if turn % 4 in {1, 3}:
            if turn % 4 == 3:
                killed.append(feeder.index)
            server.end("KILL" if turn % 4 == 3 else "TERM")
            time.sleep(5)
            server.start()
        else:
            run("ip", "route", "replace", "blackhole", f"{INSIDE}/32")
            time.sleep(20)
            run("ip", "route", "del", "blackhole", f"{INSIDE}/32")


def account(path: Path, counts: np.ndarray, killed: list[int]) -> dict[str, object]:
    """Compare the recording with what was fed; raises AssertionError.

    A ringserver that is killed (SIGKILL) forgets its ring, and with it what it had not sent yet.
    """
    forgotten = {index - k for index in killed for k in range(3)}
    told: dict[str, object] = {}
    with Recording.open(path) as recording:
        for s, sensor in enumerate(recording.sensors):
            blocks = sensor.blocks
            rows = np.cumsum(blocks["n_samples"]) - blocks["n_samples"]
            found = sensor.counts()
            index = np.arange(len(found)) + np.repeat(
                blocks["first_sample"] - rows, blocks["n_samples"]
            )
            first = next(
                k
                for k in range(counts.shape[-1])
                if np.array_equal(counts[s, :, k : k + 50].T, found[:50])
            )
            place = first + index - index[0]
            assert (np.diff(place) > 0).all()
            np.testing.assert_array_equal(found, counts[s][:, place].T)
            missing = np.setdiff1d(np.arange(place[0], place[-1] + 1), place)
            records = set(range(-(-place[0] // PER_RECORD), place[-1] // PER_RECORD))
            assert len(missing) % PER_RECORD == 0
            lost = set((missing // PER_RECORD).tolist())
            never_sent = records & set(HOLES.get(sensor.name, ()))
            assert never_sent <= lost <= never_sent | forgotten, (sensor.name, lost)
            kinds = [str(event.kind) for event in recording.events if event.sensor == sensor.name]
            told[sensor.name] = {
                "samples": len(found),
                "missing": len(missing),
                "gaps": sensor.gaps["missing"].tolist(),
                "connected": kinds.count("connected"),
            }
    return told


def main(program: str, minutes: float) -> None:
    n_seconds = int(minutes * 60)
    counts = counts_of(int((n_seconds + 60) * RATE))
    run("ip", "netns", "add", SPACE)
    try:
        run("ip", "link", "add", LINK, "type", "veth", "peer", "name", "eth0", "netns", SPACE)
        run("ip", "address", "add", f"{OUTSIDE}/30", "dev", LINK)
        run("ip", "link", "set", LINK, "up")
        for command in (
            ("address", "add", f"{INSIDE}/30", "dev", "eth0"),
            ("link", "set", "eth0", "up"),
            ("link", "set", "lo", "up"),
        ):
            run("ip", "-n", SPACE, *command)
        with TemporaryDirectory() as folder:
            _run(program, Path(folder), counts, n_seconds)
    finally:
        subprocess.run(["ip", "netns", "del", SPACE], check=False)


def _run(program: str, folder: Path, counts: np.ndarray, n_seconds: int) -> None:
    (folder / "ring").mkdir()
    (folder / "bench.toml").write_text(BENCH, encoding="utf-8")
    server, stop = Server(program, folder / "ring"), threading.Event()
    server.start()
    begin = float(int(time.time()) + 2)
    feeder, killed = Feeder(counts, begin), list[int]()

    def feed() -> None:
        """From within the namespace, where nothing is dropped."""
        _enter(SPACE)
        for index in range(n_seconds + 60):
            if stop.wait(max(0.0, begin + index + 1.1 - time.time())):
                return
            feeder.send(index, time.time() + 60)

    threads = [
        threading.Thread(target=feed),
        threading.Thread(target=disturb, args=(server, feeder, killed, stop)),
    ]
    for thread in threads:
        thread.start()
    time.sleep(5)
    path = folder / "recording.h5"
    try:
        command = [sys.executable, "-m", "huddle", "run", str(folder / "bench.toml")]
        command += [
            "--out",
            str(path),
            "--duration",
            f"{n_seconds}s",
            "--json",
            str(folder / "r.json"),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        print(done.stderr[-3000:], done.stdout[-3000:])
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        server.end("KILL")
    print(json.dumps(account(path, counts, killed), indent=1))
    noise = huddle.estimate(path, segment="10s")
    truth = 2 * (NOISE**2 + 1 / 12) / RATE / 1e10
    band = (noise.frequency >= 0.1) & (noise.frequency <= 45)
    inside = (noise.noise_low <= truth) & (truth <= noise.noise_high)
    print(f"{inside[band].mean():.1%} of the 95 % intervals cover the true noise")


def _enter(space: str) -> None:
    """Move this thread into a network namespace."""
    with Path(f"/run/netns/{space}").open(encoding="utf-8") as handle:
        if ctypes.CDLL(None, use_errno=True).setns(handle.fileno(), 0x40000000):
            raise OSError(ctypes.get_errno(), "setns")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]) if len(sys.argv) > 2 else 10.0)
