"""A clock that cannot be a clock is refused, not resampled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.clocks.aligned_recording import AlignedRecording
from daq.errors import CannotAlignError
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording


@pytest.mark.parametrize(
    ("ppm", "refused"), [(-800_000.0, True), (2500.0, True), (-900.0, False), (100.0, False)]
)
def test_a_rate_beyond_1000_ppm_is_refused(tmp_path: Path, ppm: float, *, refused: bool) -> None:
    path, rate, n_samples = tmp_path / "r.h5", 100.0, 12_000
    channels = (Channel(name="x", sensitivity=1.0),)
    layouts = [SensorLayout(n, channels, rate, np.dtype("i4"), clock=n) for n in "AB"]
    rng = np.random.default_rng(1)
    with ArrayWriter(path, sensors=layouts, created=HostTime(10**12, 10**18)) as writer:
        for name, error in (("A", 0.0), ("B", ppm)):
            ends = np.arange(100, n_samples + 1, 100) / (rate * (1 + error * 1e-6))
            counts = rng.integers(-100, 100, (n_samples, 1)).astype(np.int32)
            received = np.round(ends * 1e9).astype(np.int64)
            writer.samples(name, counts, block_rows=100, received_ns=received)
    with Recording.open(path) as recording:
        if refused:
            with pytest.raises(CannotAlignError, match=r"sensor 'B' sent .* samples per second"):
                AlignedRecording(recording)
        else:
            AlignedRecording(recording)
