"""The result of a test as text. Does not use Textual."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.text import Text

from daq.results.comparison import Difference, compare
from daq.results.facts.precision import TargetMissed
from daq.results.vocabulary import PARTNER_WORDS
from estimator.decision.verdict import Verdict
from estimator.wording import percent, signed
from tui.application.test_view.panels import alerts, known_to
from tui.output.results import averages_line
from tui.page import table as page
from tui.page.table import Cell
from tui.page.terminal import fitting, screen_table, styled, terminal_items
from tui.wording.facts import fact_items
from tui.wording.formatting import level, level_with_error
from tui.wording.verdict_text import (
    MARKS,
    STYLES,
    TONES,
    Decision,
    limit_line,
    margin,
    worst_by_channel,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.results.result import Result
    from tui.application.state import State

MUTED, BAD = "#9aa5b8", "bold #ff6b6b"
SPARE = ("data", "worst c.o.v.", "at", "from", "to")
"""Columns that a narrow screen leaves out, the first first."""


def result(state: State, *, width: int) -> RenderableType:
    """Return the end of a test: verdict, every channel's noise, advice, and where it all lies."""
    now, found, path = state.now, state.result, state.path
    if found is None:
        return ""
    snapshot = found.snapshot
    parts: list[RenderableType] = [*_verdict(found)]
    wrong = [] if now is None else [*map(styled, alerts(now, found))]
    parts += ["", *wrong] if wrong else []
    parts.append("")
    if snapshot.results:
        parts += [_channels(state, found, width=width)]
        parts += [*_notes(state, found), *map(Text, state.sensors_since), ""]
    facts = [  # with limits, how long to record is said with the verdict
        each for each in found.facts if found.verdict is None or not isinstance(each, TargetMissed)
    ]
    is_open = found.verdict is not None and found.verdict.verdict is not Verdict.PASS
    of_averages = averages_line(snapshot)
    parts.append(terminal_items(fact_items(facts, is_open=is_open, more=of_averages)))
    if path is not None:
        parts += ["", Text.assemble(("recording  ", MUTED), str(path.resolve()))]
    return Group(*parts)


def _verdict(result: Result) -> Iterator[Text]:
    found, decision = result.verdict, Decision.of(result)
    if not result.snapshot.results:
        yield Text("No result: nothing can be said of the sensors' noise.", BAD)
        for method, why in result.snapshot.refused.items():
            yield Text(f"{method}: {why}", BAD)
        return
    if found is None or decision is None:
        yield Text("No limits in the bench file: neither passed nor failed.", MUTED)
    else:
        yield Text(f"{MARKS[found.verdict]} {decision}", STYLES[found.verdict])
        yield from map(Text, decision.remarks)
        known = [each for each in found.limits if math.isfinite(each.margin_low_db)]
        if known:
            worst = min(known, key=lambda each: each.margin_low_db)
            yield Text(f"Least margin: {limit_line(worst)}.")
    if result.precision().is_reached:  # a missed target is a fact, below
        yield Text(f"✓ {known_to(result.precision())}", "green")


def _channels(state: State, result: Result, *, width: int) -> RenderableType:
    snapshot = result.snapshot
    method, band = next(iter(snapshot.results)), result.band
    data, cov, alone = result.data, result.covs_of(method), result.alone
    means = result.means(method)
    margins, differences = worst_by_channel(result.verdict), _differences(state)
    title = f"{method}, mean over {band[0]:.3g}–{band[1]:.3g} Hz, dB re 1 ({snapshot.unit})²/Hz"
    rows = []
    titles = ["channel", "data", "noise, 95 %", "worst c.o.v."]
    titles += ["margin, dB", "at"] if margins else ["from", "to"]
    titles += [f"against {_reference(state)}"] if differences else []
    for column, label in enumerate(snapshot.channels):
        cells = [Cell(label.name, strong=True), level(float(data[column]))]
        if column in alone:
            cells.append(Cell(PARTNER_WORDS[alone[column]], "bad"))
            rows.append((*cells, *[""] * (len(titles) - len(cells))))
            continue
        low, high = float(means[column].low[0]), float(means[column].high[0])
        cells.append(level_with_error(float(means[column].mean[0]), high, low))
        cells.append("?" if math.isnan(cov[column]) else percent(cov[column]))
        key = label.sensor, label.channel
        if not margins:
            cells += [level(low), level(high)]
        elif key in margins:
            worst = margins[key]
            words = f"{MARKS[worst.verdict]} {margin(worst)}".replace(" dB", "")
            cells.append(Cell(words, TONES[worst.verdict]))
            cells.append(f"{worst.frequency:.3g} Hz" if worst.known else "")
        else:
            cells += [Cell("no limit", "quiet"), ""]
        if differences:
            cells.append(difference_cell(differences.get(key)))
        rows.append((*cells,))
    return screen_table(fitting(page.Table((*titles,), (*rows,), title=title), width, SPARE))


def _differences(state: State) -> dict[tuple[str, str], Difference]:
    if state.reference is None or state.result is None:
        return {}
    return compare(state.result, state.reference.result)


def difference_cell(difference: Difference | None) -> Cell:
    """Return a difference in dB with its interval: bold where the interval excludes equal noise."""
    if difference is None:
        return Cell("no such channel", "quiet")
    if math.isnan(difference.db):
        return Cell("?", "quiet")
    low, high = difference.low_db, difference.high_db
    text = signed(round(difference.db, 2) + 0.0, "+.2f")  # no "-0.00"
    if math.isinf(low) or math.isinf(high):
        text += " (not bounded)"
    else:
        up, down = high - difference.db, difference.db - low
        text += f" ±{up:.2f}" if down < 1.1 * up else f" +{up:.2f} −{down:.2f}"
    return Cell(text, strong=difference.is_certain)


def _notes(state: State, result: Result) -> Iterator[Text]:
    """Yield what the table does not say of itself."""
    snapshot = result.snapshot
    reference = state.reference
    if reference is not None:
        differences = _differences(state)
        for sensor in () if state.now is None else state.now.sensors:
            before = reference.serial_numbers.get(sensor.name, "")
            if before and sensor.serial_number and before != sensor.serial_number:
                yield Text(
                    f"▲ {sensor.name} was another sensor in {_reference(state)}: {before}, now "
                    f"{sensor.serial_number}",
                    "yellow",
                )
        if differences:
            n_certain = sum(each.is_certain for each in differences.values())
            summary = (
                f"{n_certain} of {len(differences)} channels differ by more than their interval"
            )
            yield Text(
                f"against {_reference(state)}: 95 % interval of each channel; {summary}", MUTED
            )
        else:
            why = (
                f"units differ: {snapshot.unit} and {reference.result.snapshot.unit}"
                if snapshot.unit != reference.result.snapshot.unit
                else "no channel, method or band in common"
            )
            yield Text(f"{_reference(state)} cannot be compared: {why}", "yellow")
    if result.method not in snapshot.results:
        yield Text(f"{result.method} gives no result here", "yellow")


def _reference(state: State) -> str:
    return "" if state.reference is None else state.reference.path.stem
