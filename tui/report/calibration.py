"""The calibration in the report: values, cross-axis response and budgets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.results.calibration import calibrate
from estimator.errors import InsufficientDataError
from tui.output.calibration import (
    LEGEND,
    angle_table,
    budget_table,
    matrix_table,
    noise_rows,
    remarks,
    sensitivity_table,
    title,
)
from tui.report.parts import Facts, Paragraph, Section, Table

if TYPE_CHECKING:
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.calibration import Calibration
    from tui.report.parts import Part


def calibration_section(
    snapshot: Snapshot, settings: Settings, bench: Bench | None
) -> Section | None:
    """Return the calibration against the reference; None where no sensors can be compared."""
    try:
        found = calibrate(snapshot, settings, bench)
    except InsufficientDataError:
        return None
    sensitivities, noise = found.whole_band("sensitivity"), found.whole_band("noise")
    tables = [
        ("Sensitivity, delay and misalignment", sensitivity_table(found, snapshot)),
        ("Rotation about the axes of the reference", angle_table(found, snapshot)),
        ("Relative response, cross-axis included", matrix_table(found, snapshot)),
        ("Uncertainty budget of the sensitivities", budget_table(sensitivities)),
    ]
    if noise:
        tables += [
            (
                "Noise by the calibrated sensitivities, with its expanded uncertainty",
                noise_rows(found, snapshot.unit),
            ),
            ("Uncertainty budget of the noise PSD", budget_table(noise)),
        ]
    parts: list[Part] = [Paragraph(f"{title(found, snapshot)}. {remarks(found, snapshot)[0]}")]
    if found.certificates:
        parts.append(_certificates(found, snapshot))
    parts += [
        Table(header, rows, left=frozenset({0, 1} if header[1] == "channel" else {0}), title=name)
        for name, (header, rows) in tables
        if rows
    ]
    parts += [Paragraph(line, "quiet") for line in (LEGEND, *remarks(found, snapshot)[1:])]
    return Section("Calibration", tuple(parts))


def _certificates(found: Calibration, snapshot: Snapshot) -> Facts:
    """Return the certificates of the reference, a line each."""
    name = snapshot.sensor_names[found.reference]
    labels = [label for label in snapshot.channels if label.sensor == name]
    return Facts(
        tuple(
            (
                f"Certificate of {label.name}",
                f"{each.value:.8g} counts per unit, U = {each.expanded_uncertainty:.3g} "
                f"(k = {each.k:g}), {'date not given' if each.date is None else each.date}"
                + (f", {each.number}" if each.number else ""),
            )
            for label, each in zip(labels, found.certificates, strict=True)
        )
    )
