"""Three triaxial sensors, two at a time: multi-part against the paper's equation (26) of all three.

``python -m benchmarks.studies.two_of_three RECORDING`` prints the table by frequency of
``docs/validation/two-sensors.md`` for a recording of three sensors at one rate.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np

from benchmarks.studies.two_series import averages_of
from daq.recording.reader import Recording
from estimator.levels.bands import bin_correlation
from estimator.levels.interval import interval
from estimator.likelihood.multi_part import multi_part
from estimator.spectra.windows import get_window

SEGMENT, N_PARTS = 2048, 24
EDGES = 10 ** (np.arange(-8, 13, 2) / 10)
"""Hz: pairs of thirds of an octave."""


def three_sensors(csm: np.ndarray, n: float) -> np.ndarray:
    """Return the noise of nine channels, (n_freqs, 9), by equation (26)."""
    found = np.zeros(csm.shape[:2])
    own = [slice(0, 3), slice(3, 6), slice(6, 9)]
    for a in range(3):
        i, j, k = own[a], own[(a + 1) % 3], own[(a + 2) % 3]
        for u, v in ((j, k), (k, j)):
            motion = csm[:, i, v] @ np.linalg.solve(csm[:, u, v], csm[:, u, i])
            found[:, i] += np.einsum("fii->fi", csm[:, i, i] - motion).real / 2
    return found / (1 - 3 / n)


def main() -> None:
    """Print the table."""
    recording = Recording.open(sys.argv[1])
    records = recording.sensors
    n_samples = min(record.n_samples for record in records)
    samples = np.concatenate(
        [np.asarray(record.counts(0, n_samples), float) for record in records], axis=1
    )
    csm, n = averages_of(samples, N_PARTS, segment=SEGMENT, rate=records[0].sampling_rate)
    frequency = np.fft.rfftfreq(SEGMENT, 1 / records[0].sampling_rate)
    correlation = bin_correlation(get_window("hann", SEGMENT), SEGMENT // 2)
    whole = np.tensordot(n / n.sum(), csm, axes=1)
    truth = three_sensors(whole, n.sum())
    total = np.zeros(3, int)
    every = []
    print("Hz, ratio in dB, channels with a level of 18, that hold (26), difference in dB")
    for low, high in itertools.pairwise(EDGES):
        bins = np.flatnonzero((frequency >= low) & (frequency < high) & (np.arange(1025) > 2))
        given, held, off, causes = 0, 0, [], set()
        for i, j in itertools.combinations(range(3), 2):
            own = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
            found = multi_part(
                csm[:, bins[:, None, None], own[:, None], own],
                n,
                np.asarray(frequency[bins], np.float64),
                dims=(3, 3),
                correlation=correlation,
                usable=np.ones(len(bins), bool),
                block=np.zeros(len(bins), np.int64),
            ).blocks[0]
            true = truth[bins][:, own].mean(axis=0)
            causes |= {str(why) for why in found.refusal if why is not None}
            if found.found is None:
                continue
            known = np.array([why is None for why in found.refusal])
            course = found.found.level
            ends = interval(course, found.found.cumulants)
            inside = (ends[0] - found.found.lever <= true) & (true <= ends[1] + found.found.lever)
            total[0] += found.found.identified.sum()
            given, held = given + int(known.sum()), held + int((known & inside).sum())
            off += np.abs(10 * np.log10(found.found.level / true))[known].tolist()
        ratio = np.einsum("fii->i", whole[bins]).real / truth[bins].sum(axis=0) - 1
        total += [0, given, held]
        every += off
        middle = f"{np.median(off):.2f}, at most {max(off):.2f}" if off else "–"
        decibels = 10 * np.log10(ratio)
        print(
            f"{low:.2f}–{high:.2f} | {decibels.min():.0f}–{decibels.max():.0f} | {given} | {held}"
            f" | {middle} | {', '.join(sorted(causes))}",
            flush=True,
        )
    print(f"identified {total[0]}, accepted {total[1]}, hold {total[2]} of 180;", end=" ")
    middle, most, largest = np.quantile(every, (0.5, 0.9, 1.0))
    print(f"median {middle:.2f}, 90 % {most:.2f}, largest {largest:.2f} dB")


if __name__ == "__main__":
    main()
