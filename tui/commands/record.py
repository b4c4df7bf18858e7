"""``huddle record``: the recorder, alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.live import Live

from daq.acquisition.recorder import recording_path, run
from daq.drivers.bench_file import load
from daq.host_clock import SystemClock
from tui.output.console import notices, write_json
from tui.output.formatting import clock_time, roughly, several

if TYPE_CHECKING:
    from pathlib import Path

    from daq.acquisition.recorder import Status


def record_bench(path: Path, *, duration: float | None, out: Path | None, json: str | None) -> None:
    """Record a bench until the duration is over, or until SIGINT or SIGTERM.

    Raises
    ------
    ExceptionGroup
        Of a DeviceError for every sensor that cannot be used at the start.
    """
    bench = load(path)
    if duration is None:
        duration = bench.recording.duration
    if out is None:
        out = recording_path(bench, SystemClock().now())
    screen = notices()
    if screen.is_terminal:
        with Live(console=screen, refresh_per_second=2, transient=True) as live:
            status = run(
                bench,
                out,
                duration=duration,
                acknowledged=lambda now: live.update(progress_line(now, duration)),
            )
    else:
        status = run(bench, out, duration=duration)
    screen.print(f"{progress_line(status)}\n{out} closed", soft_wrap=True)
    write_json(json, status.to_dict())


def progress_line(status: Status, duration: float | None = None) -> str:
    """Return what is safe of every sensor, and when a run of this duration ends."""
    sensors = "  ".join(
        f"{name} {sensor.samples}"
        + (f" ({several(sensor.gaps, 'gap')}, {sensor.missing} missing)" if sensor.gaps else "")
        + (f" {sensor.state}" if sensor.state in {"late", "lost"} else "")
        for name, sensor in status.sensors.items()
    )
    left = None if duration is None else max(0.0, duration - status.elapsed)
    ends = "" if left is None else f"  ends in {roughly(left)}"
    return f"{clock_time(status.elapsed)}  samples safe: {sensors}{ends}"
