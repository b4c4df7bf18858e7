"""Simulated AX3 on TCP ports, or one on a pseudo-terminal: ``python -m huddle_ax3.simulator``.

All devices measure the same motion, and each has noise of its own, so that an estimate has a known
result. Sample n of a device is a function of n alone.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from huddle_ax3.protocol import RATES, encode

COUNTS_PER_UNIT = 1e6
MOTION_PSD = 1e-6
"""(m/s²)²/Hz, on each axis."""
NOISE_PSD = 1e-9
"""(m/s²)²/Hz, of each channel."""
SEND_INTERVAL = 0.05
"""Seconds."""
COUNTER_OF_RESTART = 30_000
"""Samples further on: a counter that began at 0 could be one that overflowed."""
_CHUNK = 1024


def samples(number: int, rate: float, first: int, n_samples: int) -> NDArray[np.int32]:
    """Return counts of a device, shape (n_samples, 3)."""
    chunks = range(first // _CHUNK, (first + n_samples - 1) // _CHUNK + 1)
    made = np.concatenate([_chunk(number, rate, chunk) for chunk in chunks])
    skip = first - chunks[0] * _CHUNK
    return made[skip : skip + n_samples]


def _chunk(number: int, rate: float, chunk: int) -> NDArray[np.int32]:
    motion = np.random.default_rng([1, chunk]).standard_normal((_CHUNK, 3))
    noise = np.random.default_rng([2, chunk, number]).standard_normal((_CHUNK, 3))
    angle = 0.1 * number  # about the vertical axis, in rad
    turn = np.array(
        [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    bandwidth = rate / 2
    measured = motion @ turn.T * (MOTION_PSD * bandwidth) ** 0.5
    measured += noise * (NOISE_PSD * bandwidth) ** 0.5
    counts: NDArray[np.int32] = np.rint(measured * COUNTS_PER_UNIT).astype(np.int32)
    return counts


class Simulator:
    """One AX3: takes received bytes, sends to the reader that is plugged in.

    Parameters
    ----------
    number : int
        0 for the first device; its serial number is 1001.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.rate = 100.0
        self.sent = 0
        """Number of the next sample."""
        self._counter = 0  # of the next frame
        self._counted: list[tuple[range, float]] = []  # samples since START; the delay of each
        self._send: Callable[[bytes], object] = lambda _: None
        self._line = b""
        self._n_to_lose = 0
        self._streaming: asyncio.Task[None] | None = None

    def plug(self, send: Callable[[bytes], object]) -> None:
        """Connect a reader; ``send`` takes the bytes for it."""
        self.stop()
        self._send, self._line = send, b""

    def receive(self, received: bytes) -> None:
        """Answer every complete line."""
        *lines, self._line = (self._line + received).split(b"\r\n")
        for line in lines:
            self._answer(line.decode("ascii", errors="replace").split())

    def stop(self) -> None:
        """End the stream."""
        if self._streaming is not None:
            self._streaming.cancel()
            self._streaming = None

    def lose(self, n_samples: int) -> None:
        """Let the line lose the next samples: they are counted and not sent."""
        self._n_to_lose = n_samples

    def slip(self, n_samples: int) -> None:
        """Leave out the next samples, or count the last ones again: no counter shows it."""
        if n_samples > 0:
            self.sent += n_samples
        else:
            again = range(self.sent + n_samples, self.sent)
            self._counted.append((again, -n_samples / self.rate))
            self._send(encode(self._counter, self._samples(again)))
            self._counter += len(again)

    def restart(self) -> None:
        """Restart: nothing is sampled for a second, and the counter begins elsewhere."""
        self.sent += round(self.rate)
        self._counter += COUNTER_OF_RESTART

    def truth(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Return all samples since START, and the time of each by the clock of the event loop."""
        counts = [self._samples(taken) for taken, _ in self._counted]
        due = [np.array(taken) / self.rate + delay for taken, delay in self._counted]
        return np.concatenate(counts), np.concatenate(due)

    def _samples(self, taken: range) -> NDArray[np.int32]:
        return samples(self.number, self.rate, taken.start, len(taken))

    def _answer(self, words: Sequence[str]) -> None:
        match words:
            case ["STOP"]:
                self.stop()
                self._send(b"STOPPED\r\n")
            case ["ID"]:
                self._send(f"ID AX3 {1001 + self.number} 1.0\r\n".encode("ascii"))
            case ["RATE", rate] if rate in map(str, RATES):
                self.rate = float(rate)
                self._send(f"RATE {rate}\r\n".encode("ascii"))
            case ["START"]:
                self._send(b"STARTED\r\n")
                self._streaming = asyncio.create_task(self._stream())
            case _:
                self._send(b"ERROR\r\n")

    async def _stream(self) -> None:
        # All devices sample at the same instants: sample n is taken at n / rate of the clock.
        now = asyncio.get_running_loop().time
        self.sent = self._counter = int(now() * self.rate)
        self._counted.clear()
        while True:
            await asyncio.sleep(SEND_INTERVAL)
            lost, self._n_to_lose = self._n_to_lose, 0
            taken = range(self.sent, max(int(now() * self.rate) + 1, self.sent + lost))
            if taken:
                self._counted.append((taken, 0.0))
            if taken[lost:]:
                self._send(encode(self._counter + lost, self._samples(taken[lost:])))
            self._counter += len(taken)
            self.sent = taken.stop


class TcpPort:
    """A TCP port on which one simulated device answers."""

    def __init__(self, number: int) -> None:
        self.device = Simulator(number)
        self.server: asyncio.Server
        self._readers: list[asyncio.StreamWriter] = []

    async def open(self, port: int) -> None:
        """Listen at a port; 0 for a free one."""
        self.server = await asyncio.start_server(self._connected, "127.0.0.1", port)

    def close(self) -> None:
        """Hang up on every reader and stop listening, as an unplugged device does."""
        self.device.stop()
        self.server.close()
        for writer in self._readers:
            writer.close()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._readers.append(writer)
        self.device.plug(writer.write)
        with contextlib.suppress(ConnectionError):
            while received := await reader.read(4096):
                self.device.receive(received)
        self.device.stop()
        self._readers.remove(writer)
        writer.close()


async def serve_tcp(n_devices: int, port: int) -> list[TcpPort]:
    """Serve devices on consecutive TCP ports, or each on a free port if ``port`` is 0."""
    ports = [TcpPort(number) for number in range(n_devices)]
    for number, one in enumerate(ports):
        await one.open(port and port + number)
    return ports


async def serve_terminal() -> None:
    """Serve one device on a pseudo-terminal, until cancelled (Linux, macOS)."""
    import tty  # noqa: PLC0415 - Windows has none

    master, slave = os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    device = Simulator(0)
    device.plug(lambda octets: os.write(master, octets))
    loop = asyncio.get_running_loop()
    loop.add_reader(master, lambda: device.receive(os.read(master, 4096)))
    await asyncio.Event().wait()


async def _main(arguments: argparse.Namespace) -> None:
    if arguments.terminal:
        await serve_terminal()
    for one in await serve_tcp(arguments.devices, arguments.port):
        host, port = one.server.sockets[0].getsockname()
        print(f"socket://{host}:{port}", flush=True)
    await asyncio.Event().wait()


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description="Serve simulated AX3 accelerometers.")
    parser.add_argument("--devices", type=int, default=3, help="number of devices (default 3)")
    parser.add_argument("--port", type=int, default=4001, help="first TCP port; 0: free ports")
    parser.add_argument("--terminal", action="store_true", help="one device on a pseudo-terminal")
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_main(parser.parse_args()))


if __name__ == "__main__":
    main()
