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
    from collections.abc import Iterator, Mapping

    from daq.bench.tables.unattended import Metrics
    from tui.service.hooks import HookRunner
    from tui.service.service import Service


PYTHON = platform.python_version()
_NOISE = {
    "psd": "Mean noise",
    "low": "Lower end of the 95 % interval of the mean noise",
    "high": "Upper end of the 95 % interval of the mean noise",
}
_OF_SENSOR = {
    "samples": "Samples safe on disk.",
    "missing": "Samples missing in gaps.",
    "gaps": "Gaps.",
}
_LABELS = "sensor channel serial_number unit low_hz high_hz"
_LEAST_FREE = "Space at which recordings end."
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
        gauge, counter = core.GaugeMetricFamily, core.CounterMetricFamily
        service = self._service
        window, planned = service.window, service.next_run
        yield _family(
            counter, "runs", "Runs since the start of the service.", "state", self._counts
        )
        name = "last_run_timestamp_seconds"
        yield _family(gauge, name, "End of the last run.", "state", self._last)
        due = None if planned is None else planned.due.timestamp()
        for name, text, value in (
            ("recording", "Whether a run is recorded.", service.recording is not None),
            ("next_run_timestamp_seconds", "Time at which the next run is due.", due),
            ("disk_free_bytes", "Free space.", service.free()),
            ("disk_min_free_bytes", _LEAST_FREE, service.bench.storage.min_free),
        ):
            if value is not None:
                yield gauge(f"huddle_{name}", text, value=value)
        waiting = dict(zip(("recording", "estimate"), service.waiting, strict=True))
        yield _family(gauge, "queue", "Runs that wait.", "for", waiting)
        n_failed = self._hook_runner.n_failed
        yield counter("huddle_hooks_given_up", "Hooks without success.", value=n_failed)
        status = None if window is None else window.status
        if status is not None:
            yield from _sensors(gauge, status.get("sensors", {}))
        own = {"version": __version__, "python": PYTHON}
        yield core.InfoMetricFamily("huddle_build", "This copy of huddle.", own)
        if self._done is not None:
            yield from _result(gauge, self._done)


def _family(
    kind: Any,  # noqa: ANN401 - of the library
    name: str,
    text: str,
    labels: str,
    values: Mapping[Any, float],
) -> Any:  # noqa: ANN401
    """Return a metric with a value for each of its labels, or for several of them together."""
    found = kind(f"huddle_{name}", text, labels=labels.split())
    for labelled, value in values.items():
        found.add_metric(labelled if isinstance(labelled, tuple) else (labelled,), value)
    return found


def _sensors(gauge: Any, sensors: Mapping[str, Any]) -> Iterator[Any]:  # noqa: ANN401
    for name, text in _OF_SENSOR.items():
        found = {sensor: each[name] for sensor, each in sensors.items()}
        about = f"{text} Of the recording that runs."
        yield _family(gauge, f"sensor_{name}", about, "sensor", found)
    states = {(sensor, str(each["state"])): 1 for sensor, each in sensors.items()}
    text = "1 for the state that the sensor has."
    yield _family(gauge, "sensor_state", text, "sensor state", states)


def _result(gauge: Any, run: Run) -> Iterator[Any]:  # noqa: ANN401
    of = [tuple(str(getattr(each, label)) for label in _LABELS.split()) for each in run.noise]
    for name, text in _NOISE.items():
        values = dict(zip(of, (getattr(each, name) for each in run.noise), strict=True))
        about = f"{text} of the last run in unit²/Hz."
        yield _family(gauge, f"noise_{name}", about, _LABELS, values)
    verdicts = {known.value: known.value == run.verdict for known in Verdict if run.verdict}
    text = "1 for the verdict of the last run on its limits."
    yield _family(gauge, "verdict", text, "verdict", verdicts)
    for caveat in Caveat:
        about = f"Whether the last run has {caveat.words.noun}."
        yield gauge(f"huddle_{caveat}", about, value=caveat in run.caveats)
