"""Two sensors in motion that changes: coverage, steady motion, and broken assumptions.

``python -m benchmarks.studies.two_sensors [DRAWS]`` prints the tables of
``docs/validation/two-sensors.md``. Nothing is shared with the estimator or the simulators.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimator.levels.interval import interval
from estimator.likelihood.changing_motion import ChangingMotionNoise, band_noise

N_PARTS = 12
KINDS = {"two": (1, 2), "triaxial": (3, 2), "pair": (1, 3)}
"""Channels of a sensor, and sensors; of a pair among three, the noise is shared."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Responses (n_freqs, p, q), noise (p, p), and the level of the motion (n_freqs, n_parts)."""

    response: np.ndarray
    noise: np.ndarray
    motion: np.ndarray
    level: np.ndarray
    own: np.ndarray
    """Channels of the first sensor."""


def _adjoint(a: np.ndarray) -> np.ndarray:
    return np.asarray(np.swapaxes(a, -1, -2).conj())


def scene(rng: np.random.Generator, kind: str, n_freqs: int, change: str, snr: float) -> Scene:
    """Return a bench drawn at random; `change` is in dB, or "loud" or "shape"."""
    d, sensors = KINDS[kind]
    course = np.linspace(-1, 1, n_freqs) if n_freqs > 1 else np.zeros(1)
    rows, noise = [], np.zeros((d * sensors, d * sensors))
    for i in range(sensors):
        turn = np.linalg.qr(rng.standard_normal((d, d)))[0]
        varies = np.exp((0.1 + 0.1j) * course * (i > 0))
        rows.append(rng.uniform(0.8, 1.2) * turn * varies[:, None, None])
        factor = rng.standard_normal((d, 2 * d)) if d > 1 else np.full((1, 2), 1.0)
        block = slice(i * d, (i + 1) * d)
        noise[block, block] = factor @ factor.T / (2 * d) * 10 ** rng.uniform(-0.3, 0.3)
    if kind == "pair":
        noise = np.array([[1.49, 0.49, 0], [0.49, 1.49, 0], [0, 0, 1.0]])
    shape = (n_freqs, N_PARTS)
    if change == "loud":
        level = np.broadcast_to(np.where(np.arange(N_PARTS) < N_PARTS // 3, 1e4, 1.0), shape)
    elif change == "shape":
        level = 10 ** (0.6 * rng.standard_normal(shape))
        level = level / level.mean(axis=0)
    else:
        db = float(change) * rng.standard_normal(N_PARTS)
        level = np.broadcast_to(10 ** (db / 10), shape)
    motion = snr * np.diag([1.0, 0.5, 2.0][:d])
    own = np.arange(d * sensors) < d
    return Scene(np.concatenate(rows, axis=1), noise, motion, level, own)


def _felt(at: Scene) -> np.ndarray:
    motion = at.level[..., None, None] * at.motion
    return np.asarray(at.response[:, None] @ motion @ _adjoint(at.response)[:, None])


def healthy(rng: np.random.Generator, at: Scene) -> np.ndarray:
    """Return the true matrices of all parts."""
    del rng
    return np.asarray(_felt(at) + at.noise)


def gain(size: float, course: str) -> Callable[[np.random.Generator, Scene], np.ndarray]:
    """Return a fault: the first sensor's gain follows the loudness, steps, or is random."""

    def fault(rng: np.random.Generator, at: Scene) -> np.ndarray:
        by_part = {
            "loudness": np.log10(at.level[0]),
            "step": np.arange(N_PARTS) >= N_PARTS // 2,
            "random": rng.standard_normal(N_PARTS),
        }[course]
        factor = np.where(at.own, 1 + size * by_part[:, None], 1.0)
        return np.asarray(factor[:, :, None] * _felt(at) * factor[:, None, :] + at.noise)

    return fault


def louder(size: float, course: str) -> Callable[[np.random.Generator, Scene], np.ndarray]:
    """Return a fault: the first sensor's noise follows the loudness, or rises."""

    def fault(rng: np.random.Generator, at: Scene) -> np.ndarray:
        del rng
        by_part = np.log10(at.level[0]) if course == "loudness" else np.linspace(-0.5, 0.5, N_PARTS)
        root = np.sqrt(np.maximum(1 + size * by_part, 0.02))
        factor = np.where(at.own, root[:, None], 1.0)
        return np.asarray(_felt(at) + factor[:, :, None] * at.noise * factor[:, None, :])

    return fault


def _drawn(rng: np.random.Generator, csm: np.ndarray, n: int) -> np.ndarray:
    """Return averages of n outer products of normal vectors with these covariances."""
    shape = (n, *csm.shape[:-1])
    normal = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
    vectors = np.einsum("...pq,n...q->n...p", np.linalg.cholesky(csm), normal)
    return np.asarray(np.einsum("n...p,n...q->...pq", vectors, vectors.conj()) / n)


def row(
    kind: str,
    change: str,
    snr: float,
    *,
    n: int,
    n_freqs: int,
    draws: int,
    fault: Callable[[np.random.Generator, Scene], np.ndarray] = healthy,
) -> str:
    """Return one row: share identified, accepted, coverage, bias, and what is silent."""
    rng = np.random.default_rng([len(kind), sum(map(ord, change)), int(10 * snr), n, n_freqs])
    d, sensors = KINDS[kind]
    identified, accepted, held, error = [], [], [], []
    for _ in range(draws):
        at = scene(rng, kind, n_freqs, change, snr)
        found: ChangingMotionNoise = band_noise(
            *(_drawn(rng, fault(rng, at), n), np.full(N_PARTS, float(n))),
            dims=(d,) * sensors,
            n_dims=d,
            shared=((0, 1),) if kind == "pair" else (),
        )
        truth = np.diag(at.noise)
        low, high = interval(found.level, found.cumulants)
        identified.append(found.identified)
        fits = found.p_value > 1e-3 and np.abs(found.follows).max() < 3.5
        accepted.append(found.identified & fits)
        held.append((low - found.lever <= truth) & (truth <= high + found.lever))
        error.append(found.level / truth - 1)
    known, good, inside, off = (np.array(each) for each in (identified, accepted, held, error))
    cover = inside[good].mean() if good.any() else np.nan
    bias = off[good].mean() if good.any() else np.nan
    return (
        f"{kind:8s} {change:>5s} dB, ratio {snr:6g}, n {n:3d}, {n_freqs:2d} frequencies:"
        f" identified {known.mean():.3f}, accepted {good.mean():.3f}, coverage {cover:.3f},"
        f" bias {bias:+.3f}, silent {(good & ~inside).mean():.3f}"
    )


def main() -> None:
    """Print all tables."""
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    for kind in KINDS:
        for change in ("6", "3", "0.5", "loud", "shape", "0"):
            for n in (20, 200):
                for n_freqs in (1, 20):
                    for snr in (0.3, 3.0, 30.0, 1e3):
                        print(row(kind, change, snr, n=n, n_freqs=n_freqs, draws=draws), flush=True)
    faults = {
        "gain follows loudness .1 %": gain(1e-3, "loudness"),
        "gain follows loudness 1 %": gain(1e-2, "loudness"),
        "gain steps 1 %": gain(1e-2, "step"),
        "gain random 1 %": gain(1e-2, "random"),
        "noise follows loudness 20 %": louder(0.2, "loudness"),
        "noise rises 20 %": louder(0.2, "ramp"),
    }
    for name, fault in faults.items():
        for kind in ("two", "triaxial"):
            for change, snr in (("6", 30.0), ("6", 1e3), ("loud", 30.0)):
                found = row(kind, change, snr, n=100, n_freqs=20, draws=draws, fault=fault)
                print(f"{name}: {found}", flush=True)


if __name__ == "__main__":
    main()
