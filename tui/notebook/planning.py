"""The duration of recording for a target precision, by every method."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from daq.bench.durations import format_duration
from daq.bench.model import Bench
from daq.devices.bench_file import load
from daq.errors import WrongSettingError
from daq.estimation.noise_estimates import responses
from daq.estimation.settings import Settings
from daq.results.band_summary import correlation_of
from estimator import planning
from estimator.levels.bands import third_octaves
from estimator.levels.interval import worth
from estimator.likelihood.dimension import MIN_DETERMINED_SENSORS, ROOM, ROOM_OF_ONE_CHANNEL
from estimator.likelihood.gradients import MIN_SENSORS
from estimator.methods import self_noise
from estimator.planning import TimePlan
from estimator.responses.edge_leakage import slope_factor
from estimator.responses.equalisation import THRESHOLD
from estimator.spectra.welch import WelchSettings
from estimator.spectra.windows import get_window
from estimator.types import FloatArray
from estimator.wording import percent, signed
from tui.notebook.options import settings_of
from tui.notebook.text import rendered
from tui.page.table import Table
from tui.simulation.devices import scenario_of

WAVES = 150.0  # m/s, of a floor; the ground is faster
ASSUMED_RADIUS = 0.12  # m, of a bench of unknown positions
_AT = 20.0  # Hz, where precision is compared
_SIX = (
    "five on a circle of {radius:.0f} cm and one in its centre, each rotated by a different angle,"
    " none of them a multiple of 90°"
)


@dataclass(frozen=True, slots=True)
class Waves:
    """What waves across the bench do to the noise, and what gradients of the motion cost.

    Attributes
    ----------
    n_sensors : int
    radius : float
        Metres, of the sensors about their centre.
    is_known : bool
        Whether positions are known; else sensors are taken to stand on a circle.
    one_percent : float
        Frequency in Hz at which the three-sensor estimate of the worst channel is biased by 1 % of
        the noise; the bias grows with the square of the frequency.
    cost, cost_of_six : float
        c.o.v. of one frequency at 20 Hz times the root of the averages, with gradients of the
        motion, with these and with six sensors; infinite where gradients cannot be told from noise.
    """

    n_sensors: int
    radius: float
    is_known: bool
    one_percent: float
    cost: float
    cost_of_six: float

    @property
    def sentences(self) -> str:
        """What to expect, and what to do."""
        where = (
            "at their positions" if self.is_known else f"on a circle of {100 * self.radius:.0f} cm"
        )
        text = (
            f"Waves of {WAVES:g} m/s across the sensors, {where}, bias the three-sensor estimate by"
            f" 1 % of the noise at {self.one_percent:.2g} Hz and by 100 % at"
            f" {10 * self.one_percent:.2g} Hz."
        )
        six = _SIX.format(radius=100 * self.radius)
        if self.n_sensors < MIN_SENSORS:
            text += (
                f" {self.n_sensors} sensors cannot tell gradients of the motion from noise; the"
                " model test can only warn. Put them closer together, or use six sensors:"
            )
        elif not math.isfinite(self.cost) or self.n_sensors < MIN_DETERMINED_SENSORS:
            text += (
                f" {self.n_sensors} sensors tell gradients of the motion from noise only if"
                " corresponding channels have equal noise, and no band is accepted. Put them closer"
                " together, or use six sensors:"
            )
        else:
            text += (
                f" --dimension auto takes gradients of the motion into account: the c.o.v. of one"
                f" frequency is then {self.cost:.2g}/√n at {_AT:g} Hz, for n averages."
            )
            if self.cost <= 1.1 * self.cost_of_six:
                return text
            text += " Six sensors are better:"
        return (
            f"{text} {six}. With them the c.o.v. of one frequency is {self.cost_of_six:.2g}/√n at"
            f" {_AT:g} Hz, for n averages."
        )


def waves_across(
    directions: FloatArray, dims: tuple[int, ...], positions: FloatArray | None, *, snr: float
) -> Waves | None:
    """Return what waves do to triaxial sensors; None for others.

    Parameters
    ----------
    directions : float64, shape (n_channels, 3)
        Direction cosines.
    dims : tuple of int
    positions : float64, shape (n_sensors, 3), optional
        Metres.
    snr : float
    """
    if set(dims) != {3} or len(dims) < 3 or directions.shape[1] != 3:
        return None
    n_sensors = len(dims)
    where = _ring(n_sensors, ASSUMED_RADIUS) if positions is None else positions[:, :2]
    where = where - where.mean(axis=0)
    radius = float(np.linalg.norm(where, axis=1).max())
    if not radius > 0:
        return None
    low = 0.01 * WAVES / radius  # Hz: long waves, where the bias grows with the square
    csm, _ = planning.crossed_csm(directions, where, snr=snr, wavelength=WAVES / low)
    found = self_noise("three-sensor", csm, dims=dims, n_effective=planning.REFERENCE)
    bias = float(np.nanmax(np.abs(found.noise_psd - 1)))
    turns = np.random.default_rng(6).standard_normal((6, 3, 3))
    six = np.vstack([np.linalg.qr(turn)[0] for turn in turns])
    around = np.concatenate([_ring(5, radius), np.zeros((1, 2))])

    def cost(of: FloatArray, stand: FloatArray) -> float:
        scene = planning.crossed_csm(of, stand, snr=snr, wavelength=WAVES / _AT)
        return planning.gradient_cost(*scene)

    return Waves(
        n_sensors=n_sensors,
        radius=radius,
        is_known=positions is not None,
        one_percent=low * math.sqrt(0.01 / bias),
        cost=cost(directions, where) if n_sensors >= MIN_DETERMINED_SENSORS else math.inf,
        cost_of_six=cost(six, around),
    )


def _ring(n_sensors: int, radius: float) -> FloatArray:
    bearing = 2 * np.pi * np.arange(n_sensors) / n_sensors
    return np.asarray(radius * np.column_stack([np.cos(bearing), np.sin(bearing)]))


YEAR = 365 * 86400.0  # s: nobody records for longer because the motion is weak


@dataclass(frozen=True, slots=True, eq=False)
class MethodPlan:
    """Needs of one method.

    Attributes
    ----------
    method : str
        Or "cramer-rao-bound", the bound of all unbiased methods.
    duration : float
        Length of the recording in seconds; NaN if the method has no estimate of a channel.
    n_segments : float
    bias : float64, shape (n_channels,)
        Bias that remains at any duration, as a fraction of the noise.
    efficiency : float64, shape (n_channels,)
        Share of this recording that the best possible estimate would need.
    is_motion_weak : bool
        Whether finding the motion takes longer than the precision requires.
    """

    method: str
    duration: float
    n_segments: float = field(metadata={"key": "segments"})
    bias: FloatArray
    efficiency: FloatArray
    is_motion_weak: bool = field(metadata={"key": "weak"})

    @classmethod
    def of(cls, entry: TimePlan) -> MethodPlan:
        """Return the plan for the channel that needs the longest duration."""
        return cls(
            entry.method,
            _worst(entry.duration),
            _worst(entry.n_segments),
            entry.bias[0],
            entry.efficiency[0],
            bool(entry.weak.any()),
        )


@dataclass(frozen=True, slots=True)
class Leakage:
    """What unequal responses leak into the noise at the edges of segments, without equalisation.

    Attributes
    ----------
    channel : str
        With its sensor: the one into which most leaks.
    frequency : float
        Where, in Hz.
    share : float
        Of its noise there.
    segment : float
        Seconds of a segment with which it would be 1 %.
    """

    channel: str
    frequency: float
    share: float
    segment: float


@dataclass(frozen=True, slots=True)
class Axes:
    """What motion across the axes of sensors with one or two channels leaves in doubt.

    Attributes
    ----------
    degrees : float
        By which axes may be off, rms.
    share : float
        Of the noise.
    n_sensors : int
        Sensors of as many channels that determine the motion in all dimensions.
    """

    degrees: float
    share: float
    n_sensors: int


@dataclass(frozen=True, eq=False, repr=False)
class RecordingPlan(Mapping[str, MethodPlan]):
    """What every method needs, as `huddle.plan` returns it: a `MethodPlan` by name of the method.

    Attributes
    ----------
    plans : mapping of str to MethodPlan
    snr, cov, lowest : float
        `lowest` is the lowest frequency of the band of interest, in Hz.
    settings : WelchSettings
    waves : Waves or None
        What waves across triaxial sensors do; None for others.
    leakage : Leakage or None
        What responses of the bench file that differ leak into the noise; None if they do not.
    axes : Axes or None
        What axes that are off leave in doubt; None where the sensors determine all dimensions.
    """

    plans: Mapping[str, MethodPlan]
    snr: float
    cov: float
    lowest: float
    settings: WelchSettings
    waves: Waves | None = None
    leakage: Leakage | None = None
    axes: Axes | None = None

    def __getitem__(self, method: str) -> MethodPlan:
        return self.plans[method]

    def __iter__(self) -> Iterator[str]:
        return iter(self.plans)

    def __len__(self) -> int:
        return len(self.plans)

    def __repr__(self) -> str:
        return rendered([self.title, self.table(), *self.remarks])

    @property
    def title(self) -> str:
        """What is planned."""
        segment = self.settings.segment_length / self.settings.sampling_rate
        return (
            f"Duration for a c.o.v. of {self.cov:g} in the worst third of an octave from"
            f" {self.lowest:.3g} Hz on, in every channel; motion {self.snr:g} × noise;"
            f" {format_duration(segment)} segments, {self.settings.window}:"
        )

    def table(self) -> Table:
        """Return the needs of every method as a table."""
        names = ("method", "duration", "segments", "remaining bias", "efficiency")
        return Table(names, tuple((entry.method, *_row(entry)) for entry in self.values()))

    @property
    def remarks(self) -> list[str]:
        """Remarks below the table."""
        plans = list(self.values())
        lines = []
        if plans[0].method.startswith("multi-part"):
            lines.append(
                "Two sensors tell noise from motion only where the motion changes: by so many dB"
                " (standard deviation of its level), in several steps, for example over the"
                " morning traffic. Their gains must be steady to 0.1 % a decade of loudness."
                " A third sensor needs no change."
            )
            return lines
        if any(entry.is_motion_weak for entry in plans):
            lines.append(
                "The motion is weak: finding it takes longer than the precision requires, and "
                "shorter recordings cannot be predicted. The data spectra themselves exceed the "
                f"noise by the motion, {percent(self.snr)} here."
            )
        if plans[0].duration < plans[-1].duration:
            lines.append(
                f"{plans[0].method} assumes known gains of the channels, the bound does not; so "
                "its duration can be shorter than that of the bound."
            )
        if self.waves is not None:
            lines.append(self.waves.sentences)
        if self.leakage is not None:
            found = self.leakage
            lines.append(
                f"Responses in the bench file differ. Equalised (--equalise auto), they do no harm;"
                f" otherwise motion leaks at the edges of segments: {percent(found.share)} of the"
                f" noise of {found.channel} at {found.frequency:.3g} Hz, 1 % with segments of"
                f" {format_duration(math.ceil(found.segment))}."
            )
        if self.axes is not None:
            axes = self.axes
            lines.append(
                f"Sensors of one or two channels feel motion across their axes. Axes that are"
                f" {axes.degrees:g}° off (rms) leave {percent(axes.share)} of the noise in"
                f" doubt. {axes.n_sensors} sensors determine this motion (--method auto);"
                " triaxial sensors do too. State axes that are better (--axis-tolerance)."
            )
        return lines


def plan_bench(path: Path, *, snr: float, cov: float) -> RecordingPlan:
    """Return the plan of a bench file; orientations come from its simulation table."""
    bench = load(path)
    settings = Settings.of(bench)
    dims = tuple(len(sensor.main) for sensor in bench.sensors)
    return _planned(
        _directions(bench),
        dims,
        settings,
        sampling_rate=bench.sampling_rate,
        snr=snr,
        cov=cov,
        leakage=_leakage(bench, settings, snr),
        positions=_positions(bench),
        names=[sensor.name for sensor in bench.sensors],
    )


def _positions(bench: Bench) -> FloatArray | None:
    """Return positions in metres, (n_sensors, 3): of the bench file, or as simulated."""
    known = [sensor.position for sensor in bench.sensors]
    if all(each is not None for each in known):
        return np.array(known, dtype=np.float64)
    if not bench.has_scenario:
        return None
    scenario = scenario_of(bench)
    found = np.array([scenario.sensors[sensor.name].position for sensor in bench.sensors])
    return found if found.any() else None


def _leakage(bench: Bench, settings: Settings, snr: float) -> Leakage | None:
    """Return what known responses that differ leak; None below 1 % of the noise."""
    channels = [
        (sensor.name, channel)
        for sensor in bench.sensors
        for channel in sensor.channels
        if not channel.auxiliary
    ]
    length = round(settings.segment * bench.sampling_rate)
    frequency = np.arange(1, length // 2) * bench.sampling_rate / length
    response = responses(frequency, channels, channels[0][1].unit)
    slopes = np.gradient(response, frequency, axis=0) / response
    usual = np.median(slopes.real, axis=1) + 1j * np.median(slopes.imag, axis=1)
    factor = slope_factor(get_window(settings.window, length), bench.sampling_rate)
    share = factor * snr * np.abs(slopes - usual[:, None]) ** 2
    place = np.unravel_index(int(np.argmax(share)), share.shape)
    most = float(share[place])
    if most < THRESHOLD:
        return None
    sensor, channel = channels[int(place[1])]
    return Leakage(
        channel=f"{sensor}.{channel.name}",
        frequency=float(frequency[place[0]]),
        share=most,
        segment=settings.segment * math.sqrt(most / THRESHOLD),
    )


def plan(
    bench: str | os.PathLike[str] | None = None,
    *,
    snr: float,
    cov: float = 0.05,
    fs: float | None = None,
    sensors: int = 3,
    channels: int = 3,
    segment: str | float | None = None,
    overlap: float | None = None,
    window: str | None = None,
    band: tuple[float, float] | None = None,
) -> RecordingPlan:
    """Compute the duration of recording for a target precision, by every method.

    Parameters
    ----------
    bench : path, optional
        Bench file with sensors, segments, and orientations if it has a simulation table. It
        replaces all parameters except `snr` and `cov`.
    snr : float
        Motion over noise, the mean over all channels.
    cov : float
        Target coefficient of variation of the noise PSD of every channel, in the worst third of an
        octave of the band.
    fs : float, optional
        Sampling rate in Hz.
    sensors, channels : int
        Number of sensors, and of channels of each.
    segment, overlap, window, band : optional
        As in `estimate`.

    Returns
    -------
    RecordingPlan

    Raises
    ------
    HuddleError
        If the bench file or an option is wrong.
    EstimatorError
        If nothing can be planned: one sensor, `snr` or `cov` not above 0.

    Examples
    --------
    >>> import huddle
    >>> plan = huddle.plan(snr=250, cov=0.05, fs=200, segment="10s")
    >>> round(plan["three-sensor"].duration / 60)
    88
    """
    options = {"segment": segment, "overlap": overlap, "window": window, "band": band}
    if bench is not None:
        given = [name for name, value in {"fs": fs, **options}.items() if value is not None]
        if given:
            raise WrongSettingError(f"{', '.join(given)}: expected in the bench file {bench}")
        return plan_bench(Path(bench), snr=snr, cov=cov)
    if fs is None or not 0 < fs < math.inf:
        raise WrongSettingError(f"fs={fs!r}: expected a sampling rate in Hz, above 0")
    for name, value in (("sensors", sensors), ("channels", channels)):
        if value < 1:
            raise WrongSettingError(f"{name}={value!r}: expected a number from 1")
    directions = np.vstack([np.eye(channels)] * sensors)
    settings = settings_of(Settings(), options)
    dims = (channels,) * sensors
    return _planned(directions, dims, settings, sampling_rate=fs, snr=snr, cov=cov)


def _planned(
    directions: FloatArray,
    dims: tuple[int, ...],
    settings: Settings,
    *,
    sampling_rate: float,
    snr: float,
    cov: float,
    leakage: Leakage | None = None,
    positions: FloatArray | None = None,
    names: Sequence[str] = (),
) -> RecordingPlan:
    welch = WelchSettings(
        sampling_rate=sampling_rate,
        segment_length=round(settings.segment * sampling_rate),
        overlap=settings.overlap,
        window=settings.window,
    )
    csm, noise = planning.planned_csm(directions, snr=snr)
    low, high = settings.band or (welch.frequencies[1], 0.9 * welch.frequencies[-1])
    of_bin = cov * math.sqrt(_worth_of_worst(welch, settings, low, high))
    found = planning.plan(csm, noise, dims=dims, settings=welch, cov=of_bin)
    plans = map(MethodPlan.of, found)
    return RecordingPlan(
        {each.method: each for each in plans},
        snr=snr,
        cov=cov,
        lowest=float(low),
        settings=welch,
        waves=waves_across(directions, dims, positions, snr=snr),
        leakage=leakage,
        axes=_axes(dims, names or [""] * len(dims), settings, snr),
    )


def _worth_of_worst(welch: WelchSettings, settings: Settings, low: float, high: float) -> float:
    """Return how many independent frequencies the narrowest third of an octave is worth."""
    bins = np.diff(third_octaves(welch.frequencies, low, high))
    if not bins.size:
        raise WrongSettingError(f"band {low:g} to {high:g} Hz: no frequency lies in it")
    least = int(bins.min())
    return float(worth(least, correlation_of(settings))[least])


def _axes(
    dims: tuple[int, ...], names: Sequence[str], settings: Settings, snr: float
) -> Axes | None:
    """Return what axes that are off leave in doubt; None below 1 % of the noise."""
    tolerances = settings.axis_tolerances(names, dims)
    share = snr * max(settings.across_axes(names, dims), default=0.0)
    if share < THRESHOLD or settings.for_sensors(dims).dimension == "auto":
        return None
    each = min(dims)
    enough = ROOM_OF_ONE_CHANNEL if each == 1 else ROOM
    return Axes(math.degrees(max(tolerances)), share, enough)


def _directions(bench: Bench) -> FloatArray:
    """Return the directions of the channels: as simulated, or along common axes."""
    if bench.has_scenario:
        scenario = scenario_of(bench)
        return np.vstack([scenario.directions(sensor.name) for sensor in bench.sensors])
    most = max(len(sensor.main) for sensor in bench.sensors)
    return np.vstack([np.eye(most)[: len(sensor.main)] for sensor in bench.sensors])


def _worst(values: FloatArray) -> float:
    return float(np.max(values)) if np.isfinite(values).all() else float("nan")


def _row(entry: MethodPlan) -> tuple[str, str, str, str]:
    if np.isnan(entry.duration):
        return "no estimate", "", "", ""
    if entry.is_motion_weak and entry.duration > YEAR:
        return "motion too weak", "", "", ""
    low, high = float(entry.bias.min()), float(entry.bias.max())
    none = max(-low, high) < 1e-3
    efficiency = float(entry.efficiency.min())
    return (
        format_duration(entry.duration),
        f"{entry.n_segments:.0f}",
        "none" if none else f"{signed(low, '+.0%')} to {signed(high, '+.0%')}",
        f"{efficiency:.0%}" if none and np.isfinite(efficiency) else "",
    )
