"""The diagnosis of a test: its findings, or all of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.text import Text

from estimator.spectra.segment_rejection import Reason
from estimator.wording import ratio, signed
from tui.page.table import Table
from tui.page.terminal import terminal_table
from tui.wording.facts import RANKS
from tui.wording.formatting import response_cells

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import rich.table
    from rich.console import RenderableType

    from daq.estimation.snapshot import Snapshot
    from daq.estimation.snapshot_diagnostics import Diagnosis
    from daq.results.facts.fact import Fact
    from estimator.checks.advice import Names
    from estimator.checks.stability import Stability

_LEGEND = (
    "Coherence: the lowest between like channels of two sensors. Condition: condition number of "
    "the cross-spectral matrix between two sensors, of the worst pair; 1 is best. Dimension: of "
    "the motion. SNR: motion over noise, lowest and highest of all channels. Model test: its "
    "statistic over its expectation, 1 if one common motion explains the averages; p: "
    "probability of a statistic this large by chance."
)


def details(snapshot: Snapshot, facts: Sequence[Fact]) -> list[RenderableType]:
    """Return the diagnosis of every band and pair of sensors, and all facts in full."""
    found = snapshot.diagnostics.diagnosis
    listed_facts: list[RenderableType] = [Text(f"{RANKS[each.rank]}: {each}") for each in facts]
    if found is None:
        return listed_facts
    parts: list[RenderableType] = [_heading("Common motion by band"), _bands(found), Text(_LEGEND)]
    if found.responses:
        pairs = _pairs(found, snapshot.sensor_names)
        parts += [
            _heading("Orientation, gain and delay of the sensors, with 95 % intervals"),
            pairs,
        ]
    if snapshot.octaves:
        parts += [_heading("Segments of each octave"), _octaves(snapshot)]
    names = snapshot.names
    if found.stability is not None:
        between, table = _repeatability(found.stability, names)
        parts += [_heading(f"Repeatability of the noise between {between}"), table]
    return [*parts, _heading("Facts"), *listed_facts]


def _heading(text: str) -> Text:
    return Text(text, style="bold")


def _table(*columns: str, rows: Iterable[Iterable[str]]) -> rich.table.Table:
    return terminal_table(Table.of(columns, rows, right={*columns} - {"sensors"}))


def _bands(found: Diagnosis) -> rich.table.Table:
    rows = []
    for band in found.bands:
        known = [float(value) for value in band.snr if math.isfinite(value)]
        statistic = band.test.statistic / band.test.degrees if band.test.degrees else math.nan
        cells = [f"{band.low:.3g}–{band.high:.3g}", _known(band.coherence, ".4f")]
        cells += [_known(band.condition, ".3g"), _known(band.dimension, ".0f")]
        cells.append(f"{ratio(min(known))}…{ratio(max(known))}" if known else "?")
        rows.append([*cells, _known(statistic, ".3f"), _known(band.test.p_value, ".2g")])
    names = ("band (Hz)", "coherence", "condition", "dimension", "SNR", "model test", "p")
    return _table(*names, rows=rows)


def _known(value: float, spec: str) -> str:
    return "?" if math.isnan(value) else signed(value, spec)


def _octaves(snapshot: Snapshot) -> rich.table.Table:
    names = ("octave (Hz)", "segment", "segments", "excluded: gap", "transient", "averages")
    rows = (
        (
            *(f"{each.low:.3g}–{each.high:.3g}", f"{each.segment:.4g} s", str(each.n_segments)),
            *(str(each.left_out.get(why, 0)) for why in (Reason.GAP, Reason.TRANSIENT)),
            f"{each.n_effective:.0f}",
        )
        for each in snapshot.octaves
    )
    return _table(*names, rows=rows)


def _repeatability(found: Stability, names: Names) -> tuple[str, rich.table.Table]:
    """Return what is compared, and the scatter of each channel's noise beside that of steady noise.

    Recordings where there are several, parts of the recording otherwise.
    """
    scatter = found.parts if found.runs is None else found.runs
    rows = []
    for low, high, deviation, expected in zip(
        found.low, found.high, scatter.deviation, scatter.typically_expected, strict=True
    ):
        numbers = [*deviation.tolist(), float(expected)]
        cells = ["?" if math.isnan(each) else f"{100 * each:.1f} %" for each in numbers]
        rows.append((f"{low:.3g}–{high:.3g}", *cells))
    what = "parts of the recording" if found.runs is None else "recordings"
    return f"{scatter.n_parts} {what} (standard deviation)", _table(
        "band (Hz)", *names.channels, "if steady", rows=rows
    )


def _pairs(found: Diagnosis, names: Sequence[str]) -> rich.table.Table:
    columns = (
        "sensors",
        "rotation (°)",
        "horizontal (°)",
        "gains",
        "delay (µs)",
        "not orthogonal (°)",
    )
    rows: list[tuple[str, ...]] = []
    for pair in found.responses:
        angles, turned, gains, delay, skew = response_cells(pair)
        who = f"{names[pair.first]} → {names[pair.second]}"
        rows.append((who, angles, turned, gains[0], delay, skew))
        rows += [("", "", "", gain) for gain in gains[1:]]
    return _table(*columns, rows=rows)
