"""Whether intervals cover and advice is true in tests drawn at random."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.result import Result
from estimator.checks.advice import Advice
from estimator.levels.bands import band_edges
from estimator.types import FloatArray
from tui.studies.study import Panel, Point, Series, Study

METHODS = ("three-sensor", "maximum-likelihood")
DECADES = (-2, -1, 0, 1, 2, 4, 6)
"""Limits of the groups of SNR, log10."""
_NOMINAL, _ALLOWED, _FALSE, _FALSE_ALLOWED = 0.95, 0.02, 0.01, 0.01


@dataclass(slots=True)
class Judged:
    """What was judged of all tests so far.

    Attributes
    ----------
    covered : dict
        Method and group of SNR → of each test the share of intervals that hold the true mean.
    reported : dict
        Kind of advice → whether it was given, in each test in which it would be wrong.
    """

    covered: dict[tuple[str, int], list[float]] = field(default_factory=dict)
    reported: dict[type[Advice], list[bool]] = field(default_factory=dict)

    def add(
        self,
        snapshot: Snapshot,
        settings: Settings,
        *,
        noise_psd: FloatArray,
        bands: Sequence[tuple[float, float]],
        snr: float,
        is_wrong: Mapping[type[Advice], bool],
    ) -> None:
        """Judge a test.

        Parameters
        ----------
        snapshot, settings
            Its estimate.
        noise_psd : float64, shape (n_freqs, n_channels)
            The true one.
        bands
            In Hz, over which means are compared.
        snr
            Of the test.
        is_wrong
            Kinds of advice, and whether they are wrong in this test.
        """
        group = int(np.searchsorted(DECADES, np.log10(snr), side="right")) - 1
        for method in METHODS:
            shares = [
                _coverage(snapshot, settings, method, noise_psd=noise_psd, band=band)
                for band in bands
            ]
            self.covered.setdefault((method, group), []).append(float(np.mean(shares)))
        kinds = {type(each) for each in snapshot.diagnostics.advice}
        for kind, wrong in is_wrong.items():
            if wrong:
                self.reported.setdefault(kind, []).append(kind in kinds)

    def study(self, name: str, title: str) -> Study:
        """Return the study of these tests."""
        coverage = []
        for method in METHODS:
            groups = sorted(group for each, group in self.covered if each == method)
            points = [_covering(group, self.covered[method, group]) for group in groups]
            coverage.append(Series("95 % intervals of band means", method, "share", tuple(points)))
        wrong = tuple(
            Series(
                f"{kind.__name__} ({sum(found)} of {len(found)})",
                "advice",
                "share",
                (_accused(number, found),),
            )
            for number, (kind, found) in enumerate(self.reported.items())
        )
        return Study(
            name,
            title,
            (
                Panel("(a) coverage", "SNR, at least", "share (1)", tuple(coverage), log="x"),
                Panel("(b) advice that is wrong", "kind", "share of tests (1)", wrong),
            ),
        )


def _covering(group: int, shares: list[float]) -> Point:
    """Return a mean share of covered means; the channels of one test depend on each other."""
    error = max(float(np.std(shares)), 0.05) / np.sqrt(len(shares))
    return Point(10.0 ** DECADES[group], float(np.mean(shares)), _NOMINAL, error, _ALLOWED)


def _accused(number: int, found: list[bool]) -> Point:
    error = float(np.sqrt(_FALSE * (1 - _FALSE) / len(found)))
    return Point(number, float(np.mean(found)), _FALSE, error, _FALSE_ALLOWED)


def _coverage(
    snapshot: Snapshot,
    settings: Settings,
    method: str,
    *,
    noise_psd: FloatArray,
    band: tuple[float, float],
) -> float:
    """Return the share of channels whose interval holds the true mean over a band."""
    means = Result(snapshot, settings).means(method, band)
    here = slice(*band_edges(snapshot.frequency, band))
    width = np.gradient(snapshot.frequency)[here]
    truth = np.average(noise_psd[here], axis=0, weights=width)
    held = [mean.low[0] <= each <= mean.high[0] for mean, each in zip(means, truth, strict=True)]
    return float(np.mean(held))
