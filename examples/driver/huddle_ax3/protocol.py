"""What the AX3 sends and accepts, sans-IO: bytes in, blocks out.

Commands are lines of ASCII, each answered by one line:

========= ====================== ==================================
STOP      STOPPED                ends the stream
ID        ID AX3 1001 1.0        model, serial number, firmware
RATE 100  RATE 100               sets the sampling rate, in Hz
START     STARTED                begins the stream
========= ====================== ==================================

The stream is a sequence of frames of 18 bytes, little-endian: 0xA5 0x5A, a counter that wraps at
65536, three counts of 32 bits (x, y, z), and the sum of the 16 bytes before, modulo 65536.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.devices.epson.burst import find_frames
from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.sample_counter import SampleCounter

FRAME = np.dtype([("sync", "<u2"), ("counter", "<u2"), ("counts", "<i4", (3,)), ("sum", "<u2")])
SYNC = 0x5AA5
COUNTER_MODULUS = 65536
FULL_SCALE = 20_000_000
"""Counts at the end of the range."""
RATES = (50, 100, 200)
"""Sampling rates in Hz."""
REPORT_INTERVAL_NS = 1_000_000_000
"""Least host time between two reports of skipped bytes: a bad line must not fill the recording."""


def encode(first: int, counts: NDArray[np.int32]) -> bytes:
    """Return frames; the simulator sends them.

    Parameters
    ----------
    first : int
        Number of the first sample.
    counts : int32, shape (n_samples, 3)
    """
    frames = np.zeros(len(counts), FRAME)
    frames["sync"] = SYNC
    frames["counter"] = (first + np.arange(len(counts))) % COUNTER_MODULUS
    frames["counts"] = counts
    frames["sum"] = frames.view(np.uint8).reshape(-1, FRAME.itemsize)[:, :-2].sum(axis=1)
    return frames.tobytes()


def _valid(windows: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which windows of the length of a frame are frames."""
    good: NDArray[np.bool_] = (windows[:, 0] == SYNC & 0xFF) & (windows[:, 1] == SYNC >> 8)
    given = windows[:, -2].astype(np.uint16) + (windows[:, -1].astype(np.uint16) << 8)
    good &= windows[:, :-2].sum(axis=1, dtype=np.uint16) == given
    return good


class Decoder:
    """Decodes the stream of one AX3.

    Parameters
    ----------
    sensor : str
        Name of the sensor in the bench file.
    sampling_rate : float
        In Hz.
    """

    def __init__(self, sensor: str, sampling_rate: float) -> None:
        self._sensor = sensor
        self._counter = SampleCounter(COUNTER_MODULUS, sampling_rate)
        self._rest = b""
        self._started = False
        self._skipped = 0  # bytes that no event has reported
        self._next_report_ns = 0

    def receive(self, received: bytes, at: HostTime) -> list[Block | Event]:
        """Return the blocks and events that the received bytes complete."""
        found: list[Block | Event] = []
        stream = self._rest + received
        runs, consumed = find_frames(np.frombuffer(stream, np.uint8), FRAME.itemsize, _valid)
        self._rest = stream[consumed:]
        self._skipped += consumed - FRAME.itemsize * sum(n_frames for _, n_frames in runs)
        if self._skipped and at.monotonic_ns >= self._next_report_ns:
            text = f"{self._skipped} bytes skipped between frames"
            found.append(Event(self._sensor, EventKind.RESYNCHRONISED, text, at))
            self._skipped, self._next_report_ns = 0, at.monotonic_ns + REPORT_INTERVAL_NS
        if runs:
            parts = [np.frombuffer(stream, FRAME, n, offset) for offset, n in runs]
            found += self._blocks(np.concatenate(parts), at)
        return found

    def _blocks(self, frames: NDArray[np.void], at: HostTime) -> list[Block | Event]:
        runs, n_repeated = self._counter.place(frames["counter"], at)
        found: list[Block | Event] = []
        if n_repeated:
            text = f"{n_repeated} frames repeated"
            found.append(Event(self._sensor, EventKind.RESYNCHRONISED, text, at))
        for run in runs:
            counts = frames["counts"][run.start : run.stop].astype(np.int32)
            flags, reason = BlockFlag.NONE, ""
            if run.restarted or not self._started:
                flags |= BlockFlag.CLOCK_RESTART
            if run.missing:
                reason = f"{run.missing} samples not received"
            if run.restarted:
                flags |= BlockFlag.MISSING_ESTIMATED
                reason = "the device restarted"
                found.append(Event(self._sensor, EventKind.RESET, reason, at))
            if counts.max() >= FULL_SCALE or counts.min() <= -FULL_SCALE:
                flags |= BlockFlag.CLIPPED
            self._started = True
            found.append(
                Block(self._sensor, run.first_sample, counts, at, run.counter, flags, reason)
            )
        return found
