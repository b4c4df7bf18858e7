"""Diagnostics in plain words: section 5 of the paper, and what the model test adds to it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Literal

import numpy as np

from estimator.self_noise import Flag

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from estimator.arrays import IntArray
    from estimator.diagnostics import BandDiagnosis
    from estimator.response import RelativeResponse

Level = Literal["problem", "warning", "note"]

REJECT = 0.01
TURNED_DEG = 0.5
SKEWED_DEG = 2.0
GAIN = 0.02
DELAY_SAMPLES = 0.1


@dataclass(frozen=True, slots=True)
class Advice:
    """One thing to know about the test.

    Attributes
    ----------
    level : {"problem", "warning", "note"}
        The estimate is wrong; it may be, or is less sure than it could be; good to know.
    sensors : tuple of int
        It concerns, from 0; empty for all.
    band : (float, float) or None
        Hz; None for all frequencies.
    text : str
        A sentence or two.
    numbers : mapping of str to float
        What the text is based on.
    """

    level: Level
    sensors: tuple[int, ...]
    band: tuple[float, float] | None
    text: str
    numbers: Mapping[str, float]


def advise(
    bands: tuple[BandDiagnosis, ...],
    responses: tuple[RelativeResponse, ...],
    flags: IntArray,
    *,
    dims: tuple[int, ...],
    names: tuple[str, ...],
    n_effective: float,
    nyquist: float,
) -> tuple[Advice, ...]:
    """Put diagnostics into words, worst first.

    Parameters
    ----------
    bands : tuple of BandDiagnosis
        Rising.
    responses : tuple of RelativeResponse
    flags : int64, shape (n_freqs, n_channels)
        Of `estimator.coherency.Coherency`.
    dims : tuple of int
    names : tuple of str
        Of the sensors.
    n_effective : float
    nyquist : float
        Hz.

    Returns
    -------
    tuple of Advice
    """
    found = [
        *_channels(flags, dims, names),
        *_incoherence(bands, dims),
        *_dimensions(bands, dims, n_effective),
        *_weak_motion(bands),
        *(advice for response in responses for advice in _stance(response, names, nyquist)),
    ]
    order = {"problem": 0, "warning": 1, "note": 2}
    return tuple(sorted(found, key=lambda advice: order[advice.level]))


def _runs(
    bands: Iterable[BandDiagnosis], applies: Callable[[BandDiagnosis], bool]
) -> Iterator[list[BandDiagnosis]]:
    """Neighbouring bands to which something applies, together."""
    for true, run in groupby(bands, applies):
        if true:
            yield list(run)


def _span(run: list[BandDiagnosis]) -> tuple[float, float]:
    return run[0].low, run[-1].high


def _is_weak(band: BandDiagnosis) -> bool:
    known = band.snr[~np.isnan(band.snr)]
    return len(known) > 0 and bool(known.max() < 1)


def _words(band: tuple[float, float]) -> str:
    return f"{band[0]:.3g}–{band[1]:.3g} Hz"


def _channels(flags: IntArray, dims: tuple[int, ...], names: tuple[str, ...]) -> Iterator[Advice]:
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    for flag, words in (
        (Flag.DEAD_CHANNEL, "has no signal"),
        (Flag.DUPLICATE, "is a copy of another channel"),
    ):
        share = ((flags & flag) != 0).mean(axis=0)
        for channel in np.flatnonzero(share > 0.5):
            sensor = int(sensor_of[channel])
            number = int(channel - sum(dims[:sensor])) + 1
            yield Advice(
                "problem",
                (sensor,),
                None,
                f"Channel {number} of sensor {names[sensor]} {words}: nothing can be said of its "
                "noise.",
                {"share of frequencies": float(share[channel])},
            )


def _incoherence(bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...]) -> Iterator[Advice]:
    for run in _runs(bands, lambda band: band.test.p_value < REJECT):
        ratio = sum(b.test.statistic for b in run) / sum(b.test.degrees for b in run)
        worst = max(run, key=lambda b: b.test.statistic / b.test.degrees)
        most = worst.test.statistic / worst.test.degrees
        at = f", {most:.3g} at {_words((worst.low, worst.high))}" if len(run) > 1 else ""
        text = (
            f"At {_words(_span(run))} one motion of {max(dims)} dimensions does not explain what "
            f"the sensors have in common (statistic {ratio:.3g} times its expectation{at}): their "
            "noise is estimated wrong there. Put the sensors closer together; look for tilt, "
            "noise that two channels share (cable, digitizer), and clocks that drift."
        )
        if max(dims) < 3:
            text += (
                f" If the motion has more than {max(dims)} dimensions, sensors of {max(dims)} "
                "channels must stand exactly alike: align them, or use triaxial data."
            )
        if len(dims) > 3:
            text += f" With {len(dims)} sensors more dimensions can be allowed (dimension auto)."
        yield Advice(
            "problem" if most > 2 else "warning",
            (),
            _span(run),
            text,
            {
                "statistic over expectation": ratio,
                "worst": most,
                "least p value": min(b.test.p_value for b in run),
            },
        )


def _dimensions(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], n_effective: float
) -> Iterator[Advice]:
    full = min(sorted(dims)[-2:])
    for run in _runs(bands, lambda band: band.dimension < full and not _is_weak(band)):
        least = min(b.dimension for b in run)
        yield Advice(
            "warning",
            (),
            _span(run),
            f"At {_words(_span(run))} the motion has only {least:.0f} of {full} dimensions: the "
            "three-sensor estimate stays unbiased but scatters more. Choose the dimension "
            "by the motion (dimension auto), or stir the floor in all directions.",
            {"dimension": least, "condition": max(b.condition for b in run)},
        )
    limit = float(np.sqrt(n_effective))
    for run in _runs(bands, lambda band: band.dimension >= full and band.condition > limit):
        worst = max(b.condition for b in run)
        yield Advice(
            "note",
            (),
            _span(run),
            f"At {_words(_span(run))} the cross-spectral matrix between two sensors is nearly "
            f"singular (condition {worst:.3g}): one direction moves far less than the others, "
            "and the three-sensor estimate scatters more.",
            {"condition": worst},
        )


def _weak_motion(bands: tuple[BandDiagnosis, ...]) -> Iterator[Advice]:
    for run in _runs(bands, _is_weak):
        snr = float(np.nanmax([b.snr for b in run]))
        yield Advice(
            "note",
            (),
            _span(run),
            f"At {_words(_span(run))} the motion is weaker than the noise (SNR {snr:.2g} at "
            "most): the spectra are nearly the noise itself, and neither alignment nor method "
            "matters much.",
            {"SNR": snr},
        )


def _stance(response: RelativeResponse, names: tuple[str, ...], nyquist: float) -> Iterator[Advice]:
    pair = (response.first, response.second)
    band = (response.low, response.high)
    one, two = (names[sensor] for sensor in pair)
    error = response.angle_error_deg
    if response.rotation_deg > max(TURNED_DEG, 3 * error if np.isfinite(error) else 0.0):
        horizontal = response.horizontal_deg
        where = f" ({horizontal:.2f}° in the horizontal)" if np.isfinite(horizontal) else ""
        yield Advice(
            "note",
            pair,
            band,
            f"Sensors {one} and {two} are turned by {response.rotation_deg:.1f}°{where}: no bias "
            "in the three-sensor or maximum likelihood estimate, but a three-channel estimate "
            "leaks motion; aligning them can improve precision.",
            {"angle_deg": response.rotation_deg, "horizontal_deg": horizontal, "error_deg": error},
        )
    if response.nonorthogonality_deg > SKEWED_DEG:
        yield Advice(
            "warning" if response.nonorthogonality_deg > 20 else "note",
            pair,
            band,
            f"Channels of sensors {one} or {two} are {response.nonorthogonality_deg:.1f}° away "
            "from a right angle: no bias, but the noise estimate scatters more the more "
            "collinear they are.",
            {"nonorthogonality_deg": response.nonorthogonality_deg},
        )
    for channel in response.reversed_channels:
        yield Advice(
            "warning",
            pair,
            band,
            f"Channel {channel + 1} of sensor {two} has the opposite polarity of sensor {one}'s.",
            {"channel": float(channel + 1)},
        )
    off = int(np.argmax(np.abs(response.gains - 1)))
    if abs(response.gains[off] - 1) > GAIN:
        yield Advice(
            "note",
            pair,
            band,
            f"Channel {off + 1} of sensor {two} reads {response.gains[off]:.3f} times what sensor "
            f"{one} reads: no bias, but one of the two sensitivities is wrong, and with it the "
            "noise in physical units.",
            {"gain": float(response.gains[off])},
        )
    samples = response.delay * 2 * nyquist
    if abs(samples) > DELAY_SAMPLES:
        yield Advice(
            "warning",
            pair,
            band,
            f"Sensor {two} lags sensor {one} by {response.delay * 1e3:.3g} ms "
            f"({samples:.2g} samples): segments then differ at their ends. Use a tapered window, "
            "and align the clocks.",
            {"delay_s": response.delay, "samples": samples},
        )
