"""What the page of a test says, in the words of the application."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from daq.results.comparison import compare
from daq.results.result import Result
from daq.results.standing import stances
from estimator.wording import span
from tui.application.result_view.result_text import difference_cell
from tui.application.state import State
from tui.application.test_view.channels import channel_table
from tui.output.standing import arrows, caption, coherence_table, remark
from tui.page.table import Table
from tui.web.chart import choice_of
from tui.web.live import WIDE, band_means, of_band
from tui.wording.facts import fact_items
from tui.wording.verdict_text import Decision, limit_line


def about_test(state: State, settings_table: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the page of a closed test shows beside its curves."""
    result = state.result
    if result is None:
        raise ValueError("not estimated")
    snapshot, verdict = result.snapshot, result.verdict
    decision = Decision.of(result)
    has_noise = bool(snapshot.results) and snapshot.n_segments > 0
    differences = None if state.reference is None else _differences(state)
    return {
        "title": state.name,
        "caveats": state.caveats,
        "verdict": verdict,
        "headline": "" if decision is None else str(decision),
        "todo": [] if decision is None else decision.remarks,
        "refused": [f"{method}: {why}" for method, why in snapshot.refused.items()],
        "noise": channel_table(state, choice_of(state, {}), means=band_means(result), width=WIDE)
        if has_noise
        else None,
        "band": of_band(result),
        "differences": differences,
        "comparison": ""
        if state.reference is None or differences is not None
        else "The two tests cannot be compared: no channel, method, unit or band in common.",
        "facts": fact_items(result.facts),
        "limits": [] if verdict is None else [limit_line(each) for each in verdict.limits],
        "settings": Table(
            ("setting", "value"),
            tuple((name, _value(value)) for name, value in settings_table.items()),
            left=frozenset({0, 1}),
        ),
    }


def how_sensors_stand(result: Result) -> dict[str, Any]:
    """Return what a page shows of the axes of sensors, and of the coherence of pairs."""
    found = stances(result.snapshot)
    return {
        "stances": [(each.name, remark(each), arrows(each)) for each in found],
        "stances_caption": caption(found) if found else "",
        "coherence": coherence_table(result),
        "coherence_band": span(*result.band),
    }


def _differences(state: State) -> Table | None:
    """Return by how much the noise of each channel differs from that of the other test."""
    if state.reference is None or state.result is None:
        return None
    found = compare(state.result, state.reference.result)
    if not found:
        return None
    rows = ((".".join(name), difference_cell(each)) for name, each in found.items())
    return Table(("channel", "difference, dB"), tuple(rows))


def _value(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(_value, value)) or "–"
    if isinstance(value, dict):
        parts = (f"{name} {_value(each)}".strip() for name, each in value.items())
        return ", ".join(parts) or "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else str(value)
