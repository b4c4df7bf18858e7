"""What the averages show of the test itself, put together for front ends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daq.estimation.noise_estimates import neighbours
from estimator.diagnostics.diagnose import Diagnostics, diagnose
from estimator.errors import InsufficientDataError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Channel
    from daq.estimation.noise_estimates import Dimensions
    from daq.timing.clock_model import ClockState
    from estimator.diagnostics.advice import Advice
    from estimator.self_noise.result import SelfNoise
    from estimator.spectra.multiresolution import Band

    FloatArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]

_UP = {"z", "up", "down", "vertical", "+z", "-z"}


def synchronisation(
    clocks: Sequence[ClockState],
    is_reference: Sequence[bool],
    moved: FloatArray,
    *,
    dims: tuple[int, ...],
    frequency: FloatArray,
    csm: ComplexArray,
    results: dict[str, SelfNoise],
) -> dict[str, Any]:
    """Say what is left between the clocks, and what it does to the noise estimate.

    `is_reference` says which sensors run by the clock that others are measured against; `moved`,
    shape (n_segments, n_sensors), by how much clocks differ from those that segments were taken by.
    A delay that varies by δ (rms) takes ``(ωδ)²`` of a channel's coherent power out of the common
    motion, and so into its noise.
    """
    residual = np.array([state.residual for state in clocks])
    refined = np.array([state.refined for state in clocks], dtype=bool)
    if refined.any():  # what counts is the delay against the reference, however late all are
        reference = np.array(is_reference, dtype=bool)
        residual = np.where(refined, residual, np.hypot(residual, residual[reference].max()))
        residual[reference] = 0.0
    if len(moved):
        first = list(is_reference).index(True)
        residual = np.hypot(residual, (moved - moved[:, [first]]).std(axis=0))
    found: dict[str, Any] = {
        "residual": dict(zip((state.sensor for state in clocks), residual, strict=True))
    }
    if results and len(residual) == len(dims):
        noise = next(iter(results.values())).noise_psd
        coherent = np.diagonal(csm, axis1=1, axis2=2).real - noise
        turn = 2 * np.pi * frequency[:, None] * np.repeat(residual, dims)
        with np.errstate(invalid="ignore", divide="ignore"):
            found["noise_bias"] = turn**2 * coherent / np.abs(noise)
    return found


def vertical_channel(channels: Sequence[Channel]) -> int | None:
    """Return which of three channels is vertical by its direction or its name.

    Names such as BHZ, or BH0 with BH1 and BH2; None where neither tells.
    """
    if len(channels) != 3:
        return None
    for number, channel in enumerate(channels):
        if channel.direction is not None and channel.direction.strip().lower() in _UP:
            return number
    last = "".join(channel.name[-1:] for channel in channels).upper()
    if last.count("Z") == 1:
        return last.index("Z")
    return last.index("0") if sorted(last) == ["0", "1", "2"] else None


def diagnosis(
    bands: Sequence[Band],
    dims: tuple[int, ...],
    channels: Sequence[tuple[str, Channel]],
    *,
    dimensions: Dimensions | None = None,
    faulty: Collection[str] = (),
) -> dict[str, Any]:
    """Diagnose the test.

    The model tested has as many dimensions as were asked for, or as the largest sensor has
    channels where `dimensions` were chosen by the motion. Of `faulty` channels (such as ``A.X``)
    it is known that they are cut off, or were dead for a while: no sensitivity of theirs is called
    wrong.

    Returns
    -------
    dict
        ``bands``, ``responses`` and ``advice`` as `estimator.diagnostics.diagnose.Diagnostics` has
        them; ``n_factors``, the dimensions of the model tested; ``pairs`` (names of sensors) and
        ``per_frequency``, a dict of its arrays. Where each octave has its own segments, sensors are
        compared by the octave in which they are most coherent. Empty where there is too little to
        diagnose.
    """
    sensors = list(dict.fromkeys(sensor for sensor, _ in channels))
    verticals = {
        vertical_channel([channel for name, channel in channels if name == sensor])
        for sensor in sensors
    }
    vertical = verticals.pop() if len(verticals) == 1 else None
    n_factors = None
    if dimensions is not None and not dimensions.chosen:
        n_factors = int(dimensions.n_factors[0][0])
    found: list[Diagnostics] = []
    known = [_n_known(band) for band in bands]
    with np.errstate(invalid="ignore", divide="ignore"):
        for band, count in zip(bands, known, strict=True):
            try:
                diagnostics = diagnose(
                    band.csm[:count],
                    band.frequencies[:count],
                    dims=dims,
                    n_effective=band.n_effective,
                    n_factors=n_factors,
                    neighbours=neighbours(band),
                    names=tuple(sensors),
                    channels=tuple(channel.name for _, channel in channels),
                    vertical=vertical,
                )
            except InsufficientDataError:  # two sensors, or too few averages
                return {}
            found.append(diagnostics)
    if not found:
        return {}
    labels = [f"{sensor}.{channel.name}" for sensor, channel in channels]
    clearest = max(found, key=lambda each: sum(r.coherence for r in each.responses))
    return {
        "bands": tuple(band for each in found for band in each.bands),
        "responses": clearest.responses,
        "advice": tuple(
            advice
            for each in found
            for advice in each.advice
            if (each is clearest or not advice.sensors)
            and not _is_explained(advice, labels, faulty)
        ),
        "n_factors": found[0].n_factors,
        "pairs": tuple((sensors[j], sensors[k]) for j, k in found[0].pairs),
        "per_frequency": {
            **{
                name: _over(bands, [getattr(each, name) for each in found])
                for name in ("coherence", "condition", "dimension", "snr")
            },
            **{
                name: _over(bands, [getattr(each.model, name) for each in found])
                for name in ("statistic", "degrees", "p_value")
            },
        },
    }


def _is_explained(advice: Advice, labels: Sequence[str], faulty: Collection[str]) -> bool:
    """Whether a gain is off because a channel is faulty."""
    if "gain" not in advice.numbers:
        return False
    concerned = {labels[int(advice.numbers[key])] for key in ("of channel", "against channel")}
    return not concerned.isdisjoint(faulty)


def _n_known(band: Band) -> int:
    """Return how many frequencies there are up to the last of which something is known."""
    known = np.flatnonzero(np.isfinite(band.csm).any(axis=(1, 2)))
    return int(known[-1]) + 1 if known.size else len(band.frequencies)


def _over(bands: Sequence[Band], parts: Sequence[FloatArray]) -> FloatArray:
    """Return parts one after the other, each NaN beyond what is known of its band."""
    whole = []
    for band, part in zip(bands, parts, strict=True):
        shape = (len(band.frequencies) - len(part), *part.shape[1:])
        whole += [part, np.full(shape, np.nan)]
    return np.concatenate(whole)
