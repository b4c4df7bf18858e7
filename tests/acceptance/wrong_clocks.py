"""`python -m tests.acceptance.wrong_clocks [NAME…]`: recordings with known clocks and known noise.

Prints a row for each group of recordings: the worst error of any channel and band, how many of them
are neither within 0.3 dB nor held by their interval, coverage in the worst channel, the stated over
the real residual (lowest, highest, and the rms of its inverse), and the slips that were found. One
core, some twenty minutes.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from multiprocessing import Pool
from pathlib import Path

import numpy as np

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.results.result import Result
from tests.known_clocks import NOISE, Motion, Oscillator, Scene, record

EDGES = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.43])
"""Of bands, as fractions of the lowest sampling rate."""
WITHIN = 0.3
"""dB of the truth that a level may be off, whatever its interval says."""
PROCESSES = 2
SURVEYED = "surveyed"


@dataclass
class Group:
    """What recordings of one kind gave."""

    errors: list[np.ndarray] = field(default_factory=list)
    holds: list[np.ndarray] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    slips: list[int] = field(default_factory=list)
    not_understood: int = 0

    def row(self, name: str) -> str:
        """Return the group as a row of a table."""
        error, holds = (np.concatenate(part) for part in (self.errors, self.holds))
        bad = int((~holds & ~(np.abs(error) <= WITHIN)).sum())
        covered = holds.reshape(-1, holds.shape[-1]).mean(axis=0).min()
        known = error[holds | (np.abs(error) < 3)]
        worst = float(np.nanmax(np.abs(known))) if known.size else np.nan
        ratio = "– | –"
        if self.ratios:
            rms = float(np.sqrt(np.mean(np.array(self.ratios) ** -2.0)))
            ratio = f"{min(self.ratios):.2f}–{max(self.ratios):.2f} | {rms:.2f}"
        return (
            f"| {name} | {len(self.slips)} | {worst:.2f} | {bad} of {error.size} | {covered:.2f} |"
            f" {ratio} | {sum(self.slips)} | {self.not_understood} |"
        )


def healthy() -> Iterator[tuple[str, Scene]]:
    """Yield 108 scenes with nothing but free clocks."""
    rates = ((200.0, 200.0, 200.0), (100.0, 250.0, 200.0), (200.0, 200.0, 100.0))
    motions: tuple[Motion, ...] = ("white", "red", "coloured")
    grid = itertools.product(rates, motions, (1e2, 1e4, 1e6), (False, True))
    fast = (Oscillator(100.0), Oscillator(-100.0), Oscillator())
    cycles = (
        Oscillator(5.0, 10.0, 120.0, 5.0),
        Oscillator(-15.0, 10.0, 120.0, -15.0),
        Oscillator(40.0, 10.0, 120.0, 40.0),
    )
    for number, (rate, motion, snr, polled) in enumerate(grid):
        scene = Scene(
            rates=rate, motion=motion, snr=snr, polled=polled, seed=number + 1, seconds=240.0
        )
        yield f"healthy, {motion}, SNR {snr:.0e}", scene
        clocks = fast if number % 2 else cycles
        name = "±100 ppm" if number % 2 else "cycles of 10 ppm in 120 s"
        yield name, replace(scene, clocks=clocks, seed=number + 101)


def faulty() -> Iterator[tuple[str, Scene]]:
    """Yield scenes with one fault each, of several seeds.

    They are so long that a level is off by less than 0.1 dB (rms) by chance.
    """
    warm = (Oscillator(), Oscillator(15.0, 30.0, 180.0), Oscillator(-20.0))
    every = dict.fromkeys(range(3), (20.0, 40.0, 1.5))
    for seed, polled, snr in ((1, False, 1e4), (2, True, 1e2), (3, True, 1e6)):
        scene = Scene(polled=polled, seed=seed, snr=snr, seconds=1600.0)
        yield "a sample lost", replace(scene, slips={1: [(200.0, 1)]})
        yield "a sample counted twice", replace(scene, slips={2: [(210.0, -1)]})
        yield "a sample lost by the reference", replace(scene, slips={0: [(200.0, 1)]})
        yield (
            "a sample lost each minute",
            replace(scene, slips={1: [(60.0 * n, 1) for n in range(1, 26)]}),
        )
        yield (
            "a sample lost each 5 s",
            replace(scene, slips={1: [(5.0 * n, 1) for n in range(1, 318)]}),
        )
        yield "blocks of 20 and 100 lost", replace(scene, slips={1: [(130.0, 20), (270.0, 100)]})
        yield "gaps of 1 and 37 that are none", replace(scene, leaps={1: [(130.0, 1), (270.0, 37)]})
        yield "30 ppm in 180 s", replace(scene, clocks=warm)
        yield (
            "one restarts every 7 to 17 s",
            replace(scene, restarts={1: (7.0, 17.0, 1.5)}),
        )
        yield "all restart every 20 to 40 s", replace(scene, restarts=every)


def surveyed() -> Iterator[tuple[str, Scene]]:
    """Yield scenes so long, for segments of 2 s, that clocks which prove straight are surveyed.

    Their rates are steady, or go in cycles that only many segments together show.
    """
    cycles = ((0.0, 60.0), (0.05, 30.0), (0.2, 60.0), (0.2, 300.0), (1.0, 100.0), (10.0, 120.0))
    motions: tuple[Motion, ...] = ("white", "red")
    for (ppm, period), motion, snr in itertools.product(cycles, motions, (1e2, 1e4, 1e6)):
        clocks = (Oscillator(), Oscillator(15.0, ppm, period, 0.3), Oscillator(-20.0))
        scene = Scene(seconds=1600.0, motion=motion, snr=snr, clocks=clocks)
        yield f"{SURVEYED}, {ppm:g} ppm in {period:g} s", scene


def one(job: tuple[str, Scene]) -> tuple[str, np.ndarray, np.ndarray, list[float], int, int]:
    """Return what one recording gives."""
    name, scene = job
    settings = Settings(segment=2.0) if name.startswith(SURVEYED) else Settings()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.h5"
        truth = record(path, scene)
        snapshot = estimate([path], settings)
    edges = np.searchsorted(snapshot.frequency, min(scene.rates) * EDGES)
    found = Result(snapshot, settings).spectrum("three-sensor").levels(edges)
    low, high = found.ends()
    with np.errstate(invalid="ignore", divide="ignore"):
        error = 10 * np.log10(found.mean / NOISE)
    ratios = []
    if not scene.restarts:  # segments of epochs that are not used cannot be told from others
        found_left = snapshot.diagnostics.synchronisation
        stated = np.array(list(found_left.residual.values()))
        if not found_left.reference:  # each is against the computer's clock
            stated = np.hypot(stated, stated[0])
        ratios = (stated[1:] / truth.residual(snapshot)[1:]).tolist()
    n_slips = sum(len(clock.slips) for clock in snapshot.clocks)
    doubtful = sum(not clock.is_understood for clock in snapshot.clocks)
    ratios = [each for each in ratios if np.isfinite(each)]
    return name, error, (low <= NOISE) & (high >= NOISE), ratios, n_slips, doubtful


def main(names: list[str]) -> int:
    """Run all scenes, or those whose names begin like one of these."""
    jobs = [
        job
        for job in itertools.chain(faulty(), surveyed(), healthy())
        if not names or any(job[0].startswith(name) for name in names)
    ]
    groups: dict[str, Group] = {}
    with Pool(PROCESSES) as pool:
        for name, error, holds, ratios, n_slips, doubtful in pool.imap(one, jobs):
            print(".", end="", file=sys.stderr, flush=True)
            group = groups.setdefault(name, Group())
            group.errors.append(error)
            group.holds.append(holds)
            group.ratios += ratios
            group.slips.append(n_slips)
            group.not_understood += doubtful
    print(
        "| recordings | n | worst error (dB) | neither within 0.3 dB nor held |"
        " coverage, worst channel | stated over real residual |"
        " rms of real over stated | slips | not understood |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, group in groups.items():
        print(group.row(name))
    every = np.concatenate([part for group in groups.values() for part in group.holds])
    print("coverage by channel:", np.round(every.mean(axis=0), 3))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
