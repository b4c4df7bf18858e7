"""Named scenarios: the studies of the paper, and some others.

Levels are in (m/s²)²/Hz. The paper's numerical studies have noise of 1e-15 g²/Hz and white motion,
with 1.5 times the PSD along y as along x.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sim_devices.errors import ScenarioError
from sim_devices.world.scenario import Scenario
from sim_devices.world.spectrum import Mixed, Resonance, Spectrum, Sum, Tabulated, White
from sim_devices.world.tables import ChangingLevel, CommonMotion, PlaneWaves, SensorModel

STANDARD_GRAVITY = 9.80665
NOISE = 1e-15 * STANDARD_GRAVITY**2
SAMPLING_RATE = 200.0
SPACING = 0.12
"""Smallest distance between sensors, in metres."""

CASES: Mapping[str, tuple[str, tuple[str, str, str]]] = {
    "0": ("setup1", ("E", "C", "D")),
    "1": ("setup1", ("E", "B", "C")),
    "2": ("setup1", ("E", "A", "B")),
    "3": ("setup2", ("E", "A", "B")),
}
"""Table 1: set-up and sensors of each case, with the target first."""


def _sensor(
    rotation: float | tuple[float, float, float],
    noise: Spectrum = White(level=NOISE),  # noqa: B008 -- frozen
    **more: Any,  # noqa: ANN401 -- whatever a table holds
) -> SensorModel:
    return SensorModel(sampling_rate=SAMPLING_RATE, rotation=rotation, noise=noise, **more)


def _white_motion(along_x: float, ratio: float = 1.5) -> CommonMotion:
    return CommonMotion(spectra=(White(level=along_x), White(level=ratio * along_x)))


def three_channels(
    *, turned: tuple[float, float, float], snr: float, ratio: float = 1.5
) -> Scenario:
    """Return Fig. 3: uniaxial sensors i, j, k in a plane, each rotated from x by an angle.

    Parameters
    ----------
    turned
        Directions of the three sensors, in degrees.
    snr
        PSD of the motion over PSD of the noise, for sensor i.
    ratio
        S_y over S_x.
    """
    cosine, sine = np.cos(np.radians(turned[0])), np.sin(np.radians(turned[0]))
    along_x = snr * NOISE / float(cosine**2 + ratio * sine**2)
    each = [_sensor(angle, directions=((1.0, 0.0),)) for angle in turned]
    sensors = dict(zip("ijk", each, strict=True))
    return Scenario(motion=_white_motion(along_x, ratio), sensors=sensors)


def biaxial(*, theta: float, channel_angles: tuple[float, float, float], snr: float) -> Scenario:
    """Return Figs. 8 and 11: biaxial sensors, j and k rotated by `theta` (degrees).

    `channel_angles` are the angles between the channels of each sensor in degrees. Channel 1 of
    sensor i points along x; `snr` is that of this channel.
    """
    sensors = {}
    for name, turned, angle in zip("ijk", (0.0, theta, theta), channel_angles, strict=True):
        second = float(np.cos(np.radians(angle))), float(np.sin(np.radians(angle)))
        sensors[name] = _sensor(turned, directions=((1.0, 0.0), second))
    return Scenario(motion=_white_motion(snr * NOISE), sensors=sensors)


def fig4(*, theta: float = 10.0, snr: float = 100.0, ratio: float = 1.5) -> Scenario:
    """Return Fig. 4: sensor i at 10°, j and k rotated by `theta` from it; the bias is (13)."""
    return three_channels(turned=(10.0, 10.0 + theta, 10.0 + theta), snr=snr, ratio=ratio)


def fig5(*, theta: float = 30.0, snr: float = 100.0) -> Scenario:
    """Return Fig. 5: sensor j parallel to i, k rotated by `theta`: no bias, but variance."""
    return three_channels(turned=(10.0, 10.0, 10.0 + theta), snr=snr)


def fig9(*, theta: float = 10.0, snr: float = 100.0) -> Scenario:
    """Return Fig. 9: biaxial sensors with channels at 80°, 70° and 60° (read from a drawing)."""
    return biaxial(theta=theta, channel_angles=(80.0, 70.0, 60.0), snr=snr)


def fig12(*, alpha: float = 30.0, snr: float = 100.0) -> Scenario:
    """Return Fig. 12: all three sensors with channels at `alpha`, j and k rotated by 5°."""
    return biaxial(theta=5.0, channel_angles=(alpha, alpha, alpha), snr=snr)


def fig13(*, alpha: float = 30.0, theta: float = 60.0) -> Scenario:
    """Return Fig. 13: all three sensors with channels at `alpha`, j and k rotated by `theta`."""
    return biaxial(theta=theta, channel_angles=(alpha, alpha, alpha), snr=100.0)


def hexagon() -> dict[str, tuple[float, float, float]]:
    """Return the positions of Fig. 6 in m: E in the middle, A to D around it, 60° apart.

    C-D-E, B-C-E and A-B-E are equilateral triangles. A and C are √3 spacings apart, A and D two
    spacings.
    """
    around = {
        name: (
            float(SPACING * np.cos(np.pi / 3 * step)),
            float(SPACING * np.sin(np.pi / 3 * step)),
            0.0,
        )
        for step, name in enumerate("ABCD")
    }
    return {**around, "E": (0.0, 0.0, 0.0)}


SERVO_NOISE = Mixed(level=2e-13)
"""Noise of servo-accelerometers: pink below 20 Hz, increasing above 30 Hz."""

LABORATORY: Spectrum = Sum(
    terms=(
        Tabulated(
            frequency=(0.1, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 90.0),
            level=(3e-14, 1e-13, 4e-13, 2e-11, 2e-10, 1e-9, 5e-10, 2e-10),
        ),
        Resonance(level=2e-10, frequency=5.3, damping=0.02),
        Resonance(level=1e-9, frequency=8.7, damping=0.015),
        Resonance(level=2e-9, frequency=13.4, damping=0.02),
        Resonance(level=4e-9, frequency=24.0, damping=0.03),
        Resonance(level=2e-9, frequency=37.0, damping=0.03),
    )
)
"""Motion of a laboratory floor: below the noise at 2 Hz, with structural modes above."""


def laboratory(turned: Mapping[str, float], *, seed: int = 0) -> Scenario:
    """Return five triaxial servo-accelerometers on a floor with waves of finite speed.

    At 600 m/s waves do little to equilateral triangles and much to wider ones, as in Figs. 10
    and 14.
    """
    sensors = {
        name: _sensor(turned[name], SERVO_NOISE, position=position)
        for name, position in hexagon().items()
    }
    motion = PlaneWaves(spectrum=LABORATORY, speed=600.0)
    return Scenario(seed=seed, motion=motion, sensors=sensors)


def setup1(*, seed: int = 0) -> Scenario:
    """Return set-up 1: C, D and E parallel; A and B rotated by 60°."""
    return laboratory({"A": 60.0, "B": 60.0, "C": 0.0, "D": 0.0, "E": 0.0}, seed=seed)


def setup2(*, seed: int = 1) -> Scenario:
    """Return set-up 2: set-up 1 with A rotated back by 15°."""
    return laboratory({"A": 45.0, "B": 60.0, "C": 0.0, "D": 0.0, "E": 0.0}, seed=seed)


def waves(*, snr: float = 1e3, speed: float = 150.0, seed: int = 0) -> Scenario:
    """Return five triaxial sensors of arbitrary directions in strongly incoherent motion.

    Motion and noise are white. At 150 m/s the incoherence biases a three-sensor estimate by several
    times the noise from 20 Hz on.
    """
    angles = np.random.default_rng(9).uniform(-180.0, 180.0, (5, 3))
    sensors = {
        name: _sensor(tuple(turned), position=position)
        for (name, position), turned in zip(hexagon().items(), angles.tolist(), strict=True)
    }
    motion = PlaneWaves(spectrum=White(level=snr * NOISE), speed=speed)
    return Scenario(seed=seed, motion=motion, sensors=sensors)


def two(*, snr: float = 30.0, deviation: float = 6.0, seed: int = 0) -> Scenario:
    """Return two triaxial sensors of arbitrary directions in motion whose level changes.

    With `deviation` in dB. The noise of both follows from the changes, without a third sensor.
    """
    angles = np.random.default_rng(27).uniform(-180.0, 180.0, (2, 3))
    first, second = map(tuple, angles.tolist())
    sensors = {"A": _sensor(first), "B": _sensor(second, White(level=0.5 * NOISE), gain=1.1)}
    spectra = tuple(White(level=each * snr * NOISE) for each in (1.0, 1.5, 0.8))
    motion = CommonMotion(spectra=spectra, level=ChangingLevel(deviation=deviation))
    return Scenario(seed=seed, motion=motion, sensors=sensors)


SCENARIOS: Mapping[str, Callable[[], Scenario]] = {
    each.__name__: each for each in (fig4, fig5, fig9, fig12, fig13, setup1, setup2, waves, two)
}


def named(name: str) -> Scenario:
    """Return the scenario with this name, with the default values of its function.

    Raises
    ------
    ScenarioError
        If no scenario has this name.
    """
    if name not in SCENARIOS:
        raise ScenarioError(f"no scenario {name!r}; expected one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name]()
