"""Metrics of the service for Prometheus, served over HTTP on the address in the bench file."""

from __future__ import annotations

import contextlib
import platform
import threading
from typing import TYPE_CHECKING, Any

from daq.caveats import Caveat
from daq.errors import HuddleError
from estimator.decision.verdict import Verdict
from tui import __version__
from tui.output.extras import load
from tui.service.records.run_state import Run, RunState

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.bench.tables.unattended import Metrics
    from tui.service.hooks import HookRunner
    from tui.service.service import Service


PYTHON = platform.python_version()
_NOISE = {
    "psd": "Mean noise",
    "low": "Lower end of the 95 % interval of the mean noise",
    "high": "Upper end of the 95 % interval of the mean noise",
}
PATIENCE, MAX_THREADS = 5.0, 64
"""Seconds for which a connection may be silent, and threads of the service with connections."""


class MetricsError(HuddleError):
    """The metrics cannot be served."""


class ServiceMetrics:
    """Counts what the service tells, and looks at it when asked.

    Parameters
    ----------
    service : Service
    hook_runner : HookRunner
    """

    def __init__(self, service: Service, hook_runner: HookRunner) -> None:
        self._service, self._hook_runner = service, hook_runner
        self._counts = dict.fromkeys((RunState.DONE, RunState.FAILED, RunState.MISSED), 0)
        self._last: dict[RunState, float] = {}
        self._done: Run | None = None

    def note(self, run: Run) -> None:
        """Count a run that has reached its last state."""
        if run.state not in self._counts:
            return
        self._counts[run.state] += 1
        if run.ended is not None:
            self._last[run.state] = run.ended.timestamp()
        if run.state is RunState.DONE:
            self._done = run

    @contextlib.contextmanager
    def served(self, settings: Metrics) -> Iterator[int]:
        """Serve the metrics while the context lasts; yields the port.

        Raises
        ------
        MissingPackageError
            Without prometheus-client.
        MetricsError
            If the address is taken or not one of this computer.
        """
        client = load("prometheus_client")
        registry = client.CollectorRegistry()
        registry.register(self)
        try:
            server, thread = client.start_http_server(
                settings.port, addr=settings.address, registry=registry
            )
        except OSError as error:
            raise MetricsError(
                f"metrics: {settings.address} port {settings.port}: {error.strerror}; expected a"
                " free port of this computer"
            ) from error
        # Each connection has a thread of the service: silent ones end, and more are not taken.
        server.RequestHandlerClass.timeout = PATIENCE
        server.verify_request = lambda *_: threading.active_count() < MAX_THREADS
        try:
            yield int(server.server_port)
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

    def collect(self) -> Iterator[Any]:
        """Yield all metrics, as the library asks for them."""
        core = load("prometheus_client.core")

        def gauge(name: str, text: str, value: float | None) -> Iterator[Any]:
            if value is not None:
                yield core.GaugeMetricFamily(name, text, value=value)

        service = self._service
        window, bench = service.window, service.bench
        runs = core.CounterMetricFamily(
            "huddle_runs", "Runs since the start of the service.", labels=["state"]
        )
        last = core.GaugeMetricFamily(
            "huddle_last_run_timestamp_seconds", "End of the last run.", labels=["state"]
        )
        for state, count in self._counts.items():
            runs.add_metric([state], count)
            if state in self._last:
                last.add_metric([state], self._last[state])
        yield runs
        yield last
        recording = service.recording
        yield from gauge("huddle_recording", "Whether a run is recorded.", recording is not None)
        planned = service.next_run
        yield from gauge(
            "huddle_next_run_timestamp_seconds",
            "Time at which the next run is due.",
            None if planned is None else planned.due.timestamp(),
        )
        queue = core.GaugeMetricFamily("huddle_queue", "Runs that wait.", labels=["for"])
        for name, number in zip(("recording", "estimate"), service.waiting, strict=True):
            queue.add_metric([name], number)
        yield queue
        yield from gauge("huddle_disk_free_bytes", "Free space.", service.free())
        least = bench.storage.min_free
        yield from gauge("huddle_disk_min_free_bytes", "Space at which recordings end.", least)
        yield core.CounterMetricFamily(
            "huddle_hooks_given_up", "Hooks without success.", value=self._hook_runner.n_failed
        )
        status = None if window is None else window.status
        if status is not None:
            yield from _sensors(core, status)
        yield core.InfoMetricFamily(
            "huddle_build", "This copy of huddle.", {"version": __version__, "python": PYTHON}
        )
        if self._done is not None:
            yield from _result(core, self._done)


def _sensors(core: Any, status: dict[str, Any]) -> Iterator[Any]:  # noqa: ANN401 - a module
    names = ("samples", "missing", "gaps")
    texts = ("Samples safe on disk.", "Samples missing in gaps.", "Gaps.")
    families = [
        core.GaugeMetricFamily(
            f"huddle_sensor_{name}", f"{text} Of the recording that runs.", labels=["sensor"]
        )
        for name, text in zip(names, texts, strict=True)
    ]
    state = core.GaugeMetricFamily(
        "huddle_sensor_state", "1 for the state that the sensor has.", labels=["sensor", "state"]
    )
    for sensor, found in status.get("sensors", {}).items():
        for name, family in zip(names, families, strict=True):
            family.add_metric([sensor], found[name])
        state.add_metric([sensor, str(found["state"])], 1)
    yield from families
    yield state


def _result(core: Any, run: Run) -> Iterator[Any]:  # noqa: ANN401 - a module
    labels = ["sensor", "channel", "serial_number", "unit", "low_hz", "high_hz"]
    for name, text in _NOISE.items():
        family = core.GaugeMetricFamily(
            f"huddle_noise_{name}", f"{text} of the last run in unit²/Hz.", labels=labels
        )
        for each in run.noise:
            family.add_metric([str(getattr(each, label)) for label in labels], getattr(each, name))
        yield family
    verdict = core.GaugeMetricFamily(
        "huddle_verdict", "1 for the verdict of the last run on its limits.", labels=["verdict"]
    )
    for known in Verdict if run.verdict else ():
        verdict.add_metric([known.value], known.value == run.verdict)
    yield verdict
    for caveat in Caveat:
        about = f"Whether the last run has {caveat.words.noun}."
        yield core.GaugeMetricFamily(f"huddle_{caveat}", about, value=caveat in run.caveats)
