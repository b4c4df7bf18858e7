"""Following a recording whose recorder was killed."""

from __future__ import annotations

import threading
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

from daq.bench import parse
from daq.clock import SystemClock
from daq.recording.layout import SensorLayout
from daq.recording.writer import RecordingWriter
from tui.following import follow

if TYPE_CHECKING:
    from pathlib import Path


def test_a_recorder_that_is_gone_is_trouble(tmp_path: Path) -> None:
    text = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")
    bench, out = parse(text), tmp_path / "killed.h5"
    sensors = [
        SensorLayout(s.name, s.channels, bench.sampling_rate, dtype=np.dtype("<i4"), clock=s.name)
        for s in bench.sensors
    ]
    writer = RecordingWriter.create(out, bench, sensors=sensors, created=SystemClock().now())
    writer.commit()
    writer.abandon()
    trouble: list[str] = []
    follow(
        out,
        None,
        on_snapshot=lambda *_: None,
        on_trouble=trouble.append,
        ended=threading.Event(),
        silence=0.0,
    )
    assert f"huddle repair {out}" in trouble[0]
