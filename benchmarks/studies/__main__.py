"""``python -m benchmarks.studies [STUDY…]``: studies beside theory or truth, with their figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import typer

from benchmarks.studies.clocks import clock_coverage, clocks
from benchmarks.studies.courses import CONTRASTS, contrasts
from benchmarks.studies.estimates import ESTIMATES
from benchmarks.studies.gradients import gradients
from benchmarks.studies.random_arrays import RANDOM_TESTS, random_tests
from benchmarks.studies.random_recordings import RANDOM_RECORDINGS, random_recordings
from benchmarks.studies.responses import calibration, edges
from benchmarks.studies.shared_noise import SHARED_NOISE, shared
from benchmarks.studies.verdicts import verdicts
from daq.errors import HuddleError
from sim_devices.errors import ScenarioError
from tui.studies.reproduce import DEFAULT_FOLDER, run
from tui.studies.study import ProgressCallback, Study

STUDIES: dict[str, Callable[[ProgressCallback, float], Study]] = {
    "clocks": clocks,
    "verdicts": verdicts,
    **ESTIMATES,
    SHARED_NOISE: shared,
    "calibration": calibration,
    "edges": edges,
    "gradients": gradients,
    "clock-coverage": clock_coverage,
    RANDOM_TESTS: random_tests,
    RANDOM_RECORDINGS: random_recordings,
    CONTRASTS: contrasts,
}


def further(progress: ProgressCallback, length: float) -> Mapping[str, Callable[[], Study]]:
    """Return the studies that are not of the paper."""
    return {name: partial(study, progress, length) for name, study in STUDIES.items()}


def main(arguments: Sequence[str]) -> int:
    """Carry out studies; return 1 where a point is further from theory than its errors."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies", description=__doc__)
    parser.add_argument("studies", nargs="*", help=f"{', '.join(STUDIES)} (default: all)")
    parser.add_argument("--out", type=Path, default=DEFAULT_FOLDER, help="folder of the figures")
    parser.add_argument("--json", help="file for every point, or -")
    parser.add_argument("--length", type=float, default=1.0, help="share of the full length")
    given = parser.parse_args(arguments)
    to = {"out": given.out, "json": given.json}
    try:
        return int(not run(given.studies, length=given.length, studies=further, **to))
    except (HuddleError, ScenarioError, typer.BadParameter) as error:
        parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
