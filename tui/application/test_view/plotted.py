"""What is plotted of a test: curves of the chosen channel, limits, and an earlier recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.results.band_summary import correlation_of
from daq.results.limits import concerns, mask_psd
from tui.application.test_view.curves import data_curve, mask_curve, noise_curve

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from tui.application.state import State
    from tui.application.test_view.curves import Curve

DATA_STYLE = "#7d8799"
LIMIT_STYLE, LIMIT_MARKER = "#ff6b6b", "■"
REFERENCE_STYLE = ("#7bd88f", "#3f6d4b", "≈")
STYLES = {
    "three-sensor": ("#4cc9f0", "#1d6f8c", "●"),
    "three-channel": ("#f4a261", "#8a5a34", "×"),
    "maximum-likelihood": ("#c297ff", "#5f4890", "◆"),
    "two-channel": ("#e9d86b", "#7f7638", "+"),
}
"""Colours of each method, of its curve and of its 95 % band, and what marks the curve."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the technician looks at: a channel, methods by name, or clocks in place of noise."""

    channel: int = 0
    methods: tuple[str, ...] = ()
    clocks: bool = False


def curves(state: State, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the curves of the chosen channel, what is less important first.

    Its data, the same channel of the recording it is compared with, the limits, the estimates.
    """
    snapshot, settings = state.snapshot, state.settings
    if snapshot is None or settings is None or snapshot.n_segments == 0:
        return []
    column, frequency = choice.channel, snapshot.frequency
    shown = [
        data_curve(frequency, snapshot.data_psd[:, column], n_points=n_points, style=DATA_STYLE)
    ]
    shown += _reference(state, choice, n_points=n_points)
    shown += _limits(state, choice, n_points=n_points)
    for method in choice.methods:
        if method in snapshot.results:
            shown.append(
                _noise(
                    *(snapshot, settings, column),
                    method=method,
                    label=method,
                    style=STYLES[method],
                    n_points=n_points,
                )
            )
    return shown


def _noise(
    snapshot: Snapshot,
    settings: Settings,
    column: int,
    *,
    method: str,
    label: str,
    style: tuple[str, str, str],
    n_points: int,
) -> Curve:
    noise, added = snapshot.results[method], snapshot.added
    return noise_curve(
        snapshot.frequency,
        noise.noise_psd[:, column],
        noise.cov[:, column],
        correlation=correlation_of(settings),
        n_points=n_points,
        label=label,
        style=style[0],
        band_style=style[1],
        marker=style[2],
        added=None if added is None else added[:, column],
    )


def _reference(state: State, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the noise of the same channel in the earlier recording, by the first method shown."""
    reference, snapshot = state.reference, state.snapshot
    if reference is None or snapshot is None or reference.snapshot.unit != snapshot.unit:
        return []
    before = reference.snapshot
    wanted = snapshot.channels[choice.channel]
    columns = [
        column
        for column, label in enumerate(before.channels)
        if (label.sensor, label.channel) == (wanted.sensor, wanted.channel)
    ]
    methods = [method for method in choice.methods if method in before.results]
    if not columns or not methods:
        return []
    return [
        _noise(
            *(before, reference.settings, columns[0]),
            method=methods[0],
            label=reference.path.stem,
            style=REFERENCE_STYLE,
            n_points=n_points,
        )
    ]


def _limits(state: State, choice: Choice, *, n_points: int) -> list[Curve]:
    """Return the masks that are for the chosen channel."""
    snapshot, bench = state.snapshot, state.judged_by
    if snapshot is None or bench is None:
        return []
    label, frequency = snapshot.channels[choice.channel], snapshot.frequency
    return [
        mask_curve(
            frequency,
            mask_psd(bench, limit, label, frequency[1:]),
            span=(limit.frequency[0], limit.frequency[-1]),
            n_points=n_points,
            label=limit.name,
            style=LIMIT_STYLE,
            marker=LIMIT_MARKER,
        )
        for limit in bench.limits
        if concerns(limit, label)
    ]


def plot_title(snapshot: Snapshot, choice: Choice) -> str:
    """Return what the plot shows, with its unit."""
    label = snapshot.channels[choice.channel]
    return f"{label.sensor} {label.channel}   power spectral density re 1 ({snapshot.unit})²/Hz"
