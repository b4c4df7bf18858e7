"""What the averages show of the test itself, in words: what applies, or all of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.table import Table

from estimator.diagnostics.advice import model
from estimator.wording import ratio
from tui.output.formatting import signed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.console import RenderableType

    from daq.estimation.snapshot import Snapshot
    from estimator.diagnostics.advice import Advice

FAILS = "statistic over expectation"
MOST_PAIRS = 10
"""Of sensors that are listed in a sentence: all those of five."""
_LEGEND = (
    "Coherence: the least between like channels. Condition: of the worst pair of sensors, 1 is "
    "best. Dimension: of the motion. SNR: motion over noise, least and most of all channels. Model "
    "test: 1 where one common motion explains everything; p: how often chance alone makes it as "
    "large."
)


def summary(snapshot: Snapshot) -> list[str]:
    """Return what applies to this test, a line for each kind of thing; worst first."""
    names = list(dict.fromkeys(label.sensor for label in snapshot.channels))
    kinds: dict[str, list[Advice]] = {}
    for advice in snapshot.diagnostics.get("advice", ()):
        kinds.setdefault(next(iter(advice.numbers)), []).append(advice)
    lines = []
    for kind, found in kinds.items():
        in_short = _SHORT.get(kind)
        if in_short is None or (len(found) == 1 and kind != FAILS):
            lines += [_with_remedy(advice.text, advice.remedy) for advice in found]
        else:
            lines.append(
                _with_remedy(f"{in_short(found, names)}.{_odd_one(found, names)}", found[0].remedy)
            )
    tested = [band.test.p_value for band in snapshot.diagnostics.get("bands", ())]
    if FAILS not in kinds and any(math.isfinite(p_value) for p_value in tested):
        lines.append(
            f"model test: {_model(snapshot)} explains what the sensors share, in all bands"
        )
    if tested and not any(math.isfinite(p_value) for p_value in tested) and "sensors" not in kinds:
        lines.append(f"model test: {why_not_tested(snapshot)}")
    if "dimension" in snapshot.diagnostics:
        lines += _dimensions(snapshot)
    return lines


def why_not_tested(snapshot: Snapshot) -> str:
    """Return what the model test lacks, where it could be done in no band."""
    n_channels = len(snapshot.channels)
    if snapshot.n_effective > n_channels:
        return (
            f"not possible: {model(_n_factors(snapshot))} explains whatever these "
            "channels share, as they are too few for it"
        )
    return (
        f"none yet: it takes more averages ({snapshot.n_effective:.0f} now) than "
        f"channels ({n_channels})"
    )


def _n_factors(snapshot: Snapshot) -> int:
    return int(snapshot.diagnostics.get("n_factors", max(snapshot.dims)))


def _model(snapshot: Snapshot) -> str:
    """Say what was tested: of how many dimensions, where these are not the usual ones."""
    n_factors = _n_factors(snapshot)
    return "one common motion" if n_factors == max(snapshot.dims) else model(n_factors)


def _odd_one(found: Sequence[Advice], names: list[str]) -> str:
    """Say which sensor all pairs that something is wrong with have in common."""
    common = set.intersection(*(set(advice.sensors) for advice in found))
    harmless = {"angle_deg", "condition"}  # every sensor may be turned
    at_fault = not any(harmless & set(advice.numbers) for advice in found)
    if len(common) != 1 or not at_fault:
        return ""
    return f" All of these have {names[common.pop()]} in common: look there first."


def _with_remedy(text: str, remedy: str) -> str:
    return f"{text} {remedy}" if remedy else text


def details(snapshot: Snapshot) -> list[RenderableType]:
    """Return the diagnosis of every band and pair of sensors, and all advice."""
    found = snapshot.diagnostics
    if "bands" not in found:
        return ["too few sensors or averages to diagnose the test"]
    parts: list[RenderableType] = [
        "[b]What the sensors have in common, band by band[/b]",
        _bands(snapshot),
        _LEGEND,
    ]
    if found["responses"]:
        parts += ["[b]How the sensors stand to each other[/b]", _pairs(snapshot)]
    if snapshot.octaves:
        parts += ["[b]What each octave rests on[/b]", _octaves(snapshot)]
    parts += [
        f"{advice.level}: {_with_remedy(advice.text, advice.remedy)}" for advice in found["advice"]
    ]
    if "dimension" in found:
        parts += _dimensions(snapshot)
    return parts


def _bands(snapshot: Snapshot) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), title_justify="left")
    for name in ("band (Hz)", "coherence", "condition", "dimension", "SNR", "model test", "p"):
        table.add_column(name, justify="right")
    for band in snapshot.diagnostics["bands"]:
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
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("octave (Hz)", "segment", "segments", "left out: gap", "disturbed", "averages"):
        table.add_column(name, justify="right")
    for octave in snapshot.octaves:
        table.add_row(
            f"{octave.low:.3g}–{octave.high:.3g}",
            f"{octave.segment:.4g} s",
            str(octave.n_segments),
            str(octave.left_out.get("gap", 0)),
            str(octave.left_out.get("transient", 0)),
            f"{octave.n_effective:.0f}",
        )
    return table


def _pairs(snapshot: Snapshot) -> Table:
    names = list(dict.fromkeys(label.sensor for label in snapshot.channels))
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("sensors", "turned", "horizontal", "±", "gains", "delay", "not orthogonal"):
        table.add_column(name, justify="left" if name == "sensors" else "right")
    for pair in snapshot.diagnostics["responses"]:
        table.add_row(
            f"{names[pair.first]} → {names[pair.second]}",
            degrees(pair.rotation_deg),
            degrees(pair.horizontal_deg),
            degrees(pair.angle_error_deg),
            " ".join(f"{gain:.4f}" for gain in pair.gains),
            f"{signed(pair.delay * 1e6, '.1f')} µs",
            f"{pair.nonorthogonality_deg:.2f}°",
        )
    return table


def _dimensions(snapshot: Snapshot) -> list[str]:
    """Return the choice and its price for the bands where it is not the usual one, in short."""
    choices = snapshot.diagnostics["dimension"]
    unusual = [choice for choice in choices if choice.accepted and choice.n_factors != choice.usual]
    failing = [choice for choice in choices if choice.is_biased]
    lines = [choice.text for choice in unusual]
    if failing:
        where = ", ".join(f"{choice.low:.3g}–{choice.high:.3g}" for choice in failing)
        lines.append(f"no dimension that these sensors allow explains {where} Hz")
    if len(unusual) + len(failing) < len(choices):
        where = "elsewhere" if lines else "in all bands"
        lines.append(f"{where} the motion has all {choices[0].usual} dimensions")
    return lines


def degrees(angle: float) -> str:
    """Return an angle to a thousandth of a degree."""
    return f"{signed(angle, '.3f')}°" if math.isfinite(angle) else "?"


def _fails(found: Sequence[Advice], _names: list[str]) -> str:
    by_worst = sorted(found, key=lambda advice: advice.numbers["worst"], reverse=True)
    most = by_worst[0].numbers
    where = ", ".join(f"{_span(advice)} ({advice.numbers['worst']:.3g})" for advice in by_worst)
    effect = by_worst[0].text.partition("). ")[2].rstrip(".")
    tested = "one common motion"
    if "dimensions" in most:
        tested = model(int(most["dimensions"]))
    return (
        f"model test fails at {where}: {tested} does not explain what the sensors share "
        f"(in brackets its statistic over the expectation, at worst, which is at "
        f"{most['worst_low_hz']:.3g}–{most['worst_high_hz']:.3g} Hz). {effect}"
    )


def _listed(
    found: Sequence[Advice],
    names: list[str],
    number: str,
    words: Callable[[float], str],
    *,
    usual: float = 0.0,
) -> str:
    """Return pairs of sensors with a number each; of very many those furthest from the usual."""
    shown = found
    if len(found) > MOST_PAIRS:
        by_size = sorted(found, key=lambda each: abs(each.numbers[number] - usual), reverse=True)
        shown = by_size[:MOST_PAIRS]
    text = ", ".join(f"{_pair(each, names)} {words(each.numbers[number])}" for each in shown)
    left = len(found) - len(shown)
    return text + (f" and less in {left} more pairs" if left else "")


def _turned(found: Sequence[Advice], names: list[str]) -> str:
    horizontal = all(math.isfinite(advice.numbers["horizontal_deg"]) for advice in found)
    which = "horizontal_deg" if horizontal else "angle_deg"
    pairs = _listed(found, names, which, degrees)
    return (
        f"sensors are turned{' in the horizontal' if horizontal else ''}: {pairs}: no bias in the "
        "three-sensor or maximum likelihood estimate, but a three-channel or two-channel estimate "
        "leaks motion"
    )


def _gains(found: Sequence[Advice], names: list[str]) -> str:
    pairs = _listed(found, names, "gain", lambda gain: f"{gain:.3f}", usual=1.0)
    return f"gains differ: {pairs}: no bias, but a sensitivity is wrong, and the noise with it"


def _delayed(found: Sequence[Advice], names: list[str]) -> str:
    pairs = _listed(found, names, "delay_s", lambda delay: f"{signed(delay * 1e3, '.3g')} ms")
    return f"sensors lag each other: {pairs}: segments then differ at their ends"


def _skewed(found: Sequence[Advice], names: list[str]) -> str:
    pairs = _listed(found, names, "nonorthogonality_deg", lambda angle: f"{angle:.1f}°")
    return (
        f"channels are away from a right angle: {pairs}: no bias, but the noise estimate scatters "
        "more the more collinear they are"
    )


def _reversed(found: Sequence[Advice], _names: list[str]) -> str:
    pairs = ", ".join(advice.text.split(":")[0] for advice in found)
    return f"{pairs}: no bias, but a sensitivity has the wrong sign"


def _swapped(found: Sequence[Advice], _names: list[str]) -> str:
    pairs = "; ".join(advice.text.split(": ", 1)[1].split(". ")[0] for advice in found)
    return f"channels are swapped: {pairs}: no bias, but the noise stands under the wrong names"


def _singular(found: Sequence[Advice], _names: list[str]) -> str:
    where = ", ".join(_span(advice) for advice in found)
    return (
        f"nearly singular at {where}: one direction moves far less than the others there, and the "
        "three-sensor estimate scatters more"
    )


_SHORT: dict[str, Callable[[Sequence[Advice], list[str]], str]] = {
    FAILS: _fails,
    "angle_deg": _turned,
    "gain": _gains,
    "delay_s": _delayed,
    "nonorthogonality_deg": _skewed,
    "channel": _reversed,
    "swapped": _swapped,
    "condition": _singular,
}


def _pair(advice: Advice, names: list[str]) -> str:
    return "–".join(names[sensor] for sensor in advice.sensors)


def _span(advice: Advice) -> str:
    low, high = advice.band or (math.nan, math.nan)
    return f"{low:.3g}–{high:.3g} Hz"
