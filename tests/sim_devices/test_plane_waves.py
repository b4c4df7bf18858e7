"""A field of waves: whole in one point, less coherent apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from sim_devices.world import plane_waves
from sim_devices.world.scenario import Scenario
from sim_devices.world.spectrum import White
from sim_devices.world.tables import PlaneWaves
from sim_devices.world.world import World

WAVES = PlaneWaves(spectrum=White(level=1.0), speed=150.0, n_directions=24)
FREQUENCY = np.array([0.0, 1.0, 20.0, 50.0])


def test_every_direction_has_the_whole_spectrum_and_none_is_favoured() -> None:
    amplitude = plane_waves.field(WAVES, (0.3, -0.2, 0.0), FREQUENCY)[1:]
    matrix = amplitude @ amplitude.conj().transpose(0, 2, 1)
    assert np.allclose(matrix, np.eye(3))


def test_vertical_coherence_is_the_bessel_function_of_waves_from_all_sides() -> None:
    here = plane_waves.field(WAVES, (0.0, 0.0, 0.0), FREQUENCY)
    there = plane_waves.field(WAVES, (0.12, 0.0, 0.0), FREQUENCY)
    cross = (here @ there.conj().transpose(0, 2, 1))[1:, 2, 2]
    around = special.j0(2 * np.pi * FREQUENCY[1:] / 150.0 * 0.12)
    assert cross == pytest.approx(WAVES.from_below + (1 - WAVES.from_below) * around, abs=1e-9)


def test_waves_reach_the_sensors_at_their_own_times() -> None:
    """In the time domain, against the sum of delayed waves that theory asks for."""
    apart = {"A": {}, "B": {"position": [0.5, 0.3, 0.0]}}
    table = {"seed": 2, "motion": WAVES.model_dump(), "sensors": apart}
    world = World(Scenario.from_dict(table, sampling_rate=200.0))
    times = np.arange(0, 250, 1 / 200)
    channels = np.concatenate([world.motion(name).at(times).T for name in "AB"])
    segments = channels.reshape(6, -1, 400) * np.hanning(400)
    spectra = np.fft.rfft(segments)
    n = spectra.shape[1]
    power = np.mean(np.abs(spectra) ** 2, axis=1)
    at = np.array([10, 40, 80])  # 5, 20, 40 Hz
    cross = np.mean(spectra[:3, None] * spectra[None, 3:].conj(), axis=2)[..., at]
    coherency = cross / np.sqrt(power[:3, None] * power[None, 3:])[..., at]
    here = plane_waves.field(WAVES, (0.0, 0.0, 0.0), at / 2.0)
    there = plane_waves.field(WAVES, (0.5, 0.3, 0.0), at / 2.0)
    theory = (here @ there.conj().transpose(0, 2, 1)).transpose(1, 2, 0)
    assert np.max(np.abs(coherency - theory)) < 4.5 / np.sqrt(n)


def test_a_wave_arrives_later_further_along_its_way() -> None:
    one = PlaneWaves(spectrum=White(level=1.0), speed=150.0, n_directions=1, from_below=0.0)
    table = {
        "motion": one.model_dump(),
        "sensors": {"A": {}, "B": {"position": [-15.0, 0.0, 0.0]}},  # it travels along −x
    }
    world = World(Scenario.from_dict(table, sampling_rate=200.0))
    times = np.arange(100, 110, 1 / 200)
    late = world.motion("A").at(times - 0.1)
    assert np.std(world.motion("B").at(times) - late) < 1e-3 * np.std(late)
