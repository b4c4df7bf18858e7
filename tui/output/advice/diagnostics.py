"""The diagnosis of a test: its findings, or all of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from daq.results.band_summary import highest_known
from estimator.diagnostics.advice import (
    Delay,
    Gain,
    ModelMisfit,
    NoSharedMotion,
    TooFewDimensions,
    TooFewSensors,
)
from estimator.diagnostics.kinds import Level, Untested
from estimator.spectra.segment_rejection import Reason
from tui.output.advice.sentences import Names, explain, model
from tui.output.advice.summary import summarise
from tui.output.formatting import degrees, listed, ratio, signed, span

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from daq.estimation.snapshot import Snapshot
    from daq.estimation.snapshot_diagnostics import (
        Diagnosis,
    )
    from estimator.diagnostics.stability import Stability
    from estimator.likelihood.dimension import BandDimension

_LEGEND = (
    "Coherence: the lowest between like channels of two sensors. Condition: condition number of "
    "the cross-spectral matrix between two sensors, of the worst pair; 1 is best. Dimension: of "
    "the motion. SNR: motion over noise, lowest and highest of all channels. Model test: its "
    "statistic over its expectation, 1 if one common motion explains the averages; p: "
    "probability of a statistic this large by chance."
)
_LIKE_A_CLOCK = Delay | Gain | ModelMisfit | NoSharedMotion
"""Advice that unknown clocks alone can bring about."""
_TURN = 0.3  # rad at the highest frequency: 9 % of the motion is taken for noise there


def summary(snapshot: Snapshot) -> list[str]:
    """Return the findings of this test, one line per kind, worst first."""
    diagnostics = snapshot.diagnostics
    lines = summarise(diagnostics.advice, Names.of(snapshot))
    found = diagnostics.diagnosis
    if found is not None:
        failing = any(
            isinstance(a, ModelMisfit | NoSharedMotion | TooFewDimensions) for a in found.advice
        )
        if diagnostics.untested is None:
            more = any(each.n_factors > each.usual for each in diagnostics.dimensions)
            understood = all(clock.is_understood for clock in snapshot.clocks)
            if not failing and not more and understood:  # further dimensions are told below
                lines.append(
                    f"The model test passes in all bands: {model(found.n_factors, snapshot.dims)} "
                    "explains what the sensors have in common."
                )
        elif not any(isinstance(advice, TooFewSensors) for advice in found.advice):
            lines.append(why_untested(snapshot))
    return lines + _by_clocks(snapshot) + _dimensions(diagnostics.dimensions)


def _by_clocks(snapshot: Snapshot) -> list[str]:
    """Return a line on clocks so little known that what is wrong may come from them."""
    if not any(isinstance(each, _LIKE_A_CLOCK) for each in snapshot.diagnostics.advice):
        return []
    left, omega = (
        snapshot.diagnostics.synchronisation.residual,
        2 * math.pi * highest_known(snapshot),
    )
    loose = {sensor: late for sensor, late in left.items() if omega * late > _TURN}
    if not loose:
        return []
    clocks = "clock" if len(loose) == 1 else "clocks"
    text = f"The {clocks} of {listed(list(loose))} {'is' if len(loose) == 1 else 'are'} known to"
    text += f" about {max(loose.values()) * 1e3:.2g} ms only. Lags, missing motion or a misfit as"
    text += " above may come from that alone. Give the sensors one clock, see that connections are"
    return [f"{text} not lost, or record with more motion."]


def problems(snapshot: Snapshot) -> list[str]:
    """Return problems and warnings of the test, one line each."""
    names, found = Names.of(snapshot), snapshot.diagnostics.advice
    return [str(explain(each, names)) for each in found if each.level is not Level.NOTE]


_WHY_UNTESTED = {
    Untested.UNFINISHED: "The diagnosis follows with the first segments.",
    Untested.NO_SEGMENTS: "The model test needs averages, and the recording has no segment.",
    Untested.TOO_FEW_SENSORS: "The model test needs three sensors with a signal of their own.",
    Untested.TOO_FEW_AVERAGES: "The model test needs more averages ({n:.0f} so far) than channels "
    "({channels}).",
    Untested.TOO_FEW_CHANNELS: "The model test is not possible: {model} explains any signals of so "
    "few channels.",
    Untested.SINGULAR: "The model test is not possible: at no frequency is the cross-spectral "
    "matrix finite and regular.",
}


def why_untested(snapshot: Snapshot) -> str:
    """Return why the model of one common motion was not tested; empty if it was."""
    why, found = snapshot.diagnostics.untested, snapshot.diagnostics.diagnosis
    if why is None:
        return ""
    n_factors = max(snapshot.dims) if found is None else found.n_factors
    return _WHY_UNTESTED[why].format(
        n=snapshot.n_effective,
        channels=len(snapshot.channels),
        model=model(n_factors, snapshot.dims),
    )


def details(snapshot: Snapshot) -> list[RenderableType]:
    """Return the diagnosis of every band and pair of sensors, and all advice."""
    found = snapshot.diagnostics.diagnosis
    if found is None:
        return [Text(why_untested(snapshot))]
    parts: list[RenderableType] = [_heading("Common motion by band"), _bands(found), Text(_LEGEND)]
    if found.responses:
        pairs = _pairs(found, snapshot.sensor_names)
        parts += [_heading("Orientation, gain and delay of the sensors"), pairs]
    if snapshot.octaves:
        parts += [_heading("Segments of each octave"), _octaves(snapshot)]
    names = Names.of(snapshot)
    if found.stability is not None:
        between, table = _repeatability(found.stability, names)
        parts += [_heading(f"Repeatability of the noise between {between}"), table]
    parts += [Text(f"{advice.level}: {explain(advice, names)}") for advice in found.advice]
    parts += [Text(line) for line in _dimensions(snapshot.diagnostics.dimensions)]
    return parts


def _heading(text: str) -> Text:
    return Text(text, style="bold")


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in columns:
        table.add_column(name, justify="left" if name == "sensors" else "right")
    return table


def _bands(found: Diagnosis) -> Table:
    table = _table("band (Hz)", "coherence", "condition", "dimension", "SNR", "model test", "p")
    for band in found.bands:
        known = [float(value) for value in band.snr if math.isfinite(value)]
        statistic = band.test.statistic / band.test.degrees if band.test.degrees else math.nan
        table.add_row(
            f"{band.low:.3g}–{band.high:.3g}",
            _known(band.coherence, ".4f"),
            _known(band.condition, ".3g"),
            _known(band.dimension, ".0f"),
            f"{ratio(min(known))}…{ratio(max(known))}" if known else "?",
            _known(statistic, ".3f"),
            _known(band.test.p_value, ".2g"),
        )
    return table


def _known(value: float, spec: str) -> str:
    return "?" if math.isnan(value) else signed(value, spec)


def _octaves(snapshot: Snapshot) -> Table:
    table = _table("octave (Hz)", "segment", "segments", "excluded: gap", "transient", "averages")
    for octave in snapshot.octaves:
        table.add_row(
            f"{octave.low:.3g}–{octave.high:.3g}",
            f"{octave.segment:.4g} s",
            str(octave.n_segments),
            str(octave.left_out.get(Reason.GAP, 0)),
            str(octave.left_out.get(Reason.TRANSIENT, 0)),
            f"{octave.n_effective:.0f}",
        )
    return table


def _repeatability(found: Stability, names: Names) -> tuple[str, Table]:
    """Return what is compared, and the scatter of each channel's noise beside that of steady noise.

    Recordings where there are several, parts of the recording otherwise.
    """
    scatter = found.parts if found.runs is None else found.runs
    table = _table("band (Hz)", *names.channels, "if steady")
    for low, high, deviation, expected in zip(
        found.low, found.high, scatter.deviation, scatter.typically_expected, strict=True
    ):
        numbers = [*deviation.tolist(), float(expected)]
        cells = ["?" if math.isnan(each) else f"{100 * each:.1f} %" for each in numbers]
        table.add_row(f"{low:.3g}–{high:.3g}", *cells)
    what = "parts of the recording" if found.runs is None else "recordings"
    return f"{scatter.n_parts} {what} (standard deviation)", table


def _pairs(found: Diagnosis, names: Sequence[str]) -> Table:
    table = _table("sensors", "rotation", "horizontal", "±", "gains", "delay", "not orthogonal")
    for pair in found.responses:
        table.add_row(
            Text(f"{names[pair.first]} → {names[pair.second]}"),
            degrees(pair.rotation_deg),
            degrees(pair.horizontal_deg),
            degrees(pair.angle_error_deg),
            " ".join(f"{gain:.4f}" for gain in pair.gains),
            "?" if math.isnan(pair.delay) else f"{signed(pair.delay * 1e6, '.1f')} µs",
            f"{pair.nonorthogonality_deg:.2f}°",
        )
    return table


def _dimensions(choices: Sequence[BandDimension]) -> list[str]:
    """Return the bands with an unusual dimension, and its cost in precision."""
    if not choices:
        return []
    unusual = [choice for choice in choices if choice.accepted and choice.n_factors != choice.usual]
    failing = [choice for choice in choices if choice.is_biased]
    lines = _gradients([choice for choice in unusual if choice.gradients])
    lines += [_choice(choice) for choice in unusual if not choice.gradients]
    if failing:
        bands = ", ".join(f"{choice.low:.3g}–{choice.high:.3g}" for choice in failing)
        lines.append(
            f"At {bands} Hz no dimension that these sensors allow explains the averages: the noise "
            "estimate is biased there."
        )
    unknown = [choice for choice in choices if choice.is_undetermined and not choice.is_biased]
    if unknown:
        bands = ", ".join(f"{choice.low:.3g}–{choice.high:.3g}" for choice in unknown)
        lines.append(
            f"At {bands} Hz the sensors do not share one motion of {unknown[0].usual} dimensions. "
            f"More dimensions explain the averages, but {unknown[0].n_sensors} sensors cannot tell "
            "them from noise: the noise estimate may be wrong by any amount. Use six sensors, or "
            "put them closer together."
        )
    if len(unusual) + len(failing) + len(unknown) < len(choices):
        elsewhere = "Elsewhere" if lines else "In all bands"
        lines.append(f"{elsewhere} the motion has all {choices[0].usual} dimensions.")
    return lines


def _gradients(choices: Sequence[BandDimension]) -> list[str]:
    """Return the bands that gradients of the motion explain, and their cost in precision."""
    if not choices:
        return []
    bands = ", ".join(f"{low:.3g}–{high:.3g}" for low, high in _joined(choices))
    low, high = (f"{pick(each.cov for each in choices):.2g}" for pick in (min, max))
    usual = max(each.usual_cov for each in choices)
    return [
        (
            f"At {bands} Hz the motion and its gradients across the bench explain the averages; the"
            f" c.o.v. of one frequency is {low if low == high else f'{low} to {high}'} instead of"
            f" {usual:.2g}."
        )
    ]


def _joined(choices: Sequence[BandDimension]) -> list[tuple[float, float]]:
    """Return the edges of bands, neighbours taken together."""
    spans: list[tuple[float, float]] = []
    for choice in choices:
        width = (choice.high - choice.low) / 4
        if spans and choice.low - spans[-1][1] < width:
            spans[-1] = (spans[-1][0], choice.high)
        else:
            spans.append((choice.low, choice.high))
    return spans


def _choice(choice: BandDimension) -> str:
    """Return an unusual dimension, and its cost in precision."""
    price = f"the c.o.v. of one frequency is {choice.cov:.2g}"
    if math.isfinite(choice.usual_cov):
        price += f" instead of {choice.usual_cov:.2g}"
    at = f"At {span(choice.low, choice.high)}"
    if choice.n_factors < choice.usual:
        return f"{at} the motion has {choice.n_factors} of {choice.usual} dimensions; {price}."
    return (
        f"{at} the sensors do not share one motion of {choice.usual} dimensions; "
        f"{choice.n_factors} dimensions explain the averages; {price}."
    )
