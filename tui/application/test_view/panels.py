"""What the application shows of a snapshot, as text and curves; no Textual here."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from rich.text import Text

from daq.recording.sensor_state import SensorState
from daq.results.decision.end import NOT_KNOWN_FROM, Goal
from daq.results.facts.methods import WITHOUT_ESTIMATE
from daq.results.facts.recordings import SensorsSimulated, facts_of_sensors
from daq.results.vocabulary import FLAG_WORDS, PARTNER_WORDS
from estimator.wording import clock_time, percent, several
from tui.output.console import TESTING
from tui.page.table import Cell, Table, Tone
from tui.page.terminal import styled
from tui.wording.facts import RANK_TONES
from tui.wording.formatting import level_with_error
from tui.wording.verdict_text import headline, how_long, in_tone

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus, SensorStatus
    from daq.results.band_summary import BandMeans, Precision
    from daq.results.facts.fact import Fact
    from daq.results.result import Result
    from tui.application.test_view.plotted import Choice

_NUMBERS = ("Hz", "samples", "gaps")
MIN_BAR = 6  # cells


def noise_in_band(result: Result, choice: Choice) -> tuple[BandMeans, ...]:
    """Return the mean noise of every channel by the first chosen method; empty before there is."""
    method = next((m for m in choice.methods[:1] if m in result.snapshot.results), None)
    return () if method is None else result.means(method)


def sensor_table(
    now: RecordingStatus,
    result: Result,
    choice: Choice,
    *,
    width: int,
    is_followed: bool = True,
) -> Table:
    """Return a row per sensor: how it is, and the noise of each of its channels in the band.

    Without room, rates are omitted first, then numbers of samples, then of gaps.
    """
    noise = partial(_noise_columns, now, result, choice)
    columns = {"sensor": [Cell(sensor.name, strong=True) for sensor in now.sensors]}
    columns["state"] = _states(now, is_followed=is_followed)
    columns["Hz"] = [Cell(f"{sensor.sampling_rate:g}") for sensor in now.sensors]
    columns["samples"] = [Cell(grouped(s.n_samples)) for s in now.sensors]
    columns["gaps"] = [_gaps(sensor) for sensor in now.sensors]
    columns |= noise(with_error=True)
    for unneeded in ("Hz", "samples", "gaps"):
        if _width(columns) > width:
            del columns[unneeded]
    if _width(columns) > width:
        columns |= noise(with_error=False)
    if _width(columns) > width:  # the alert says in words what the marks mean
        marks = [Cell(c[:1], c.tone) for c in columns.pop("state")]
        columns = {"": marks, " ": columns.pop("sensor"), **columns}
    return Table.of(tuple(columns), zip(*columns.values(), strict=True), right=_NUMBERS)


def state_table(now: RecordingStatus, trouble: str) -> Table:
    """Return a row per sensor: how it is, before there is an estimate."""
    rows = (
        (
            *(Cell(sensor.name, strong=True), how, f"{sensor.sampling_rate:g}"),
            *(grouped(sensor.n_samples), _gaps(sensor), sensor.port),
        )
        for sensor, how in zip(now.sensors, _states(now, is_followed=not trouble), strict=True)
    )
    return Table.of(("sensor", "state", *_NUMBERS, "port"), rows, right=_NUMBERS)


def _states(now: RecordingStatus, *, is_followed: bool) -> list[Cell]:
    """Return the state of every sensor: of one that nobody records, that this is so."""
    if is_followed or now.closed:
        return [state(sensor) for sensor in now.sensors]
    return [Cell("■ not recorded", "quiet") for _ in now.sensors]


def _noise_columns(
    now: RecordingStatus, result: Result, choice: Choice, *, with_error: bool
) -> dict[str, list[Cell]]:
    """Return the columns of channels, by their titles."""
    snapshot, band = result.snapshot, result.band
    titles = ["noise, dB", f"{band[0]:.3g}–{band[1]:.3g} Hz", *choice.methods[:1]]
    columns, means = {}, noise_in_band(result, choice)
    for number in range(max(snapshot.dims)):
        title = titles[number] if number < len(titles) else " " * number
        cells = columns[title] = [Cell("") for _ in now.sensors]
        for row, sensor in enumerate(now.sensors):
            mine = [n for n, each in enumerate(snapshot.channels) if each.sensor == sensor.name]
            if number < len(mine):
                column = mine[number]
                text, tone = _channel_noise(result, column, means, with_error=with_error)
                cells[row] = Cell(text, tone, chosen=column == choice.channel)
    return columns


def _width(columns: dict[str, list[Cell]]) -> int:
    widest = (max(len(title), *map(len, cells)) for title, cells in columns.items())
    return sum(widest) + len(columns)


def _gaps(sensor: SensorStatus) -> Cell:
    if not sensor.n_gaps:
        return Cell("0")
    return Cell(f"{grouped(sensor.n_gaps)} ({grouped(sensor.n_missing)})", "doubtful")


def grouped(count: int) -> str:
    """Return a count in groups of three digits."""
    return f"{count:,}".replace(",", "\u202f")


def state(sensor: SensorStatus) -> Cell:
    """Return the state of a sensor, and for how long it has been overdue."""
    state = sensor.state
    if state.is_overdue:
        tone: Tone = "bad" if state.is_lost else "doubtful"
        return Cell(f"○ {state} {clock_time(sensor.overdue_for)}", tone)
    if state is SensorState.WAITING:
        return Cell(f"○ {state}", "doubtful")
    if sensor.stuck:
        return Cell(f"▲ {' '.join(sensor.stuck)} stuck", "bad")
    if sensor.is_clipping:
        return Cell("▲ clipping", "bad")
    return Cell(f"■ {state}", "quiet") if state is SensorState.ENDED else Cell(f"● {state}", "good")


def _channel_noise(
    result: Result, column: int, means: Sequence[BandMeans], *, with_error: bool
) -> tuple[str, Tone]:
    name = result.snapshot.channels[column].channel
    value = "…"
    if flag := _flagged(result.snapshot, column):
        return f"{name} {flag}", "bad"
    if column in result.alone:
        return f"{name} {PARTNER_WORDS[result.alone[column]]}", "bad"
    if means:
        mean, high, low = (
            float(each[0]) for each in (means[column].mean, means[column].high, means[column].low)
        )
        if not math.isnan(mean):
            value = level_with_error(mean, high, low, short=True, bare=not with_error)
    return f"{name} {value}", "plain"


def _flagged(snapshot: Snapshot, column: int) -> str:
    """Say why most frequencies of a channel have no estimate; nothing where they have one."""
    for noise in snapshot.results.values():
        flags = noise.flags[1:-1, column]
        for flag, words in FLAG_WORDS.items():
            if flag & WITHOUT_ESTIMATE and 2 * np.count_nonzero(flags & flag) > flags.size:
                return words.short
    return ""


def progress_line(
    now: RecordingStatus,
    result: Result,
    *,
    width: int,
    is_followed: bool = True,
) -> Text:
    """Return how long the test takes, after a bar, segments and c.o.v. where there is room.

    Nothing of an end where the recording `is_followed` no longer: its recorder may be gone.
    """
    snapshot = result.snapshot
    if snapshot.n_segments == 0:
        text = f"waits for the first {result.settings.segment:g} s segment"
        if snapshot.n_dropped:
            text += f" without gaps; {snapshot.n_dropped} excluded"
        return Text(text, "#9aa5b8")
    parts = [several(snapshot.n_segments, "segment")]
    if snapshot.n_dropped:
        parts.append(f"{snapshot.n_dropped} excluded")
    reached = result.precision(now.until.cov)
    if snapshot.closed:
        parts += [] if math.isnan(reached.cov) else [known_to(reached)]
        if reached.target is not None:
            parts.append("target reached" if reached.is_reached else "target not reached")
        return Text(" · ".join(parts))
    if not math.isnan(reached.cov):
        parts.append(known_to(replace(reached, target=None)))
    if not is_followed:
        return Text(" · ".join(parts))
    left = result.remaining(now.until, now.elapsed)
    if left.seconds is not None and left.goal is not Goal.END:
        left = replace(left, seconds=max(0.0, left.seconds - _gone_on(now, snapshot)))
    lost = [sensor.name for sensor in now.sensors if sensor.state.is_overdue]
    if lost and left.goal is not Goal.END:
        parts.append(f"Waits for {', '.join(lost)}.")
    else:
        parts.append(how_long(left, now.in_local_time(left.seconds)))
    while len(" · ".join(parts)) > width and len(parts) > 1:
        del parts[0]  # the last says most
    text, line = " · ".join(parts), Text()
    room = width - len(text) - 3
    if left.seconds is not None and room >= MIN_BAR:
        done = snapshot.elapsed / max(snapshot.elapsed + left.seconds, 1e-9)
        filled = round(done * room)
        line.append("━" * filled, "#4cc9f0")
        line.append("╌" * (room - filled), "#4a556b")
        line.append("  ")
    line.append(text)
    return line


def note(now: RecordingStatus | None, done: int, total: int) -> str:
    """Return what an estimate of many segments is, and how far; after the last, what follows."""
    closed = now is not None and now.closed
    if closed and done >= total:
        return TESTING
    what = "the result is being computed" if closed else "reading what was recorded"
    return f"{what}: {done / total:.0%}"


def known_to(reached: Precision) -> str:
    """Return the scatter of the noise in the worst third of an octave, and the one that is wanted.

    How well the noise is known is the whole interval, beside each level.
    """
    wanted = "" if reached.target is None else f", wanted {percent(reached.target)}"
    if reached.cov > NOT_KNOWN_FROM:
        return f"worst c.o.v. above {percent(NOT_KNOWN_FROM)}{wanted}"
    return f"worst c.o.v. {percent(reached.cov)}{wanted}"


def _gone_on(now: RecordingStatus, snapshot: Snapshot) -> float:
    """Return seconds that all sensors have sent since the snapshot: none while one is lost."""
    before = {sensor.name: sensor.n_samples for sensor in snapshot.sensors}
    new = ((s.n_samples - before[s.name]) / s.sampling_rate for s in now.sensors)
    return max(0.0, min(new))


def alerts(now: RecordingStatus, result: Result | None) -> list[Cell]:
    """Return faults of sensors with remedies, the worst first."""
    return [
        Cell(f"▲ {each.words.line}", RANK_TONES[each.rank])
        for each in facts_of_sensors(now, None if result is None else result.settings)
    ]


def findings(result: Result, *, width: int, besides: tuple[type[Fact], ...] = ()) -> list[Text]:
    """Return the facts that invalidate or delay the result, a line each, the worst first.

    Those of the kinds `besides` are left out: they are shown elsewhere.
    """
    needed = [
        each
        for each in result.facts
        if (each.needs_action or isinstance(each, SensorsSimulated))
        and not isinstance(each, besides)
    ]
    lines = [styled(Cell(each.line, RANK_TONES[each.rank])) for each in needed]
    for line in lines:
        line.truncate(width, overflow="ellipsis")
    return lines


def advice(result: Result, choice: Choice) -> Cell:
    """Return one line on what to know about what is shown: first the verdict so far."""
    snapshot, verdict = result.snapshot, result.verdict
    if verdict is not None:
        return in_tone(headline(verdict), verdict, grows=not snapshot.closed)
    refused = [f"{method}: {why}" for method, why in snapshot.refused.items()]
    if refused:
        return Cell(refused[0], "doubtful" if snapshot.closed else "quiet")
    for method in choice.methods:
        noise = snapshot.results.get(method)
        if noise is None:
            continue
        values = noise.noise_psd[1:-1, choice.channel]
        negative = int(np.sum(values <= 0))
        if negative:
            return Cell(
                f"{method}: {negative} of {values.size} values at or below zero (▾ marks the "
                "upper bound)",
                "doubtful",
            )
    return Cell("")
