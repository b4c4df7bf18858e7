"""Recordings drawn at random: clocks, latencies, rates and gaps, with known noise.

The sensors are equal, and all advice that tells them apart is wrong.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.studies.judged import METHODS, Judged
from benchmarks.studies.synthesis import Latency, synthesise
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import NoiseChanges, SharedNoise
from estimator.checks.advice_on_sensors import Delay, Gain, Rotated, UnequalResponses
from estimator.checks.advice_on_signals import NoSharedMotion
from sim_devices.world.scenario import Scenario
from tui.studies.study import ProgressCallback, Study

RANDOM_RECORDINGS = "random-recordings"
N_RECORDINGS = 160
SEED = 28
RATES = ((100.0,), (200.0,), (100.0, 200.0), (100.0, 125.0, 200.0, 250.0))
LATENCIES = (
    Latency(),
    Latency("exponential", 8e-3),
    Latency("batching", 16e-3),
    Latency("batching", 16e-3, stalled=0.1),
)
LEVEL = 1e-8
"""PSD of the motion in (m/s²)²/Hz."""
FREE, WITH_GAPS, STEPS = 0.8, 0.6, 0.2
"""Shares of recordings with free clocks and with gaps, and of clocks with a step of temperature."""
AGAIN_AND_AGAIN, RESTARTS = 0.4, 0.5
"""Shares of recordings with gaps that have some every 5 to 60 s, and where clocks restart there."""
STATED, WITH_GPS = 0.4, 0.5
"""Shares of recordings whose sensors state UTC, some or all, and where that is true."""
MIDDLE, HIGHEST = 10.0, 0.4
"""Limit in Hz of the two bands, and the end of the second over the lowest sampling rate."""
ALWAYS_WRONG = (
    Delay,
    Gain,
    UnequalResponses,
    NoSharedMotion,
    ModelMisfit,
    SharedNoise,
    NoiseChanges,
)
"""Kinds of advice that are wrong in every recording; parallel sensors are not rotated either."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A recording to be made.

    Attributes
    ----------
    scenario : Scenario
    seconds, segment, block : float
        Length of the recording, of a segment, and of a block, in seconds.
    snr : float
        Of the motion over the noise of a quiet channel.
    parallel : bool
        Whether the sensors are.
    latency : Latency
    lost : dict
        Begin and end in seconds of samples that never arrived, by sensor.
    restarts : bool
        Whether clocks restart after each loss.
    stated : tuple of str
        Sensors that state UTC.
    has_gps : bool
        Whether that is the UTC of their samples.
    computer_ppm : float
        By how much the computer's clock runs fast.
    """

    scenario: Scenario
    seconds: float
    segment: float
    block: float
    snr: float
    parallel: bool
    latency: Latency
    lost: dict[str, list[tuple[float, float]]]
    restarts: bool
    stated: tuple[str, ...]
    has_gps: bool
    computer_ppm: float


def draw(rng: np.random.Generator) -> Drawn:
    """Draw a recording."""
    names = "ABCDE"[: int(rng.choice([3, 3, 4, 5]))]
    d = int(rng.choice([1, 3, 3]))
    rates = RATES[int(rng.integers(len(RATES)))]
    seconds = float(rng.choice([240, 480, 900]))
    snr = 10 ** rng.uniform(0, 6)
    turned = str(rng.choice(["parallel", "tilted", "anyhow"])) if d > 1 else "parallel"
    is_free = rng.random() < FREE
    sensors: dict[str, Any] = {}
    for name in names:
        levels = LEVEL / snr * rng.choice([1, 1, 3, 10], d)
        sensors[name] = {
            "sampling_rate": float(rng.choice(rates)),
            "noise": [{"shape": "white", "level": float(level)} for level in levels],
            "clock": _clock(rng, seconds) if is_free else {},
        }
        if d > 1:
            sensors[name]["directions"] = _directions(turned, rng)
    lost: dict[str, list[tuple[float, float]]] = {}
    if rng.random() < WITH_GAPS:
        for _ in range(int(rng.integers(1, 6))):
            begin = float(rng.uniform(5, seconds - 5))
            end = begin + 10 ** rng.uniform(-2, 1.3)
            lost.setdefault(str(rng.choice(list(names))), []).append((begin, end))
        if rng.random() < AGAIN_AND_AGAIN:
            apart = 10 ** rng.uniform(0.7, 1.8)
            for name in rng.choice(
                list(names), int(rng.integers(1, len(names) + 1)), replace=False
            ):
                begins = np.arange(rng.uniform(5, 5 + apart), seconds - 5, apart)
                lost.setdefault(str(name), []).extend((at, at + 0.2) for at in begins.tolist())
    motion = {"spectra": [{"shape": "white", "level": LEVEL}] * d}
    table = {"motion": motion, "sensors": sensors, "seed": int(rng.integers(2**31))}
    return Drawn(
        Scenario.from_dict(table),
        seconds,
        float(rng.choice([2, 5, 10])),
        float(rng.choice([0.02, 0.1, 1.0])),
        snr,
        turned == "parallel",
        LATENCIES[int(rng.integers(len(LATENCIES)))],
        lost,
        bool(rng.random() < RESTARTS),
        _stated(rng, names),
        bool(rng.random() < WITH_GPS),
        float(rng.normal(0, 20)),
    )


def _stated(rng: np.random.Generator, names: str) -> tuple[str, ...]:
    n_stated = len(names) if rng.random() < 0.5 else int(rng.integers(1, len(names)))
    return tuple(rng.permutation(list(names))[:n_stated].tolist()) if rng.random() < STATED else ()


def _clock(rng: np.random.Generator, seconds: float) -> dict[str, Any]:
    clock: dict[str, Any] = {
        "offset": float(rng.uniform(0, 0.5)),
        "ppm": float(rng.normal(0, 30)),
        "wander": float(rng.choice([0, 0, 0.1, 1])),
    }
    if rng.random() < STEPS:
        ppm = float(rng.normal(0, 2))
        clock["step"] = {"time": float(rng.uniform(0, seconds)), "ppm": ppm, "time_constant": 60.0}
    return clock


def _directions(turned: str, rng: np.random.Generator) -> list[list[float]]:
    if turned == "parallel":
        return [list(row) for row in np.eye(3).tolist()]
    if turned == "tilted":
        rotation = Rotation.from_rotvec(rng.normal(0, 0.05, 3))
    else:
        rotation = Rotation.random(random_state=rng)
    return [list(row) for row in rotation.as_matrix().tolist()]


def random_recordings(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Judge intervals and advice on recordings drawn at random.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `N_RECORDINGS` to simulate.
    """
    n_recordings = max(8, round(N_RECORDINGS * length))
    judged = Judged()
    for number in range(n_recordings):
        progress("random recordings", number / n_recordings)
        _judge(draw(np.random.default_rng([SEED, number])), number, judged)
    return judged.study(RANDOM_RECORDINGS, f"{n_recordings} recordings drawn at random")


def _judge(drawn: Drawn, number: int, judged: Judged) -> None:
    scenario = drawn.scenario
    with tempfile.TemporaryDirectory() as folder:
        path = synthesise(
            Path(folder) / "drawn.h5",
            scenario,
            duration=drawn.seconds,
            latency=drawn.latency,
            block=drawn.block,
            seed=number,
            lost=drawn.lost,
            restarts=drawn.restarts,
            utc=dict.fromkeys(drawn.stated, 0.0),
            has_gps=drawn.has_gps,
            computer_ppm=drawn.computer_ppm,
        )
        settings = Settings(segment=drawn.segment, methods=METHODS)
        snapshot = estimate([path], settings)
    columns = [(name, r) for name in scenario.names for r in range(scenario.n_channels(name))]
    frequency = snapshot.frequency
    highest = HIGHEST * min(sensor.sampling_rate for sensor in scenario.sensors.values())
    judged.add(
        snapshot,
        settings,
        noise_psd=np.stack([scenario.true_noise_psd(*c, frequency) for c in columns], axis=1),
        bands=((1.0, MIDDLE), (MIDDLE, highest)),
        snr=drawn.snr,
        is_wrong={**dict.fromkeys(ALWAYS_WRONG, True), Rotated: drawn.parallel},
    )
