"""A snapshot whose every number is known, and a stand for the application's controls."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.estimation import ChannelLabel, SensorState, Settings, Snapshot
from estimator.methods import self_noise

if TYPE_CHECKING:
    from pathlib import Path

SETTINGS = Settings(
    segment=2.0, methods=("three-sensor", "three-channel"), band=(1.0, 20.0), target_cov=0.05
)
SENSORS = ("A", "B", "C")
CHANNELS = ("X", "Y", "Z")
RATE = 200.0


def rotation(degrees: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Turn about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def made_snapshot(*, n_effective: float = 100.0, closed: bool = False) -> Snapshot:
    """Three sensors at 0, 5 and 9° in a motion of 1/f, each channel's noise at −120 dB and up."""
    frequency: np.ndarray[tuple[int], np.dtype[np.float64]] = np.arange(201) * np.float64(0.5)
    motion = 1e-9 / np.maximum(frequency, 0.5)
    turned = np.vstack([rotation(angle) for angle in (0.0, 5.0, 9.0)])
    csm = motion[:, None, None] * (turned @ np.diag([1.0, 1.5, 1.0]) @ turned.T)
    csm = csm + np.diag(np.arange(1, 10) * 1e-12)
    dims = (3, 3, 3)
    n_samples = round(n_effective * 200)
    return Snapshot(
        frequency=frequency,
        csm=csm.astype(np.complex128),
        results={
            method: self_noise(method, csm.astype(complex), dims=dims, n_effective=n_effective)
            for method in SETTINGS.methods
        },
        refused={},
        channels=tuple(ChannelLabel(s, c, "m/s²") for s in SENSORS for c in CHANNELS),
        dims=dims,
        unit="m/s²",
        n_segments=round(n_effective * 1.06),
        n_dropped=0,
        n_effective=n_effective,
        elapsed=n_effective * 1.0,
        time_left=None if closed else 260.0,
        start_utc_ns=1_795_230_000_000_000_000,
        sensors=tuple(
            SensorState(name, RATE, n_samples, n_gaps, 7 * n_gaps, last_seen)
            for name, n_gaps, last_seen in (("A", 0, 1000.0), ("B", 2, 1000.0), ("C", 0, 988.0))
        ),
        clocks=(),
        drift=np.zeros((0, 4)),
        closed=closed,
    )


def empty_snapshot() -> Snapshot:
    """Return the same bench before its first segment."""
    full = made_snapshot()
    return replace(
        full,
        csm=np.full_like(full.csm, np.nan),
        results={},
        n_segments=0,
        n_effective=0.0,
        elapsed=0.0,
        time_left=None,
        sensors=tuple(replace(s, n_samples=0, last_seen=float("nan")) for s in full.sensors),
    )


@dataclass
class Told:
    """Controls that write down what they are told."""

    path: Path
    settings: Settings | None = SETTINGS
    name: str = "lab"
    can_start: bool = True
    running: Path | None = None
    told: list[str] = field(default_factory=list)

    def description(self) -> str:
        """Return what is shown without a recording."""
        return "three sensors of lab"

    def start(self) -> Path:
        """Note it."""
        self.told.append("start")
        return self.path

    def find_running(self) -> Path | None:
        """Return what was prepared."""
        return self.running

    def stop(self, path: Path) -> None:
        """Note it."""
        self.told.append(f"stop {path.name}")

    def mark(self, path: Path, text: str) -> None:
        """Note it."""
        self.told.append(f"mark {path.name} {text}")
