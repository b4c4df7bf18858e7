"""Everything that is known of a test, as text. Does not use Textual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Group, RenderableType
from rich.text import Text

from daq.protocols.block import EventKind
from daq.recording.monitor import RecordingStatus
from daq.results.result import Result
from daq.results.sources import LoggedEvent, uncounted_events, with_uncounted
from estimator.wording import clock_time
from tui.application.test_view.panels import grouped, state
from tui.output.diagnosis import details as diagnosis_details
from tui.page.table import Cell, Table, Tone
from tui.page.terminal import screen_table
from tui.wording.formatting import utc

LATEST_EVENTS = 200
HEADER, BAD = "bold #4cc9f0", "bold #ff6b6b"
_TONES: Mapping[str, Tone] = {EventKind.MARK: "doubtful", EventKind.UNCOUNTED: "bad"}


def details(now: RecordingStatus, result: Result | None, *, trouble: str) -> RenderableType:
    """Return everything that is known of a test: sensors, segments, diagnosis, events."""
    parts: list[RenderableType] = [Text(trouble, BAD), ""] if trouble else []
    parts += [Text(f"sensors, since {utc(now.started_utc_ns)}", HEADER), _sensors(now)]
    if result is not None:
        parts += ["", Text("segments", HEADER), _segments(result)]
        parts += ["", Text("diagnosis", HEADER)]
        parts += diagnosis_details(result.snapshot, result.facts)
    clocks = () if result is None else result.snapshot.clocks
    found = uncounted_events(clocks)
    parts += ["", Text("events, latest first", HEADER), _events(now, found)]
    return Group(*parts)


def _sensors(now: RecordingStatus) -> RenderableType:
    rows = (
        (
            *(Cell(sensor.name, strong=True), state(sensor), grouped(sensor.n_gaps)),
            f"{grouped(sensor.n_missing)} samples" if sensor.n_missing else "0",
            f"{grouped(sensor.n_clipped)} blocks" if sensor.n_clipped else "no",
            sensor.port,
        )
        for sensor in now.sensors
    )
    names = ("sensor", "state", "gaps", "missing", "clipped", "port")
    return screen_table(Table.of(names, rows), folded=("port",))


def _segments(result: Result) -> Text:
    snapshot, settings = result.snapshot, result.settings
    text = (
        f"{snapshot.n_segments} of {settings.segment:g} s ({settings.window}, "
        f"{settings.overlap:.0%} overlap), worth {snapshot.n_effective:.0f} independent averages"
    )
    if snapshot.n_dropped:
        text += f"; {snapshot.n_dropped} excluded"
    return Text(text)


def _events(now: RecordingStatus, found: Sequence[LoggedEvent]) -> RenderableType:
    """Return what was recorded, and what the estimate found: that in place of what it had."""
    recorded = [
        LoggedEvent(event.received.utc_ns, event.sensor, event.kind, event.text)
        for event in now.events
    ]
    every = with_uncounted(recorded, found)
    shown = every[-LATEST_EVENTS:]
    rows = [
        (
            Cell(clock_time((event.utc_ns - now.started_utc_ns) * 1e-9), "quiet"),
            event.sensor,
            Cell(event.kind, _TONES.get(event.kind, "plain"), strong=event.kind in _TONES),
            event.text,
        )
        for event in reversed(shown)
    ]
    if len(shown) < len(every):
        rows.append((Cell(""), "", Cell(""), f"and {len(every) - len(shown)} before"))
    return screen_table(
        Table.of(("after", "sensor", "event", "remark"), rows, right={"after"}), folded=("remark",)
    )
