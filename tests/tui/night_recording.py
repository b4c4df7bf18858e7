"""A recording of a night with everything in it that results must cope with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from daq.bench.loading import parse
from daq.protocols.block import Event, HostTime, Quantity, Reading
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter
from tests.daq.clocks.recordings import ORIGIN, Sensor, blocks

RATE, N_SAMPLES = 100.0, 6000
HOSTILE = "<script>alert(1)</script>".replace("/", "⁄") + " & $x^2 {{7*7}}"
"""A name as a file from elsewhere may have it; bench files allow all but the slash."""
BENCH = """
name = "pier & <floor>"
operator = "Ada <ada@lab>"
location = "cellar"
sampling_rate = 100.0
{sensors}
[[limits]]
name = "data sheet"
frequency = [1.0, 30.0]
psd = [{psd}, {psd}]
[estimate]
segment = "1s"
axis_tolerance = 0.0
target_cov = 0.1
band = [2.0, 20.0]
[schedule]
time_zone = "Europe/Berlin"
"""
SENSOR = """
[[sensors]]
name = '{name}'
model = "M-1"
serial_number = "SN-{number}"
driver = "text"
port = "/dev/tty{number}"
channels = [
    {{name = "X", sensitivity = 1e6, direction = "east"}}, {{name = "Y", sensitivity = 1e6}},
]
"""


def record(
    path: Path,
    *,
    psd: float = 2e-9,
    more: str = "",
    stated: str = "",
    before_end: Callable[[], object] = lambda: None,
) -> Path:
    """Four biaxial sensors: B misses samples, and Y of the last is dead.

    `more` is added to the bench file, `stated` to each of its channels.
    """
    rng = np.random.default_rng(8)
    motion = 4000 * rng.standard_normal((N_SAMPLES, 2))
    sensors = {}
    for number, name in enumerate(("A", "B", "C", HOSTILE)):
        counts = motion + 100 * rng.standard_normal((N_SAMPLES, 2))
        if name == HOSTILE:
            counts[:, 1] = 0
        gaps = ((1000, 1130), (4000, 4001)) if number == 1 else ()
        sensors[name] = Sensor(counts.round().astype(np.int32), rate=RATE, gaps=gaps)
    tables = "".join(SENSOR.format(name=n, number=i) for i, n in enumerate(sensors))
    tables = tables.replace("sensitivity = 1e6", f"sensitivity = 1e6{stated}")
    bench = parse(BENCH.format(sensors=tables, psd=psd) + more, "bench.toml")
    layouts = [
        SensorLayout(
            each.name, each.channels, RATE, np.dtype("<i4"), clock="one", model=each.model,
            serial_number=each.serial_number, driver="text",
        )
        for each in bench.sensors
    ]  # fmt: skip
    writer = RecordingWriter.create(path, bench, sensors=layouts, created=ORIGIN)
    for name, sensor in sensors.items():
        for block in blocks(name, sensor):
            writer.append(block)
        for second in range(60):
            at = HostTime(ORIGIN.monotonic_ns + second * 10**9, ORIGIN.utc_ns + second * 10**9)
            writer.event(Event(name, "checksum", "a frame was damaged", at))
    for minute, celsius in enumerate((24.0, 26.5)):
        at = HostTime(
            ORIGIN.monotonic_ns + minute * 60 * 10**9, ORIGIN.utc_ns + minute * 60 * 10**9
        )
        writer.reading(Reading("A", Quantity.TEMPERATURE, celsius, at))
        writer.reading(Reading("", Quantity.TEMPERATURE, celsius + 20, at))
    writer.reading(Reading("A", Quantity.SUPPLY, 12.25, ORIGIN))
    writer.gap("B", 1000, 130, reason="cable pulled", estimated=True)
    writer.gap("B", 4000, 1, reason="lost")
    writer.commit()
    before_end()
    writer.close()
    return path
