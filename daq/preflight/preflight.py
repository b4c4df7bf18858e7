"""The check list before a test, from some seconds of samples: one function for every command.

How sensors stand, from some seconds of their samples: gravity, and the motion that they share.

Two sensors in one motion differ by a rotation, whatever their directions: ``y = R x``. Channels
that have traded places, or a reversed one, make a reflection of it, which no way to turn a sensor
does. Which of several sensors is reflected, the others say.
"""

from __future__ import annotations

import itertools
import math
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import STANDARD_GRAVITY, in_acceleration, order_of
from daq.devices.registry import driver_type
from daq.errors import WrongDeviceError
from daq.preflight.common_motion import MIN_RATE, RelativeResponses, main_samples, to_acceleration
from daq.preflight.findings import Check, CheckFinding, CheckRow, Problem
from daq.recorder.device_identity import check_identity
from estimator.checks.sensitivities import wrong_gains

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daq.bench.channel import Channel
    from daq.bench.model import Bench
    from daq.preflight.preview import SensorPreview
    from estimator.types import FloatArray


LOW_CORRELATION, HIGH_CORRELATION = 0.35, 0.7
"""Correlation below which a sensor moves by itself, and from which on two others move together.

Of 10 s of independent motion, the largest of all lags and channels is 0.28 in the median, 0.35 in
one of 60."""
SLOW = 10.0
"""Hz up to which sensors are correlated: their clocks differ by milliseconds."""
MIN_OFFSET = 0.5
"""Difference in m/s² from gravity, and from none, that is called an offset."""
ALONG = 0.8
"""Part of a direction from which on it is that of one channel."""
MAX_LAG = 2.0
"""Seconds by which the samples of one sensor may arrive later than those of another one."""
FINE = 4
"""Lags in a row of `SLOW` motion: at half a row, its fastest part is lost."""
SOME_CORRELATION = 0.5
"""Correlation with another sensor from which on a sensor shares motion."""


def gravity(each: SensorPreview) -> Iterator[CheckFinding]:
    """Yield an offset, and a vertical channel that does not feel gravity where another one does."""
    channels, means = each.sensor.channels, each.samples.mean(axis=0)
    factors = [in_acceleration(channel.unit) for channel in channels]
    main = [n for n in _moving(each) if factors[n] is not None]
    if not main or each.is_clipping:
        return
    felt = np.array([means[n] * (factors[n] or 0.0) for n in main])
    most = float(np.linalg.norm(felt))
    is_whole = len(main) >= 3
    too_little = is_whole and MIN_OFFSET < most < STANDARD_GRAVITY - MIN_OFFSET
    if too_little or most > STANDARD_GRAVITY + MIN_OFFSET:
        yield CheckFinding(Problem.OFFSET, each.sensor.name, value=most)
        return
    up = [n for n in main if _is_vertical(channels[n])]
    strongest = main[int(np.argmax(np.abs(felt)))]
    is_elsewhere = np.abs(felt).max() > ALONG * most and up not in ([], [strongest])
    if is_whole and most > MIN_OFFSET and is_elsewhere:
        both = f"{channels[up[0]].name} and {channels[strongest].name}"
        yield CheckFinding(Problem.SWAPPED, each.sensor.name, both)


def _moving(each: SensorPreview) -> list[int]:
    """Return the places of the channels that take part and are not dead."""
    return [n for n in each.sensor.main if np.ptp(each.samples[:, n]) > 0]


def _is_vertical(channel: Channel) -> bool:
    return (channel.direction or "").lower() in {"up", "down", "vertical", "z"}


def strongest_correlations(able: Sequence[SensorPreview]) -> tuple[FloatArray, FloatArray]:
    """Return the correlation of the channels of two sensors that move most alike, and their lag.

    The time of a last sample is when it arrived: one device sends each sample, another one packets.

    Parameters
    ----------
    able : sequence of SensorPreview
        With enough samples.

    Returns
    -------
    strongest, lags : float64, shape (n_sensors, n_sensors)
        At any lag up to `MAX_LAG`, and by how many seconds the first sensor is later. Zero on the
        diagonal.
    """
    end_ns = min(each.last_ns for each in able)
    slow = [_slow(each, end_ns) for each in able]
    n_rows = min(len(rows) for rows in slow)
    spectra = [np.fft.rfft(_normal(rows[-n_rows:]), 2 * n_rows, axis=0) for rows in slow]
    most = FINE * min(round(MAX_LAG * 2 * SLOW), n_rows // 4)
    late = np.arange(-most, most + 1)
    strongest, lags = np.zeros((2, len(able), len(able)))
    for i, j in itertools.combinations(range(len(able)), 2):
        if spectra[i].shape[1] and spectra[j].shape[1]:
            cross = spectra[i][:, :, None] * spectra[j][:, None].conj()
            at_lags = FINE * np.fft.irfft(cross, 2 * FINE * n_rows, axis=0)[late]
            at_lags = np.abs(at_lags).max(axis=(1, 2))
            best = int(at_lags.argmax())
            strongest[i, j] = strongest[j, i] = at_lags[best]
            lags[i, j] = late[best] / (2 * SLOW * FINE)
            lags[j, i] = -lags[i, j]
    return strongest, lags


def _normal(rows: FloatArray) -> FloatArray:
    """Return the columns without their means, each of length 1."""
    rows = rows - rows.mean(axis=0)
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny))


def in_step(able: Sequence[SensorPreview]) -> list[SensorPreview]:
    """Return the sensors with the times of their last samples as the shared motion shows them."""
    if len(able) < 2:
        return list(able)
    strongest, lags = strongest_correlations(able)
    found = [able[0]]
    for i in range(1, len(able)):
        j = int(strongest[i, :i].argmax())
        late = lags[i, j] if strongest[i, j] >= SOME_CORRELATION else 0.0
        shift_ns = found[j].last_ns - able[j].last_ns - round(late * 1e9)
        found.append(replace(able[i], last_ns=able[i].last_ns + shift_ns))
    return found


def alone(able: Sequence[SensorPreview]) -> Iterator[CheckFinding]:
    """Yield the sensors that share no motion where others do, and those of which that is unsure."""
    if len(able) < 3:
        yield CheckFinding(Problem.TOO_FEW_SENSORS)
        return
    strongest, _ = strongest_correlations(able)
    for i, each in enumerate(able):
        others = np.delete(np.delete(strongest, i, 0), i, 1)
        most = float(strongest[i].max())
        if most < LOW_CORRELATION and others.max() >= HIGH_CORRELATION:
            yield CheckFinding(Problem.ALONE, each.sensor.name, value=most)
        elif most < SOME_CORRELATION:
            yield CheckFinding(Problem.NOT_COMPARABLE, each.sensor.name)


def wrong_polarity(motion: RelativeResponses) -> Iterator[CheckFinding]:
    """Yield the sensors whose motion is a reflection of that of all others, which agree."""
    places = range(len(motion.sensors))
    if len(places) < 3:
        yield CheckFinding(Problem.TOO_FEW_SENSORS)
        return
    turns = {(i, j): motion.turn(i, j) for i in places for j in places if i != j}
    hands = {
        pair: 0.0 if turn is None else float(np.sign(np.linalg.det(turn)))
        for pair, turn in turns.items()
    }
    for j in places:
        each = motion.sensors[j]
        seen = [turn for i in places if i != j and (turn := turns[i, j]) is not None]
        if not seen:
            yield CheckFinding(Problem.NOT_COMPARABLE, each.sensor.name)
            continue
        if len(seen) < 2 or not all(hands[i, j] <= 0 for i in places if i != j):
            continue
        among = [hands[i, k] for i in places for k in places if i != k and j not in (i, k)]
        if among and min(among) >= 0 and max(among) > 0:
            yield _what_is_reflected(each, seen)


def _what_is_reflected(each: SensorPreview, seen: Sequence[NDArray[np.float64]]) -> CheckFinding:
    """Return which channels have traded places, or which one is reversed.

    That is what is seen where the sensors point alike. Where they do not, only the reflection is.
    """
    name = each.sensor.name
    names = [channel.name for channel in each.sensor.main.values()]
    d = len(names)
    for a, b in itertools.combinations(range(d), 2):
        order = list(range(d))
        order[a], order[b] = b, a
        if all(turn[range(d), order].min() > ALONG for turn in seen):
            return CheckFinding(Problem.SWAPPED, name, f"{names[a]} and {names[b]}")
    for c in range(d):
        signs = np.where(np.arange(d) == c, -1, 1)
        if all((np.diag(turn) * signs).min() > ALONG for turn in seen):
            return CheckFinding(Problem.REVERSED, name, names[c])
    return CheckFinding(Problem.REFLECTED, name)


def _slow(each: SensorPreview, end_ns: int) -> NDArray[np.float64]:
    """Return the motion below `SLOW` of a sensor's live channels, at 2 `SLOW` rows a second.

    It is the change of acceleration. The last row is at `end_ns`: rows of all sensors are of the
    same moments.
    """
    per_row = each.sensor.sampling_rate / (2 * SLOW)
    main = _moving(each)
    values = each.samples[:, main]
    end = len(values) - max(0.0, (each.last_ns - end_ns) * 1e-9 * each.sensor.sampling_rate)
    edges = end - per_row * np.arange(int(end / per_row), -1, -1)
    sums = np.concatenate([np.zeros((1, len(main))), np.cumsum(values, axis=0)])
    whole = np.minimum(edges.astype(int), len(values) - 1)
    rows = np.diff(sums[whole] + (edges - whole)[:, None] * values[whole], axis=0) / per_row
    for column, channel in enumerate(main):
        for _ in range(2 - order_of(each.sensor.channels[channel].unit)):
            rows[:, column] = np.gradient(rows[:, column])
    return np.asarray(np.diff(rows, axis=0))


MIN_SECONDS = 4.0
"""Seconds of samples that the checks need."""
MIN_SAMPLES = 8
"""Samples without which nothing can be said of a channel, however slow its sensor is."""
RATE_ERROR = 0.02
"""Difference from the sampling rate of the bench file, as a fraction, from which on it is wrong."""
MAINS = (50.0, 60.0)
"""Frequencies of mains in Hz."""
HUM_SHARE, HUM_RATIO = 0.5, 4.0
"""Share of a channel's power above 1 Hz at a frequency of mains from which on it may hum; power
there over that of the other sensors, the median, from which on it does."""
CLOCK_ERROR, SIGNIFICANCE = 1e-3, 4.0
"""Difference of a rate, as a fraction, from which on the clock is poor; standard errors it takes.
"""
UNEVEN = 0.1
"""Standard deviation of arrival times in s from which on clocks are hard to compare."""
MAX_JITTER = 0.1
"""Standard deviation of the instants of polled samples, in sampling intervals, from which on they
do not show gains at high frequencies."""
MISSING_SHARE = 0.01
"""Share of missing samples from which on a port is bad."""
NEAR = 0.9
"""Share of the full scale from which on a channel may clip in a test."""
OF_CHANNELS = {
    Problem.DEAD,
    Problem.WRAPPING,
    Problem.HUM,
    Problem.NEAR_FULL_SCALE,
    Problem.SENSITIVITY,
}
"""Problems that all channels of a sensor have for one cause."""
MOOT = {Problem.TOO_FEW_SENSORS}
"""Problems that a sensor which sends nothing causes in checks of the others."""
ALIKE = 1.05
"""Largest over smallest value of the channels of a sensor up to which they have one cause."""
BYTES_PER_VALUE = 4
"""Of a count on the disk, before compression."""
OPEN_END = 3600.0
"""Seconds of a recording without a duration that the disk must have room for."""


def is_complete(sensors: Sequence[SensorPreview]) -> bool:
    """Return whether each sensor has enough samples, or a reason why it has none."""
    return all(each.trouble or _has_enough(each) for each in sensors)


def check_list(
    bench: Bench, sensors: Sequence[SensorPreview], *, duration: float | None = None
) -> tuple[CheckRow, ...]:
    """Return the check list of a bench: a row for each finding, or one for a check without any.

    Parameters
    ----------
    bench : Bench
        For the place of its recordings.
    sensors : sequence of SensorPreview
        In the order of the bench file.
    duration : float, optional
        Of the recording in s; default: that of the bench file.
    """
    heard = [each for each in sensors if not each.trouble and len(each.samples)]
    able = [each for each in heard if _has_enough(each)]
    fast = in_step([each for each in able if each.sensor.sampling_rate >= MIN_RATE])
    blurred = [each for each in fast if each.is_polled and _jitter(each) > MAX_JITTER]
    motion = RelativeResponses.of(
        [
            each
            for each in fast
            if (np.ptp(main_samples(each), axis=0) > 0).all() and each not in blurred
        ]
    )
    waiting = [_of(Problem.TOO_FEW_SAMPLES, each) for each in heard if each not in able]
    slow = [_of(Problem.TOO_SLOW, e) for e in able if e.sensor.sampling_rate < MIN_RATE]
    left_out = [*waiting, *slow]
    left_out += [_of(Problem.UNEVEN, each, each.arrival_scatter) for each in blurred]
    at_rest = [one for each in able for one in gravity(each)]
    found: dict[Check, list[CheckFinding]] = {
        Check.PORTS: [one for each in sensors for one in _port(each)],
        Check.IDENTITY: [one for each in sensors for one in _identity(each)],
        Check.RATES: [one for each in heard for one in _rate(each)],
        Check.CHANNELS: [
            *(one for each in able for one in (*_dead(each), *_repeats(each))),
            *waiting,
        ],
        Check.LEVELS: [*(one for each in able for one in _levels(each)), *waiting],
        Check.HUM: [*_hum(able), *waiting],
        Check.MOTION: [*alone(fast), *waiting, *slow],
        Check.SENSITIVITIES: [
            *_sensitivities(motion),
            *(one for one in at_rest if one.problem is Problem.OFFSET),
            *left_out,
        ],
        Check.POLARITY: [*wrong_polarity(motion), *left_out],
        Check.CLOCKS: [one for each in heard for one in _clock(each)],
        Check.DISK: list(_disk(bench, duration)),
    }
    polarity = found[Check.POLARITY]
    polarity += [
        one
        for one in at_rest
        if one.problem is Problem.SWAPPED and one.sensor not in {known.sensor for known in polarity}
    ]
    if len(heard) < len(sensors):
        moot = [
            check
            for check, several in found.items()
            if check not in {Check.PORTS, Check.DISK}
            and (not (heard or several) or any(one.problem in MOOT for one in several))
        ]
        found = {check: several for check, several in found.items() if check not in moot}
        found[Check.PORTS] += [
            CheckFinding(Problem.LEFT_OUT, each.sensor.name, text=", ".join(moot))
            for each in sensors
            if each not in heard
        ]
    return tuple(
        row
        for check, several in found.items()
        for row in (
            [CheckRow(check, one) for one in _together(several, sensors)] or [CheckRow(check)]
        )
    )


def _together(
    found: Sequence[CheckFinding], sensors: Sequence[SensorPreview]
) -> Iterator[CheckFinding]:
    """Yield findings, those of all channels of a sensor as one: one cause, one row."""
    channels = {e.sensor.name: [c.name for c in e.sensor.main.values()] for e in sensors}
    for each in found:
        main = channels.get(each.sensor, [])
        alike = [
            one
            for one in found
            if (one.problem, one.sensor, one.against) == (each.problem, each.sensor, each.against)
            and one.channel in main
        ]
        values = [one.value for one in alike]
        is_one = (
            len(main) > 1
            and sorted(one.channel for one in alike) == sorted(main)
            and (all(map(math.isnan, values)) or max(values) <= ALIKE * min(values))
        )
        if each.problem not in OF_CHANNELS or not is_one or each.channel not in main:
            yield each
        elif each is alike[0]:
            yield replace(each, channel="", value=float(np.median(values)))


def _of(problem: Problem, each: SensorPreview, value: float = math.nan) -> CheckFinding:
    return CheckFinding(problem, each.sensor.name, value=value)


def _has_enough(each: SensorPreview) -> bool:
    return len(each.samples) >= max(MIN_SAMPLES, MIN_SECONDS * each.sensor.sampling_rate)


def _is_wrong_device(each: SensorPreview) -> bool:
    if each.information is None or each.information.trouble:
        return False
    try:
        check_identity(each.sensor, each.information)
    except WrongDeviceError:
        return True
    return False


def _port(each: SensorPreview) -> Iterator[CheckFinding]:
    if each.trouble and not _is_wrong_device(each):
        yield CheckFinding(Problem.TROUBLE, each.sensor.name, text=each.trouble)
    elif len(each.samples) == 0 and not each.trouble:
        yield _of(Problem.NO_SAMPLES, each)


def _identity(each: SensorPreview) -> Iterator[CheckFinding]:
    if each.information is None:
        return  # a problem of the port
    if _is_wrong_device(each):
        yield CheckFinding(Problem.WRONG_DEVICE, each.sensor.name, text=each.trouble)
    elif not each.information.serial_number:
        yield _of(Problem.NO_SERIAL_NUMBER, each)
    elif not each.sensor.serial_number:
        yield _of(Problem.NOT_IN_FILE, each)


def _rate(each: SensorPreview) -> Iterator[CheckFinding]:
    rate, n_samples = each.sensor.sampling_rate, len(each.samples)
    if each.trouble or not n_samples:
        yield _of(Problem.TOO_FEW_SAMPLES, each)
        return
    off = abs((each.measured_rate or math.nan) / rate - 1)
    is_another = _is_off(each) or off > max(RATE_ERROR, SIGNIFICANCE * each.rate_error)
    if is_another and each.measured_rate is not None:
        yield replace(_of(Problem.RATE, each, each.measured_rate), wanted=rate)
    elif each.measured_rate is None or SIGNIFICANCE * each.rate_error > RATE_ERROR:
        yield _of(Problem.UNEVEN, each, each.arrival_scatter)
    if each.n_missing > MISSING_SHARE * (n_samples + each.n_missing):
        yield _of(Problem.MISSING, each, each.n_missing)
    elif not each.is_counted and not is_another:
        yield _of(Problem.UNCOUNTED, each)


def _jitter(each: SensorPreview) -> float:
    """Return the standard deviation of arrival times in sampling intervals."""
    return each.arrival_scatter * each.sensor.sampling_rate


def _clock_error(each: SensorPreview) -> tuple[float, float]:
    """Return by how much the clock is off, as a fraction, and the standard error of that."""
    seconds = len(each.samples) / each.sensor.sampling_rate
    off = (each.measured_rate or math.nan) / each.sensor.sampling_rate - 1
    return off, max(each.rate_error, each.arrival_scatter / seconds)


def _is_off(each: SensorPreview) -> bool:
    """Whether the clock is off by more than that of any oscillator: the rate is another one."""
    off, error = _clock_error(each)
    return each.arrival_scatter <= UNEVEN and abs(off) > max(CLOCK_ERROR, SIGNIFICANCE * error)


def _clock(each: SensorPreview) -> Iterator[CheckFinding]:
    if each.measured_rate is None or each.arrival_scatter > UNEVEN:
        yield _of(Problem.UNEVEN, each, each.arrival_scatter)
        return
    off, error = _clock_error(each)
    if _is_off(each) and abs(off) <= RATE_ERROR:
        yield _of(Problem.CLOCK, each, off * 1e6)
    elif SIGNIFICANCE * error > RATE_ERROR:
        yield _of(Problem.UNEVEN, each, each.arrival_scatter)


def _dead(each: SensorPreview) -> Iterator[CheckFinding]:
    for n, channel in each.sensor.main.items():
        if np.ptp(each.samples[:, n]) == 0:
            yield CheckFinding(Problem.DEAD, each.sensor.name, channel.name)


def _repeats(each: SensorPreview) -> Iterator[CheckFinding]:
    rate = each.sensor.sampling_rate
    for share in set(each.limits.repeated.values()):
        yield replace(_of(Problem.REPEATS, each, (1 - share) * rate), wanted=rate)


def _levels(each: SensorPreview) -> Iterator[CheckFinding]:
    names = [channel.name for channel in each.sensor.channels]
    for column, wrap in each.limits.wrapped.items():
        yield CheckFinding(Problem.WRAPPING, each.sensor.name, names[column], value=wrap.bits)
    for column, codes in each.limits.codes.items():
        if codes.stuck_bits or codes.n_missing:
            yield CheckFinding(Problem.STUCK_BIT, each.sensor.name, names[column], value=codes.bits)
    if each.is_clipping:
        yield _of(Problem.CLIPPING, each)
        return
    counts = driver_type(each.sensor.driver).full_scale(each.sensor)
    sheet = each.sensor.data_sheet
    if counts is None and (sheet is None or sheet.full_scale is None):
        yield _of(Problem.NO_FULL_SCALE, each)
        return
    for n, channel in each.sensor.main.items():
        most = float(np.abs(each.samples[:, n]).max())
        share = most * abs(channel.sensitivity) / (counts or math.inf)
        has_sheet = sheet is not None and (not sheet.channels or channel.name in sheet.channels)
        if sheet is not None and has_sheet and sheet.full_scale:
            own, of_sheet = (
                in_acceleration(channel.unit),
                in_acceleration(sheet.unit or channel.unit),
            )
            scale = 1.0 if own is None or of_sheet is None else own / of_sheet
            share = max(share, most * scale / sheet.full_scale)
        if share > NEAR:
            yield CheckFinding(Problem.NEAR_FULL_SCALE, each.sensor.name, channel.name, value=share)


def _hum(able: Sequence[SensorPreview]) -> Iterator[CheckFinding]:
    """Yield channels that hum more than the other sensors; hum of all may be motion."""
    yield from (_of(Problem.TOO_SLOW, e) for e in able if e.sensor.sampling_rate <= 2 * min(MAINS))
    fast = [each for each in able if each.sensor.sampling_rate > 2 * min(MAINS)]
    for mains in MAINS:
        known = [each for each in fast if mains < each.sensor.sampling_rate / 2]
        spectra = [_at_mains(each, mains) for each in known]
        totals = [float(power.sum()) for power, _ in spectra]
        for n, each in enumerate(known):
            others = totals[:n] + totals[n + 1 :]
            power, share = spectra[n]
            main = list(each.sensor.main.values())
            for place in np.flatnonzero(share > HUM_SHARE).tolist():
                is_more = bool(others) and power[place] > HUM_RATIO * float(np.median(others))
                problem = Problem.HUM if is_more else Problem.COMMON_HUM
                yield CheckFinding(problem, each.sensor.name, main[place].name, value=mains)


def _at_mains(each: SensorPreview, mains: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the power of each channel near a frequency, and its share of that above 1 Hz.

    The power is that of acceleration, in (m/s²)².
    """
    values, rate = main_samples(each), each.sensor.sampling_rate
    window = np.hanning(len(values))[:, None]
    power = np.abs(np.fft.rfft((values - values.mean(axis=0)) * window, axis=0)) ** 2
    power /= (window**2).sum() * rate
    frequency = np.fft.rfftfreq(len(values), 1 / rate)
    near = power[np.abs(frequency - mains) <= 1.0].sum(axis=0)
    whole = power[frequency > 1.0].sum(axis=0)
    share = np.divide(near, whole, out=np.zeros_like(near), where=whole > 0)
    factor = np.abs(to_acceleration(each.sensor, np.array([mains]))[0]) ** 2
    return near * factor * (rate / len(values)), share


def _sensitivities(motion: RelativeResponses) -> Iterator[CheckFinding]:
    if len(motion.sensors) < 3:
        yield CheckFinding(Problem.TOO_FEW_SENSORS)
        return
    compared = {place for each in motion.responses for place in (each.first, each.second)}
    for place, each in enumerate(motion.sensors):
        if place not in compared:
            yield _of(Problem.NOT_COMPARABLE, each)
    names = [
        (each.sensor.name, channel.name)
        for each in motion.sensors
        for channel in each.sensor.main.values()
    ]
    for gain in wrong_gains(motion.responses, motion.dims):
        sensor, channel = names[gain.channel]
        yield CheckFinding(
            Problem.SENSITIVITY,
            sensor,
            channel,
            value=gain.gain,
            against=tuple(motion.sensors[n].sensor.name for n in gain.against),
            cause=gain.cause,
        )


def _disk(bench: Bench, duration: float | None) -> Iterator[CheckFinding]:
    """Yield a finding where the disk has no room; the folder need not exist yet."""
    seconds = duration or bench.recording.duration or OPEN_END
    wanted = sum(
        BYTES_PER_VALUE * len(sensor.channels) * sensor.sampling_rate * seconds
        for sensor in bench.sensors
    )
    folder = bench.recording_directory.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        yield CheckFinding(Problem.DISK_UNKNOWN)
        return
    if free < wanted:
        yield CheckFinding(Problem.DISK_FULL, value=free, wanted=wanted)
