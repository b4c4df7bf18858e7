"""A stand-in for a vendor's SDK, whose calls block: it reads an AX3 over TCP."""

from __future__ import annotations

import socket

import numpy as np
from numpy.typing import NDArray

from huddle_ax3.protocol import FRAME


class SdkError(Exception):
    """The device does not answer, or is gone."""


class Device:
    """One AX3. Every call blocks."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._socket = socket.create_connection((host, port), timeout=2.0)
        except OSError as error:
            raise SdkError(str(error)) from error
        self._received = b""
        self.counter = -1
        """Number of the first sample of the last read; it does not wrap."""

    def ask(self, command: str) -> str:
        """Return the reply to a command."""
        self._socket.settimeout(1.0)
        try:
            self._socket.sendall(f"{command}\r\n".encode("ascii"))
            while b"\r\n" not in self._received:
                self._receive()
        except OSError as error:
            raise SdkError(f"no reply to {command}: {error}") from error
        reply, _, self._received = self._received.partition(b"\r\n")
        return reply.decode("ascii", errors="replace")

    def read(self, n_samples: int, timeout: float) -> NDArray[np.int32] | None:
        """Return up to ``n_samples`` that follow one another, or None after the timeout."""
        self._socket.settimeout(timeout)
        try:
            while len(self._received) < n_samples * FRAME.itemsize:
                self._receive()
        except TimeoutError:
            pass
        except OSError as error:
            if len(self._received) < FRAME.itemsize:
                raise SdkError(str(error)) from error
        n_samples = min(n_samples, len(self._received) // FRAME.itemsize)
        if not n_samples:
            return None
        frames = np.frombuffer(self._received, FRAME, n_samples)
        gaps = np.flatnonzero(np.diff(frames["counter"]) != 1)  # modulo 65536, as uint16
        if gaps.size:
            frames = frames[: int(gaps[0]) + 1]
        self._received = self._received[frames.nbytes :]
        self.counter += (int(frames["counter"][0]) - self.counter) % 65536
        return frames["counts"].astype(np.int32)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _receive(self) -> None:
        received = self._socket.recv(65536)
        if not received:
            raise ConnectionResetError("the device hung up")
        self._received += received
