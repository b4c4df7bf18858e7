"""Secrets of a bench file are not copied into its recordings."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from daq.bench.loading import parse
from daq.protocols.block import HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.writer import RecordingWriter

BENCH = """
name = "lab"  # a comment that stays
sampling_rate = 100.0
{hooks}
[[sensors]]
name = "a"
driver = "epson"
port = "x"
channels = [{{name = "x", sensitivity = 1.0}}]

[storage]
keep_runs = 5
"""


@pytest.mark.parametrize(
    "hooks",
    [
        '[hooks]\non_finished = ["curl", "s3cret"]\n[metrics]\nport = 1',
        'hooks.on_failed = ["s3cret"]\nmetrics.port = 1',
        'hooks = {on_failed = ["s3cret"], retries = 2}',
    ],
)
def test_hooks_and_metrics_are_not_recorded(
    tmp_path: Path, hooks: str, caplog: pytest.LogCaptureFixture
) -> None:
    bench = parse(BENCH.format(hooks=hooks), tmp_path / "lab.toml")
    assert bench.hooks.retries
    layout = SensorLayout("a", bench.sensors[0].channels, 100.0, np.dtype("i4"))
    path = tmp_path / "r.h5"
    RecordingWriter.create(path, bench, sensors=[layout], created=HostTime(1, 2)).close()
    assert b"s3cret" not in path.read_bytes()
    with Recording.open(path) as recording, caplog.at_level(logging.WARNING):
        assert "# a comment that stays" in recording.bench_text
        assert recording.bench is not None
        assert recording.bench.sensors == bench.sensors
        assert recording.bench.storage == bench.storage
    assert not caplog.records


def test_a_recording_with_hooks_warns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("daq.recording.writer.recorded_text", lambda bench: bench.text)
    bench = parse(BENCH.format(hooks='[hooks]\non_failed = ["x"]'), tmp_path / "lab.toml")
    layout = SensorLayout("a", bench.sensors[0].channels, 100.0, np.dtype("i4"))
    path = tmp_path / "r.h5"
    RecordingWriter.create(path, bench, sensors=[layout], created=HostTime(1, 2)).close()
    with caplog.at_level(logging.WARNING):
        Recording.open(path).close()
        Recording.open(path).close()
    (said,) = caplog.records  # once
    assert "holds [hooks] of its bench file" in said.getMessage()
    assert "holds [hooks] of its bench file" in verify(path).warning
