"""Two sensors in motion that changes, as time series: coverage, steady motion, broken assumptions.

``python -m benchmarks.studies.two_series TABLE DRAWS`` prints one of the tables ``changing``,
``steady`` and ``faults`` of ``docs/validation/two-sensors.md``. The samples and their averages
(Hann, half overlap) share nothing with the estimator or the simulators. The level of the motion
changes at random times, not between parts.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from estimator.levels.bands import bin_correlation
from estimator.levels.interval import interval
from estimator.likelihood.changing_motion import bound_of_parts
from estimator.likelihood.multi_part import multi_part
from estimator.spectra.windows import effective_averages, get_window

SEGMENT, HOP, RATE = 128, 64, 128.0
BINS = {1: slice(30, 31), 20: slice(26, 46)}
KINDS = {"two": (1, 2), "triaxial": (3, 2), "pair": (1, 3)}
"""Channels of a sensor, and sensors; of a pair among three, the noise is shared."""
SHARED = 0.49 / 1.49
RATIOS = (0.3, 3.0, 30.0, 1000.0)


@dataclass(slots=True)
class Scene:
    """A recording before its sensors: motion (n, d) and decades of its power, (n,)."""

    motion: np.ndarray
    decades: np.ndarray
    n_parts: int


def scene(
    rng: np.random.Generator, d: int, change: str, snr: float, *, n: int, n_parts: int
) -> Scene:
    """Return motion; `change` is in dB, or "loud", "shape" or "axis"."""
    segments = round(n / effective_averages(get_window("hann", SEGMENT), HOP, 1000) * 1000)
    length = n_parts * segments * HOP + HOP
    steps = np.sort(rng.integers(0, length, rng.integers(n_parts, 3 * n_parts)))
    stretch = np.searchsorted(steps, np.arange(length), side="right")
    motion = _white(rng, length, d) * np.sqrt(snr * np.array([1.0, 0.5, 2.0][:d], np.float32))
    decades: np.ndarray = np.zeros(length, np.float32)
    if change == "loud":
        decades[: length // 3] = 4.0
    elif change == "shape":
        edges = [0, *steps.tolist(), length]
        for first, last in itertools.pairwise(edges):
            pole = 0.8 * np.exp(2j * np.pi * rng.uniform(0.1, 0.4))
            a = np.poly([pole, pole.conj()]).real
            power = np.sum(np.asarray(lfilter([1.0], a, np.eye(1, 400)[0])) ** 2)
            shaped = np.asarray(lfilter([1.0], a, motion[first:last], axis=0))
            motion[first:last] = shaped / np.sqrt(power)
    else:
        db = 6.0 if change == "axis" else float(change)
        decades = (db / 10 * _white(rng, len(steps) + 1))[stretch]
    still = np.zeros(d, bool)
    still[1:2] = change == "axis"
    motion[:, ~still] *= 10 ** (decades[:, None] / 2)
    return Scene(motion, decades, n_parts)


def _white(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return white noise, in single precision: 1e-14 of the power of the loudest motion."""
    return rng.standard_normal(shape, np.float32)


def felt(
    rng: np.random.Generator, at: Scene, sensors: int, tap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the sensors feel (n, p), and their response at 128 Hz (n_freqs, p, d)."""
    found, response, d = [], [], at.motion.shape[1]
    turn_of_bin = np.exp(-2j * np.pi * np.arange(SEGMENT // 2 + 1) / SEGMENT)[:, None, None]
    for number in range(sensors):
        turn = rng.uniform(0.8, 1.2) * np.linalg.qr(rng.standard_normal((d, d)))[0]
        x, own = at.motion @ turn.T.astype(np.float32), tap * (number > 0)
        if own:
            x[1:] += np.float32(own) * x[:-1]
        found.append(x)
        response.append(turn * (1 + own * turn_of_bin))
    return np.concatenate(found, axis=1), np.concatenate(response, axis=1)


def noise_of(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Return the matrix of the noise, (p, p)."""
    d, sensors = KINDS[kind]
    if kind == "pair":
        return np.array([[1.49, 0.49, 0], [0.49, 1.49, 0], [0, 0, 1.0]])
    found = np.zeros((d * sensors, d * sensors))
    for i in range(sensors):
        factor = rng.standard_normal((d, 2 * d)) if d > 1 else np.full((1, 2), 1.0)
        block = slice(i * d, (i + 1) * d)
        found[block, block] = factor @ factor.T / (2 * d) * 10 ** rng.uniform(-0.3, 0.3)
    return found


def averages_of(
    x: np.ndarray,
    n_parts: int,
    *,
    segment: int = SEGMENT,
    rate: float = RATE,
    bins: slice = slice(None),
) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices of parts (n_parts, n_freqs, p, p) in power a Hz, and their averages."""
    hop = segment // 2
    n_segments = (len(x) - segment) // hop + 1
    window = np.hanning(segment + 1)[:-1].astype(x.dtype)
    rows = np.lib.stride_tricks.sliding_window_view(x, segment, axis=0)[::hop]
    spectra = np.fft.rfft((rows - rows.mean(axis=-1, keepdims=True)) * window)[..., bins]
    bounds = np.linspace(0, n_segments, n_parts + 1).astype(int)
    found = []
    for a, b in itertools.pairwise(bounds):
        part = np.ascontiguousarray(spectra[a:b].transpose(2, 1, 0))
        found.append(part @ part.conj().swapaxes(1, 2) / (b - a))
    scale = 2 / (rate * float(np.sum(window**2)))
    known = get_window("hann", segment)
    each = [effective_averages(known, hop, int(count)) for count in np.diff(bounds)]
    return np.stack(found).astype(complex) * scale, np.array(each)


def gain(size: float, course: str) -> Callable[..., None]:
    """Return a fault of the first sensor: its gain follows the loudness, steps, or drifts."""

    def fault(at: Scene, x: np.ndarray, noise: np.ndarray, own: slice) -> None:
        del noise
        time = np.linspace(-0.5, 0.5, len(x))
        by = {"loudness": at.decades, "step": (time > 0) * 1.0, "drift": time}[course]
        x[:, own] *= 1 + size * by[:, None]

    return fault


def louder(size: float, course: str) -> Callable[..., None]:
    """Return a fault of the first sensor: its noise follows the loudness, or drifts."""

    def fault(at: Scene, x: np.ndarray, noise: np.ndarray, own: slice) -> None:
        by = at.decades if course == "loudness" else np.linspace(-0.5, 0.5, len(x))
        noise[:, own] *= np.sqrt(np.maximum(1 + size * by, 0.02))[:, None]

    return fault


@dataclass(slots=True)
class Found:
    """What one recording gives: each of its channels, or none where parts are too few."""

    known: np.ndarray
    causes: list[str]
    inside: np.ndarray
    error: np.ndarray
    width: np.ndarray
    """Half-widths by scatter over those of Cramér and Rao; NaN where these are not computed."""
    shared: float


def found_in(
    rng: np.random.Generator,
    kind: str,
    change: str,
    snr: float,
    *,
    n: int,
    bins: slice,
    n_parts: int,
    fault: Callable[..., None] | None,
) -> Found:
    """Return what one recording gives."""
    d, sensors = KINDS[kind]
    pairs = ((0, 1),) if kind == "pair" else ()
    correlation = bin_correlation(get_window("hann", SEGMENT), HOP)
    at = scene(rng, d, change, snr, n=n, n_parts=n_parts)
    motion, response = felt(rng, at, sensors, 0.01 if change == "loud" else 0.1)
    matrix = noise_of(rng, kind)
    noise = _white(rng, *motion.shape) @ np.linalg.cholesky(matrix).T.astype(np.float32)
    if fault is not None:
        fault(at, motion, noise, slice(0, d))
    csm, averages = averages_of(motion + noise, n_parts, bins=bins)
    response = response[bins]
    n_freqs = csm.shape[1]
    (block,) = multi_part(
        csm,
        averages,
        np.arange(1.0, n_freqs + 1),
        dims=(d,) * sensors,
        shared=pairs,
        correlation=correlation,
        usable=np.ones(n_freqs, bool),
        block=np.zeros(n_freqs, np.int64),
    ).blocks
    known = np.array([why is None for why in block.refusal])
    causes = [why.name for why in block.refusal if why is not None]
    nothing = np.full(d * sensors, np.nan)
    if block.found is None:
        return Found(known, causes, np.zeros_like(known), nothing, nothing, np.nan)
    truth, level, lever = np.diag(matrix) * 2 / RATE, block.found.level, block.found.lever
    low, high = interval(level, block.found.cumulants)
    width = nothing
    if known.any() and change not in {"loud", "shape", "axis"}:
        steps = np.linspace(0, len(at.decades), n_parts + 1).astype(int)
        power = np.array([np.mean(10 ** at.decades[a:b]) for a, b in itertools.pairwise(steps)])
        axes = response @ (snr * np.diag([1.0, 0.5, 2.0][:d])) @ response.conj().swapaxes(1, 2)
        true = power[:, None, None] * axes[:, None] + matrix
        dims = (d,) * sensors
        least = bound_of_parts(true, matrix.astype(complex), dims=dims, n_dims=d, shared=pairs)
        least *= np.sqrt(_alike(n_freqs, correlation) / averages.sum()) * 2 / RATE
        width = (high - low) / 2 / (1.96 * least)
    alike = block.shared[0].share / SHARED if block.shared else np.nan
    inside = (low - lever <= truth) & (truth <= high + lever)
    return Found(known, causes, inside, level / truth - 1, width, alike)


def row(
    kind: str,
    change: str,
    snr: float,
    *,
    n: int,
    n_freqs: int,
    draws: int,
    n_parts: int = 12,
    fault: Callable[..., None] | None = None,
) -> str:
    """Return one row of a table."""
    rng = np.random.default_rng(
        [len(kind), sum(map(ord, change)), int(10 * snr), n, n_freqs, n_parts]
    )
    each = [
        found_in(rng, kind, change, snr, n=n, bins=BINS[n_freqs], n_parts=n_parts, fault=fault)
        for _ in range(draws)
    ]
    known, inside, off, width = (
        np.array([getattr(one, name) for one in each])
        for name in ("known", "inside", "error", "width")
    )
    causes = [cause for one in each for cause in one.causes]
    shares = {name: causes.count(name) / known.size for name in sorted(set(causes))}
    some = known.any()
    return (
        f"{kind:8s} {change:>5s} ratio {snr:6g} parts {n_parts} n {n:3d} bins {n_freqs:2d}:"
        f" recordings with a number {known.any(axis=1).mean():.4f} channels {known.mean():.3f}"
        f" coverage {inside[known].mean() if some else np.nan:.3f}"
        f" silent {(known & ~inside).mean():.3f}"
        f" bias {off[known].mean() if some else np.nan:+.3f}"
        f" width {np.median(width[known]) if some else np.nan:.2f}"
        f" shared {np.mean([one.shared for one in each if np.isfinite(one.shared)] or np.nan):.3f} "
        + " ".join(f"{name} {share:.2f}" for name, share in shares.items())
    )


def _alike(count: int, correlation: np.ndarray) -> float:
    lag = np.arange(1, len(correlation))
    return float(1 + 2 * np.maximum(1 - lag / count, 0) @ correlation[1:])


FAULTS = {
    "gain follows loudness .1 %": gain(1e-3, "loudness"),
    "gain follows loudness 1 %": gain(1e-2, "loudness"),
    "gain steps 1 %": gain(1e-2, "step"),
    "gain drifts 1 %": gain(1e-2, "drift"),
    "noise follows loudness 20 %": louder(0.2, "loudness"),
    "noise drifts 20 %": louder(0.2, "drift"),
}


def main() -> None:
    """Print one table."""
    table, draws = sys.argv[1], int(sys.argv[2])
    for kind in sys.argv[3:] or KINDS:
        if table == "changing":
            for n, n_parts, n_freqs in ((20, 12, 20), (20, 24, 1), (60, 24, 20), (200, 12, 20)):
                for change in ("6", "3", "0.5", "loud", "shape"):
                    for snr in RATIOS:
                        line = row(
                            kind, change, snr, n=n, n_freqs=n_freqs, draws=draws, n_parts=n_parts
                        )
                        print(line, flush=True)
        elif table == "steady":
            for n, n_parts, n_freqs in ((20, 12, 20), (20, 24, 1), (200, 12, 20)):
                for snr in RATIOS:
                    line = row(kind, "0", snr, n=n, n_freqs=n_freqs, draws=draws, n_parts=n_parts)
                    print(line, flush=True)
        elif table == "faults" and kind != "pair":
            for name, fault in FAULTS.items():
                for change, snr in (("6", 30.0), ("6", 1e3), ("3", 30.0), ("loud", 30.0)):
                    line = row(kind, change, snr, n=100, n_freqs=20, draws=draws, fault=fault)
                    print(f"{name}: {line}", flush=True)
            line = row(kind, "axis", 30.0, n=100, n_freqs=20, draws=draws)
            print(f"one axis still: {line}", flush=True)


if __name__ == "__main__":
    main()
