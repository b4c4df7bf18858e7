"""Samples of simulated sensors, whose noise is known."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from daq.bench.durations import format_duration, parse_duration
from daq.bench.model import Bench
from daq.caveats import Caveat, Caveats
from daq.errors import WrongSettingError
from estimator.types import FloatArray
from sim_devices.errors import ScenarioError
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World
from tui.simulation.write_recording import bench_of, described, write

PathLike: TypeAlias = str | os.PathLike[str]


class Simulation(Mapping[str, "FloatArray"]):
    """Simulated samples, as `huddle.simulate` returns them.

    A mapping of the name of each sensor to its samples in m/s², float64, shape
    (n_samples, n_channels). Every sensor samples by its own clock, as in the scenario.

    Attributes
    ----------
    scenario : Scenario
    duration : float
        In seconds.
    caveats : Caveats
        That it is simulated; estimates say so.
    """

    caveats = Caveats([Caveat.SIMULATED])

    def __init__(self, bench: Bench, scenario: Scenario, duration: float) -> None:
        self.scenario = scenario
        self.duration = duration
        self._bench = bench
        self._world = World(scenario)
        self._samples: dict[str, FloatArray] = {}

    @property
    def fs(self) -> dict[str, float]:
        """Sampling rate of each sensor in Hz."""
        return {name: model.sampling_rate for name, model in self.scenario.sensors.items()}

    def true_noise_psd(self, frequency: FloatArray) -> FloatArray:
        """Return the noise that the sensors have.

        Parameters
        ----------
        frequency : float64, shape (n_freqs,)
            In Hz.

        Returns
        -------
        float64, shape (n_freqs, n_channels)
            In (m/s²)²/Hz; the columns are those of a `Result`.
        """
        return np.stack(
            [
                self.scenario.true_noise_psd(name, channel, frequency)
                for name in self.scenario.names
                for channel in range(self.scenario.n_channels(name))
            ],
            axis=1,
        )

    def write(self, path: PathLike) -> None:
        """Write a recording of integer counts, as ``huddle simulate`` does.

        Raises
        ------
        RecordingError
            If the file exists or cannot be written.
        """
        write(Path(path), self._bench, self.scenario, duration=self.duration)

    def __getitem__(self, sensor: str) -> FloatArray:
        if sensor not in self.scenario.names:
            raise KeyError(f"{sensor!r}: expected one of {', '.join(self.scenario.names)}")
        if sensor not in self._samples:
            n_samples = round(self.duration * self.fs[sensor])
            self._samples[sensor] = self._world.samples(sensor, 0, n_samples)
        return self._samples[sensor]

    def __iter__(self) -> Iterator[str]:
        return iter(self.scenario.names)

    def __len__(self) -> int:
        return len(self.scenario.names)

    def __repr__(self) -> str:
        sensors = ", ".join(
            f"{name} ({self.scenario.n_channels(name)} at {rate:g} Hz)"
            for name, rate in self.fs.items()
        )
        return f"Simulation({format_duration(self.duration)}: {sensors})"


def simulate(
    scenario: PathLike | Mapping[str, Any],
    duration: str | float = "10min",
    *,
    fs: float | None = None,
    seed: int | None = None,
) -> Simulation:
    """Simulate the samples of sensors with one motion and known noise.

    Parameters
    ----------
    scenario : str, path or mapping
        Name of a scenario (fig4, fig5, fig9, fig12, fig13, setup1, setup2, waves), a bench file
        with a table ``[simulation]``, or such a table.
    duration : str or float
        In seconds, or as in ``"10min"``.
    fs : float, optional
        Sampling rate in Hz of sensors in a table that do not state their own.
    seed : int, optional
        Of motion and noise; that of the scenario, if not given.

    Returns
    -------
    Simulation
        Samples by sensor; its `fs` and its `true_noise_psd`.

    Raises
    ------
    ValueError
        If there is no such scenario, or a key of the table is wrong.

    Examples
    --------
    >>> import huddle
    >>> sensors = huddle.simulate(
    ...     {
    ...         "motion": {"spectra": [{"shape": "white", "level": 1e-9}]},
    ...         "sensors": {name: {"noise": {"shape": "white", "level": 1e-13}} for name in "ABC"},
    ...     },
    ...     duration=60,
    ...     fs=100,
    ... )
    >>> sensors["A"].shape
    (6000, 1)
    """
    try:
        seconds = parse_duration(duration)
    except ValueError as error:
        raise WrongSettingError(f"duration={duration!r}: {error}") from None
    if isinstance(scenario, Mapping):
        world = Scenario.from_dict(scenario, sampling_rate=fs)
        bench = bench_of("simulation", world)
    elif fs is not None:
        raise WrongSettingError(f"fs={fs!r}: {scenario} has its own; expected no fs")
    elif isinstance(scenario, (str, os.PathLike)):
        bench, world = described(os.fspath(scenario))
    else:
        raise ScenarioError(
            f"scenario: a {type(scenario).__name__}; expected a name, a bench file, or a"
            " dictionary with motion and sensors"
        )
    if seed is not None:
        world = Scenario.from_dict({**world.to_dict(), "seed": seed})
        bench = bench.model_copy(update={"simulation": bench.simulation | {"seed": seed}})
    return Simulation(bench, world, seconds)
