"""The calibration in the report."""

from __future__ import annotations

import numpy as np

from daq.bench.channel import Certificate, Channel
from daq.bench.model import Bench, Sensor
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.results.result import Result
from tui.output.calibration import share
from tui.page.blocks import KeyValues, Paragraph
from tui.page.table import Table
from tui.report.contents import calibration_section

SETTINGS = Settings(segment=2.0, band=(1.0, 20.0))


def made(names: str, settings: Settings = SETTINGS) -> Snapshot:
    rng = np.random.default_rng(2)
    motion = 100 * rng.standard_normal((6000, 2))
    samples = {name: motion + rng.standard_normal((6000, 2)) for name in names}
    return estimate([recording_of_arrays(samples, 50.0, unit="m/s²")], settings)


def bench() -> Bench:
    certificate = Certificate(value=1.0, expanded_uncertainty=0.01, number="L-7")
    channels = tuple(Channel(name=n, sensitivity=1.0, certificate=certificate) for n in "12")
    plain = tuple(Channel(name=n, sensitivity=1.0) for n in "12")
    return Bench(
        name="lab",
        sampling_rate=50.0,
        sensors=tuple(
            Sensor(
                name=name,
                driver="text",
                port=name,
                sampling_rate=50.0,
                channels=channels if name == "C" else plain,
            )
            for name in "ABC"
        ),
    )


def test_values_budgets_and_certificates_are_there() -> None:
    section = calibration_section(Result(made("ABC"), SETTINGS, bench()))
    assert section is not None
    opening = section.parts[0]
    assert isinstance(opening, Paragraph)
    assert "against C (absolute, by its certificate)" in opening.text
    (facts,) = (part for part in section.parts if isinstance(part, KeyValues))
    assert facts.rows[0] == (
        "Certificate of C.1",
        "1 counts per unit, U = 0.01 (k = 2), date not given, L-7",
    )
    tables = {part.title: part for part in section.parts if isinstance(part, Table)}
    assert len(tables) == 4  # the noise has its own section
    budget = tables["Uncertainty budget of the sensitivities"]
    assert "cert. (B)" in budget.header
    assert {len(row) for table in tables.values() for row in table.rows} == {
        len(table.header) for table in tables.values()
    }
    assert budget.rows[0][budget.header.index("cert. (B)")] == "0.5 %"


def test_two_sensors_cannot_be_calibrated() -> None:
    settings = Settings(segment=2.0, methods=("two-channel",))
    assert calibration_section(Result(made("AB", settings), settings)) is None


def test_shares_are_short() -> None:
    assert [share(each) for each in (0.0, 1e-9, 0.00021, 0.05, 0.996, 1.234)] == [
        "0",
        "< 0.001 %",
        "0.021 %",
        "5 %",
        "100 %",
        "120 %",
    ]
