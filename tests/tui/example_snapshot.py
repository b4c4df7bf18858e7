"""A snapshot whose every number is known, and a stand for the application's controls."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from daq.bench.model import Bench, Limit
from daq.clocks.clock_model import ClockSource, ClockState
from daq.devices.bench_file import parse
from daq.devices.interface import DeviceInformation
from daq.errors import HuddleError
from daq.estimation.settings import Settings
from daq.estimation.snapshot import ChannelLabel, SensorTotals, Snapshot
from daq.estimation.snapshot_diagnostics import (
    Diagnosis,
    FrequencyDiagnosis,
    SnapshotDiagnostics,
    Synchronisation,
)
from daq.host_clock import SystemClock
from daq.preflight.device_check import DiscoveredDevice
from daq.protocols.block import Event, EventKind, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.monitor import RecordingStatus, SensorStatus
from daq.recording.sensor_state import SensorState
from daq.recording.storage.names import CONTINUES
from daq.recording.writer import RecordingWriter
from daq.results.decision.verdict import TestVerdict
from daq.results.result import Result
from estimator.checks.advice import Advice, Rank
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.diagnose import Diagnostics, diagnose
from estimator.methods import self_noise
from estimator.types import FloatArray
from tests.tui.demo_bench import DEMO
from tui.application.controls import Preview
from tui.application.plan import TestPlan

SETTINGS = Settings(
    segment=2.0, methods=("three-sensor", "three-channel"), band=(1.0, 20.0), target_cov=0.05
)
SENSORS = ("A", "B", "C")
CHANNELS = ("X", "Y", "Z")
RATE = 200.0
PPM, RESIDUALS = (5.9, -9.1, 4.0), (0.0, 0.4e-6, 0.6e-6)

STRANGER = NoSharedMotion(
    rank=Rank.INVALIDATES,
    sensors=(0,),
    band=(0.5, 100.0),
    partners=(1, 2),
    share=0.001,
    share_of_partners=0.99,
)
"""The first sensor is elsewhere."""


def rotation(degrees: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Turn about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def made_snapshot(
    *,
    n_effective: float = 100.0,
    closed: bool = False,
    clock_share: float = 0.0004,
    n_channels: int = len(CHANNELS),
) -> Snapshot:
    """Three sensors at 0, 5 and 9° in a motion of 1/f, each channel's noise at −120 dB and up."""
    frequency: np.ndarray[tuple[int], np.dtype[np.float64]] = np.arange(201) * np.float64(0.5)
    motion = 1e-9 / np.maximum(frequency, 0.5)
    turned = np.vstack([rotation(angle)[:n_channels] for angle in (0.0, 5.0, 9.0)])
    csm = motion[:, None, None] * (turned @ np.diag([1.0, 1.5, 1.0]) @ turned.T)
    csm = csm + np.diag(np.arange(1, 3 * n_channels + 1) * 1e-12)
    dims = (n_channels,) * 3
    n_samples = round(n_effective * 200)
    return Snapshot(
        frequency=frequency,
        csm=csm.astype(np.complex128),
        results={
            method: self_noise(method, csm.astype(complex), dims=dims, n_effective=n_effective)
            for method in SETTINGS.methods
        },
        refused={},
        channels=tuple(ChannelLabel(s, c, "m/s²") for s in SENSORS for c in CHANNELS[:n_channels]),
        dims=dims,
        unit="m/s²",
        n_segments=round(n_effective * 1.06),
        n_dropped=0,
        n_effective=n_effective,
        elapsed=n_effective * 1.0,
        start_utc_ns=1_795_230_000_000_000_000,
        sensors=tuple(
            SensorTotals(name, RATE, n_samples, n_gaps, 7 * n_gaps, last_seen)
            for name, n_gaps, last_seen in (("A", 0, 1000.0), ("B", 2, 1000.0), ("C", 0, 988.0))
        ),
        clocks=tuple(
            ClockState(
                *(name, ClockSource.ARRIVAL_TIMES, 0.0, ppm, 0.02, 0.1, residual, 1),
                refined=residual > 0,
            )
            for name, ppm, residual in zip(SENSORS, PPM, RESIDUALS, strict=True)
        ),
        drift=made_drift(),
        closed=closed,
        diagnostics=SnapshotDiagnostics(
            synchronisation=Synchronisation(
                residual=dict(zip(SENSORS, RESIDUALS, strict=True)),
                noise_bias=np.full((len(frequency), sum(dims)), clock_share),
                reference=SENSORS[0],
            )
        ),
    )


@functools.cache
def _diagnosis(
    csm: bytes, shape: tuple[int, ...], n_effective: float, n_factors: int | None
) -> Diagnostics:
    """Diagnose the averages of three sensors, once for all tests that show the same."""
    return diagnose(
        np.frombuffer(csm, dtype=np.complex128).reshape(shape),
        np.arange(shape[0]) * np.float64(0.5),
        dims=(shape[1] // 3,) * 3,
        n_effective=n_effective,
        n_factors=n_factors,
        vertical=2,
    )


def diagnosed(
    change: FloatArray | None = None,
    *,
    n_effective: float = 400.0,
    n_factors: int | None = None,
    sensors: tuple[str, ...] = SENSORS,
    channels: tuple[str, ...] = CHANNELS,
) -> Snapshot:
    """Return a finished snapshot with the diagnosis of its averages, changed before."""
    snapshot = made_snapshot(n_effective=n_effective, closed=True)
    csm = snapshot.csm if change is None else change @ snapshot.csm @ change.T
    found = _diagnosis(csm.tobytes(), csm.shape, n_effective, n_factors)
    diagnosis = Diagnosis(
        n_factors=found.n_factors,
        pairs=found.pairs,
        bands=found.bands,
        responses=found.responses,
        advice=found.advice,
        per_frequency=FrequencyDiagnosis(
            coherence=found.coherence,
            condition=found.condition,
            dimension=found.dimension,
            snr=found.snr,
            statistic=found.model.statistic,
            degrees=found.model.degrees,
        ),
    )
    return replace(
        snapshot,
        csm=csm,
        channels=tuple(ChannelLabel(s, c, "m/s²") for s in sensors for c in channels),
        sensors=tuple(
            replace(each, name=name) for each, name in zip(snapshot.sensors, sensors, strict=True)
        ),
        clocks=tuple(
            replace(each, sensor=name) for each, name in zip(snapshot.clocks, sensors, strict=True)
        ),
        diagnostics=replace(
            snapshot.diagnostics,
            synchronisation=replace(
                snapshot.diagnostics.synchronisation,
                residual=dict(zip(sensors, RESIDUALS, strict=True)),
                reference=sensors[0],
            ),
            diagnosis=diagnosis,
            untested=found.untested,
        ),
    )


def advised(snapshot: Snapshot, *advice: Advice) -> Snapshot:
    """Return a diagnosed snapshot with this advice and no other."""
    found = snapshot.diagnostics
    assert found.diagnosis is not None
    diagnosis = replace(found.diagnosis, advice=advice)
    return replace(snapshot, diagnostics=replace(found, diagnosis=diagnosis))


def made_drift() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Three clocks at constant rates, the second with a bend of 20 µs in the middle."""
    at = np.arange(60.0)
    bend = 20e-6 * np.sin(np.pi * at / 59)
    drift: np.ndarray[tuple[int, int], np.dtype[np.float64]] = np.zeros((60, 4))
    drift[:, 0] = at
    drift[:, 1:] = -1e-6 * np.outer(at, PPM)
    drift[:, 2] += bend
    return drift


def made_now(*, elapsed: float = 100.0, closed: bool = False) -> RecordingStatus:
    """Three sensors: one live, one with two gaps, one silent for 12 s."""
    begun = 1_795_230_000_000_000_000
    state = SensorState.ENDED if closed else SensorState.LIVE
    return RecordingStatus(
        elapsed=elapsed,
        started_utc_ns=begun,
        closed=closed,
        sensors=(
            SensorStatus("A", "/dev/ttyUSB0", RATE, 20000, 0, 0, state),
            SensorStatus("B", "/dev/ttyUSB1", RATE, 20000, 2, 14, state),
            SensorStatus("C", "/dev/ttyUSB2", RATE, 20000, 0, 0, state)
            if closed
            else SensorStatus(
                "C", "/dev/ttyUSB2", RATE, 17600, 0, 0, SensorState.SILENT, overdue_for=12.0
            ),
        ),
        events=(
            Event("", EventKind.STARTED, "3 sensors", HostTime(0, begun)),
            Event("", EventKind.MARK, "door slammed", HostTime(0, begun + 42_000_000_000)),
        ),
    )


def waiting_now() -> RecordingStatus:
    """Return the same bench before its first sample."""
    now = made_now(elapsed=0.0)
    return replace(
        now, sensors=tuple(replace(s, n_samples=0, state=SensorState.WAITING) for s in now.sensors)
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
        sensors=tuple(replace(s, n_samples=0, last_seen=float("nan")) for s in full.sensors),
    )


LIMIT = Limit(name="data sheet", frequency=(1.0, 30.0), psd=(7e-12, 7e-12))


def demo_bench(*limits: Limit) -> Bench:
    """Return the bench of the demo: three sensors, without limits of its own."""
    bench = parse(DEMO)
    return bench.model_copy(update={"limits": limits}) if limits else bench


@contextmanager
def growing(
    path: Path, *, duration: float | None = None, continues: str = ""
) -> Iterator[RecordingWriter]:
    """Yield the writer of a recording of the demo's bench that nobody has closed."""
    bench = demo_bench()
    sensors = [
        SensorLayout(s.name, s.channels, bench.sampling_rate, dtype=np.dtype("<i4"), clock=s.name)
        for s in bench.sensors
    ]
    writer = RecordingWriter.create(
        path,
        bench,
        sensors=sensors,
        created=SystemClock().now(),
        attributes={
            **({} if duration is None else {"duration": duration}),
            **({CONTINUES: continues} if continues else {}),
        },
    )
    writer.commit()
    try:
        yield writer
    finally:
        writer.abandon()


@dataclass
class ProgressCallback:
    """Controls that write down what they are told."""

    path: Path
    settings: Settings | None = SETTINGS
    name: str = "lab"
    can_start: bool = True
    bench: Bench | None = None
    running: Path | None = None
    told: list[str] = field(default_factory=list)
    announced: list[str] = field(default_factory=list)
    plan: TestPlan | None = None
    sensors: Preview | None = None
    wrong: tuple[str, ...] = ()
    since: tuple[str, ...] = ()

    def check(self, plan: TestPlan) -> Sequence[str]:
        """Return what was prepared."""
        del plan
        return self.wrong

    def start(self, plan: TestPlan) -> Path:
        """Note it."""
        self.told.append("start")
        self.plan = plan
        return self.path

    @property
    def folder(self) -> Path:
        """Return where its recordings are."""
        return self.path.parent

    @property
    def preview(self) -> Preview | None:
        """Return what was prepared."""
        return self.sensors

    def pin(self, path: Path) -> str:
        """Note it."""
        self.told.append(f"pin {path.name}")
        return f"{path.name} is kept"

    def read_bench(self) -> str:
        """Return the text of the bench."""
        return "" if self.bench is None else self.bench.text

    def save_bench(self, text: str) -> None:
        """Take it as the bench."""
        self.bench = parse(text)
        self.told.append("save bench")

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Return a device on any port but one."""
        if port == "/dev/nothing":
            return ()
        about = DeviceInformation("", "A352AD10", "S9", "1.4", 200.0, 25.0)
        return [DiscoveredDevice("epson", port, {"baud_rate": 460800}, about)]

    def announce(self, event: str, text: str, path: Path | None) -> None:
        """Note it."""
        del path
        self.announced.append(f"{event}: {text}")

    def about(
        self, path: Path, changes: Mapping[str, object]
    ) -> tuple[Settings | None, Bench | None]:
        """Note the changes; return settings with them."""
        self.told.append(f"about {path.name} {dict(changes)}")
        return replace(SETTINGS, **changes), self.bench  # type: ignore[arg-type]

    def keep(self, path: Path, result: Result) -> None:
        """Note it."""
        assert result.verdict is None
        self.told.append(f"keep {path.name} {', '.join(result.snapshot.results)}")

    def noted(self, path: Path, result: Result) -> Sequence[str]:
        """Return what was prepared."""
        del path, result
        return self.since

    def report(self, path: Path, result: Result) -> Path:
        """Note it."""
        assert result.snapshot.closed
        self.told.append(f"report {path.name} {result.settings.segment:g}")
        return path.with_suffix(".html")

    def certify(self, path: Path, result: Result, wanted: Mapping[str, str]) -> Path:
        """Note it."""
        assert result.snapshot.closed
        if wanted["by"] == "Nobody":
            raise HuddleError(f"{path}: sensors were simulated\nnot given: a name")
        self.told.append(f"certify {path.name} {dict(wanted)}")
        return path.with_suffix(".pdf")

    def find_running(self) -> Path | None:
        """Return what was prepared."""
        return self.running

    def stop(self, path: Path) -> None:
        """Note it."""
        self.told.append(f"stop {path.name}")

    def mark(self, path: Path, text: str) -> None:
        """Note it."""
        self.told.append(f"mark {path.name} {text}")

    def save(self, path: Path, result: Result) -> tuple[Path, ...]:
        """Note it."""
        self.told.append(f"save {path.name} {len(result.snapshot.channels)}")
        return (path.with_suffix(".csv"), path.with_suffix(".json"))


def judged(result: Result, verdict: TestVerdict) -> Result:
    """Return a result whose verdict was derived already."""
    vars(result)["verdict"] = verdict
    return result


def said(snapshot: Snapshot, settings: Settings | None = None) -> list[str]:
    """Return the sentences on all facts of a snapshot."""
    return [str(each) for each in Result(snapshot, settings or Settings()).facts]
