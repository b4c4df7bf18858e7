"""Shapes of spectra: their values, their tables, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from sim_devices.world.spectrum import Mixed, Pink, Resonance, Spectrum, Sum, Tabulated, White

SHAPES: list[Spectrum] = [
    White(level=2e-13),
    Pink(level=1e-12),
    Mixed(level=3e-14),
    Resonance(level=1e-6, frequency=8.0, damping=0.02),
    Tabulated(frequency=(0.1, 1.0, 100.0), level=(1e-10, 1e-12, 1e-12)),
    Sum(terms=(White(level=1.0), Pink(level=2.0))),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: str(shape.shape))
def test_a_shape_survives_its_table_and_is_finite_from_zero_up(shape: Spectrum) -> None:
    adapter: TypeAdapter[Spectrum] = TypeAdapter(Spectrum)
    assert adapter.validate_python(shape.model_dump(mode="json")) == shape
    psd = shape.psd(np.array([0.0, 0.01, 1.0, 100.0]))
    assert psd.shape == (4,)
    assert np.all(np.isfinite(psd) & (psd >= 0))


def test_pink_falls_tenfold_a_decade_and_passes_its_level_at_one_hertz() -> None:
    one, ten = Pink(level=5.0).psd(np.array([1.0, 10.0]))
    assert one == pytest.approx(5.0, rel=1e-3)
    assert one / ten == pytest.approx(10.0, rel=1e-3)


def test_mixed_has_the_slopes_of_the_papers_instruments() -> None:
    frequency = np.array([0.5, 1.0, 25.0, 300.0, 600.0])
    psd = Mixed(level=1.0).psd(frequency)
    assert psd[0] / psd[1] == pytest.approx(2.0, rel=0.03)  # 1/f below 20 Hz
    assert psd[4] / psd[3] == pytest.approx(4.0, rel=0.03)  # f² well above 30 Hz
    assert psd.argmin() == 2


def test_resonance_peaks_at_its_frequency() -> None:
    mode = Resonance(level=4.0, frequency=8.0, damping=0.01)
    assert mode.psd(np.array([8.0])) == pytest.approx(4.0)
    half_power = mode.psd(np.array([8.0 * 0.99, 8.0 * 1.01]))
    assert half_power == pytest.approx([2.0, 2.0], rel=0.05)


def test_a_table_is_straight_in_log_log_and_constant_beyond_its_ends() -> None:
    table = Tabulated(frequency=(1.0, 100.0), level=(1.0, 1e-4))
    psd = table.psd(np.array([0.0, 0.5, 10.0, 1000.0]))
    assert psd == pytest.approx([1.0, 1.0, 1e-2, 1e-4])


def test_a_sum_adds() -> None:
    frequency = np.array([0.3, 30.0])
    first, second = White(level=1.0), Pink(level=2.0)
    assert np.array_equal(
        Sum(terms=(first, second)).psd(frequency), first.psd(frequency) + second.psd(frequency)
    )


@pytest.mark.parametrize(
    ("frequency", "level", "said"),
    [
        ((1.0, 2.0), (1.0,), "2 frequencies and 1 levels"),
        ((2.0, 1.0), (1.0, 1.0), "must increase strictly"),
    ],
)
def test_an_invalid_table_is_refused(
    frequency: tuple[float, ...], level: tuple[float, ...], said: str
) -> None:
    with pytest.raises(ValidationError, match=said):
        Tabulated(frequency=frequency, level=level)
