"""Estimates from arrays and from recordings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, Unpack

from daq.bench.option_values import LEAST_SENSORS
from daq.bench.units import is_motion
from daq.errors import ArrayError, WrongSettingError
from daq.estimation.estimation import Estimation
from daq.estimation.settings import Settings, check_fit
from daq.formats.arrays import COUNTS, attached_responses, recording_of_arrays
from daq.formats.memory import RecordingInMemory
from daq.recording.reader import Recording
from tui.notebook.options import EstimateOptions, Time, called, moment, settings_of
from tui.notebook.result import Result

if TYPE_CHECKING:
    from daq.bench.channel import Channel
    from daq.formats.response import Responses
    from daq.recording.interface import ReadableRecording, ReadableSensor

PathLike: TypeAlias = "str | os.PathLike[str]"
Response: TypeAlias = "PathLike | Any"
"""A file or folder of responses, an Inventory or Response of ObsPy, or poles and zeros."""


def self_noise(
    sensors: object,
    fs: float | Mapping[str, float] | None = None,
    *,
    channels: Sequence[str] | None = None,
    sample_unit: str | None = None,
    response: Response | Sequence[Response] | Mapping[str, Response | Sequence[Response]] = None,
    **options: Unpack[EstimateOptions],
) -> Result:
    """Estimate the self-noise of every channel from samples in memory.

    The numbers are those of ``huddle estimate`` on a recording of the same samples, to the bit.

    Parameters
    ----------
    sensors : mapping of str to array, array, DataArray, DataFrame or ObsPy Stream
        What `huddle.read` returns; or samples of each sensor by its name: an array of shape
        (n_samples, n_channels) or (n_samples,), of integers or floats; an xarray DataArray with the
        dimension ``time``; a pandas DataFrame or Series, whose DatetimeIndex says the times; an
        ObsPy Stream or Trace.
        Or all sensors in one: an array of shape (n_sensors, n_samples, n_channels); a DataArray
        with the dimensions ``sensor``, ``time`` and channel; a DataFrame with columns of two
        levels, sensor and channel; an ObsPy Stream, with one sensor for each network, station and
        location. The attribute ``units`` is read in any spelling, ``m s-2`` of the CF conventions
        among them. Samples that are NaN or infinite are gaps: the segments that they touch are left
        out.
    fs : float or mapping of str to float, optional
        Sampling rate in Hz, of all sensors or of each. Not needed where the samples have times.
    channels : sequence of str, optional
        Names of the channels, the same for every sensor, as in ``"XYZ"``.
    sample_unit : str, optional
        Unit of the samples. Where not given: what DataArrays and Streams say (of a Stream, what
        ``remove_response`` left), else counts.
    response : path, Inventory, Response, sequence or mapping of them, optional
        Responses that turn counts into motion: RESP, StationXML or SACPZ files, folders of them, or
        inventories of ObsPy, each for the channels of its codes; a Response of ObsPy, or its
        dictionary of poles, zeros, gain and sensitivity (of velocity, unless ``input_units`` says
        other), for all. By default those attached to the traces of a Stream. In a mapping, each is
        for the channels whose
        ``network.station.location.channel``, sensor or channel fits a pattern. A sensor and its
        digitizer may be two.
    **options
        Options of the estimate: those of `estimate`.

    Returns
    -------
    Result

    Raises
    ------
    HuddleError
        If samples or options are wrong, or do not fit together. Also a `ValueError`.
    EstimatorError
        If the samples are too few for any estimate. Also a `ValueError`.

    Examples
    --------
    >>> import huddle
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> motion = rng.standard_normal((60_000, 3))
    >>> noise = {name: 0.1 * rng.standard_normal((60_000, 3)) for name in "ABC"}
    >>> result = huddle.self_noise(
    ...     {name: motion + noise[name] for name in "ABC"}, fs=200, channels="XYZ", segment="2s"
    ... )
    >>> result.n_segments, result.frequency.shape, result.noise_psd.shape
    (299, (201,), (201, 9))

    The noise is white: its PSD is its variance over half the sampling rate, 0.1²/100 = 1e-4.

    >>> result.band(10, 90).noise_db.round().tolist()
    [-40.0, -40.0, -40.0, -40.0, -40.0, -40.0, -40.0, -40.0, -40.0]
    >>> result["A", "X"].noise_psd.shape
    (201,)
    """
    settings = settings_of(Settings(), options)
    if response is None and sample_unit is None:
        response = attached_responses(sensors) or None
    if response is not None and sample_unit is not None:
        raise ArrayError(
            f"sample_unit={sample_unit!r} and a response: samples with a unit have no response;"
            " expected one of the two"
        )
    recording = getattr(sensors, "recording", None)  # of huddle.read
    if not isinstance(recording, RecordingInMemory):
        recording = recording_of_arrays(
            sensors, fs, channels=channels, unit=sample_unit, responses=_responses(response)
        )
    elif any(given is not None for given in (fs, channels, sample_unit, response)):
        raise ArrayError(
            "fs, channels, sample_unit or response with what huddle.read returned; expected them"
            " as arguments of huddle.read"
        )
    _check_sensors(recording.sensors, settings)
    _check_units(recording.sensors, settings)
    check_fit(settings, recording.sensors, called=called)
    with Estimation([recording], settings) as estimation:
        return Result(estimation.finish(), settings, recorded=_recorded(recording))


def estimate(
    recordings: PathLike | Iterable[PathLike],
    *,
    start: Time | None = None,
    end: Time | None = None,
    **options: Unpack[EstimateOptions],
) -> Result:
    """Estimate the self-noise of every channel from one recording or several.

    Parameters
    ----------
    recordings : path or iterable of paths
        Several recordings of the same sensors are estimated together.
    start, end : str, float or datetime, optional
        Span to estimate: UTC, as a datetime or a text such as ``2026-11-21T03:00:00``, or a time
        after the start of the recording, in seconds or as a text such as ``2h``.
    **options
        Options of the estimate, below. Defaults come from the bench file in the recording.

    Other Parameters
    ----------------
    method : str or sequence of str
        ``"auto"`` (default), ``"three-sensor"``, ``"two-channel"``, ``"three-channel"``,
        ``"maximum-likelihood"``, ``"multi-part"``, or ``"all"`` that apply. ``"auto"`` is maximum
        likelihood with as many dimensions of the motion as the data show where the sensors leave
        room for them (four with two or three channels, six with one), else three-sensor with
        levels by maximum likelihood; of two sensors it is multi-part.
    segment : str or float
        Length of a segment in seconds, or as in ``"10s"`` (default) or ``"2min"``. It sets the
        frequency resolution.
    overlap : float
        Overlap between consecutive segments, as a fraction of their length (default 0.5).
    window : str or tuple
        Window of each segment: ``"hann"`` (default), ``"blackman"``, ``"kaiser,8"``, …; or a tuple
        as scipy takes it, ``("kaiser", 8)``.
    detrend : str
        Trend removed from each segment: ``"none"``, ``"constant"`` (default) or ``"linear"``.
    correct : bool
        Whether to correct the bias of few averages (default True).
    clocks : str
        Time of samples: from arrival times, refined by the common motion (``"refined"``, default);
        from arrival times alone (``"arrivals"``); from the nominal rates (``"nominal"``).
    equalise : str
        Filters that give all sensors one response before the window: by poles and zeros
        (``"known"``), by the averages (``"estimated"``), where it matters (``"auto"``, default),
        or none (``"off"``).
    reject : bool
        Whether to exclude segments with transients also. Clipped segments are excluded unless this
        is False.
    bridge : float
        Share of a segment that gaps may take, where fewer than half of the segments have none
        (default 0.6).
    octaves : bool
        Whether each octave has its own segment length: `segment` in the top octave, doubled in each
        octave below.
    dimension : int or str
        Dimensions of the common motion for maximum likelihood: a number, or ``"auto"``.
    gains : mapping of str to float
        Response of a sensor (``{"B": 1.02}``) or a channel (``{"B.X": 1.02}``) relative to the
        others, for the two-channel method.
    sampling_rates : mapping of str to float
        Rate in Hz at which a sensor sampled (``{"B": 100.9}``), in place of the recorded one.
    axis_tolerance : float or mapping of str to float
        Angle in degrees, rms, by which axes of sensors with one or two channels may be off
        (default 1), of all or by sensor. Motion across an axis widens the intervals.
    exclude : sequence of str
        Stretches of time of which no segment is used: two instants in UTC, or two times after the
        start of the recording (``["0s/60s"]``).
    linearise : bool
        Whether what squares and cubes of the motion explain is subtracted from the noise.
    gain_steadiness : float
        Change of a gain in percent, for motion of ten times the power, that the method multi-part
        allows for (default 0.1).
    shared_noise : sequence of (str, str)
        Pairs of three or more sensors whose noise may be shared (``[("A", "B")]``), for the method
        multi-part.
    lean : mapping of str to (float, float)
        Known lean of a sensor with one or two channels, in degrees: of its axis or plane, towards
        two directions that all sensors have in common (``{"B": (0.3, -0.1)}``).
    unit : str
        Unit of the motion, such as ``"m/s²"``; spectra are in its square per Hz.
    band : (float, float)
        Band of interest in Hz: of `Result.band`, and of the effect of clocks.
    target_cov : float
        Wanted coefficient of variation of the noise in the worst third of an octave of the band.
    target_cov_bin : float
        The same at single frequencies, in place of `target_cov`.

    Returns
    -------
    Result

    Raises
    ------
    HuddleError
        If a recording cannot be read, or options are wrong or do not fit it.
    EstimatorError
        If the recordings are too short for any estimate.

    Examples
    --------
    >>> import huddle
    >>> huddle.simulate("fig9", duration="2min").write("floor.h5")
    >>> result = huddle.estimate("floor.h5", method="all", segment="4s", start="20s")
    >>> result.methods
    ('three-sensor', 'two-channel', 'three-channel', 'maximum-likelihood', 'multi-part')
    >>> result.unit
    'm/s²'
    """
    return estimated(recordings, start=start, end=end, **options)


def estimated(
    recordings: PathLike | Iterable[PathLike],
    *,
    start: Time | None = None,
    end: Time | None = None,
    calibrates: bool = False,
    **options: Unpack[EstimateOptions],
) -> Result:
    """Return what `estimate` does; `calibrates` is that of `Settings`."""
    if isinstance(recordings, (str, os.PathLike)):
        recordings = [recordings]
    if not isinstance(recordings, Iterable):
        raise WrongSettingError(f"recordings={recordings!r}: expected a path, or several")
    paths = [Path(path) for path in recordings]
    if not paths:
        raise WrongSettingError("recordings=[]: expected at least one path")
    with Recording.open(paths[0]) as recording:
        bench = recording.bench
        settings = settings_of(Settings.of(bench), options)
        check_fit(settings, recording.sensors, called=called)
        created, recorded = recording.created, _recorded(recording)
    settings = replace(
        settings,
        start=moment("start", start, created),
        end=moment("end", end, created),
        calibrates=calibrates,
    )
    with Estimation(paths, settings) as estimation:
        return Result(estimation.finish(), settings, bench, paths, recorded)


def _recorded(recording: ReadableRecording) -> dict[str, Channel]:
    """Return what each channel is, by its name with that of its sensor."""
    return {
        f"{sensor.name}.{channel.name}": channel
        for sensor in recording.sensors
        for channel in sensor.channels
    }


def response_sources(given: object) -> tuple[list[Any], list[tuple[str, Any]]]:
    """Return responses for the channels of their codes, and those with patterns."""
    if given is None:
        return [], []
    if isinstance(given, dict) and "poles" not in given:
        return [], [(name, each) for name, value in given.items() for each in _sources(value)]
    return _sources(given), []


def _responses(given: object) -> Responses | None:
    """Return responses as the import takes them.

    Raises
    ------
    ImportFormatError
        ObsPy is not installed, or a file holds no response.
    """
    some, assigned = response_sources(given)
    if not some and not assigned:
        return None
    from daq.formats.response import Responses  # noqa: PLC0415 - ObsPy is an extra

    return Responses(some, assigned)


def _sources(given: Any) -> list[Any]:  # noqa: ANN401 - paths, or inventories: ObsPy has no types
    several = given if isinstance(given, (list, tuple)) else [given]
    return [Path(each) if isinstance(each, (str, os.PathLike)) else each for each in several]


def _check_units(sensors: Sequence[ReadableSensor], settings: Settings) -> None:
    """Refuse to call counts motion.

    Raises
    ------
    ArrayError
        With the channel whose samples are counts.
    """
    if settings.unit is None or not is_motion(settings.unit):
        return
    for sensor in sensors:
        for channel in sensor.channels:
            if channel.unit == COUNTS:
                raise ArrayError(
                    f"unit={settings.unit!r}: the samples of {sensor.name}.{channel.name} are"
                    " counts, as nothing says what they measure; expected response= (files, or an"
                    " ObsPy Inventory), or sample_unit= where they are in a unit of motion"
                )


def _check_sensors(sensors: Sequence[ReadableSensor], settings: Settings) -> None:
    """Refuse what can give no estimate, in the words of whoever passes arrays.

    Raises
    ------
    ArrayError
        With the sensors, or the segment, that there are.
    """
    least = min(LEAST_SENSORS.get(method, 3) for method in settings.methods)
    if len(sensors) < least:
        names = ", ".join(sensor.name for sensor in sensors)
        method = settings.for_sensors((1,) * len(sensors)).methods[0]
        way_out = ", or method='two-channel' where they are alike" if len(sensors) == 2 else ""
        raise ArrayError(
            f"{len(sensors)} sensor{'s' if len(sensors) > 1 else ''} ({names}):"
            f" {method} takes at least {least}; expected more sensors{way_out}"
        )
    longest = min(sensor.n_samples / sensor.sampling_rate for sensor in sensors)
    if settings.segment > longest:
        raise ArrayError(
            f"segment={settings.segment:g} s: longer than the {longest:g} s of samples; expected"
            " shorter segments: tens of them give an estimate"
        )
