"""Day files of miniSEED of stations with three small sensors, in SDS folders."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pymseed

from daq.estimation.settings import Settings

RATE = 1.0
DAY_NS = 86400 * 10**9
FIRST_NS = 20_454 * DAY_NS  # 2026-01-01
SETTINGS = Settings(segment=60.0, methods=("three-sensor",))
ROWS = 250
"""Samples of a record: the last of a day reaches into the next one."""


def write_station(
    root: Path,
    station: str = "ABC",
    *,
    begin: float = 0.0,
    days: float = 2.0,
    locations: Sequence[str] = ("00", "10", "20"),
    seed: int = 1,
    gap: tuple[float, float] | None = None,
) -> None:
    """Write day files from `begin` on, in days: one motion, noise of its own in each sensor.

    Records straddle midnights. A `gap` is in days, and in all sensors.
    """
    rng = np.random.default_rng(seed)
    n = round(days * 86400 * RATE)
    motion = rng.normal(size=n) * 500
    start_ns = FIRST_NS + round(begin * DAY_NS)
    for location in locations:
        counts = np.rint(motion + 20 * rng.normal(size=n)).astype(np.int32)
        for row in range(0, n, ROWS):
            at = row / 86400 / RATE
            if gap is not None and gap[0] <= at < gap[1]:
                continue
            time_ns = start_ns + round(row * 1e9 / RATE)
            append(root, station, location, time_ns, counts[row : row + ROWS])


def append(
    root: Path,
    station: str,
    location: str,
    start_ns: int,
    counts: np.ndarray[tuple[int], np.dtype[np.int32]],
) -> Path:
    """Append a record to the day file of its beginning."""
    when = datetime.fromtimestamp(start_ns // 10**9, UTC)
    folder = root / f"{when:%Y}" / "XX" / station / "LHZ.D"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"XX.{station}.{location}.LHZ.D.{when:%Y.%j}"
    record = pymseed.MS3Record(reclen=1024, encoding=11)
    record.formatversion = 2
    record.sourceid = pymseed.nslc2sourceid("XX", station, location, "LHZ")
    record.samprate = RATE
    record.starttime = start_ns
    with path.open("ab") as file:
        for packed in record.generate(counts, "i"):
            file.write(packed)
    return path
