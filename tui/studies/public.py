"""``huddle reproduce public FOLDER…``: every method beside a bound, from public huddle tests.

The bound needs no model of the motion: what all other sensors together cannot predict of a channel.
Noise is below it, whatever the dimension of the motion, the gains and the orientations. It is
computed here from the cross-spectral matrix alone, and shares no code with the estimators. A method
whose whole interval lies above the upper end of the bound contradicts the samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from math import isfinite, nan
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import typer
from scipy.stats import chi2

from daq.bench.units import is_motion
from daq.errors import HuddleError, ImportFormatError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.importer import import_files
from daq.formats.response import Responses, is_response
from daq.recording.reader import Recording
from daq.results.band_summary import data_means
from daq.results.result import Result
from estimator.self_noise.result import Flag
from estimator.types import FloatArray
from tui.output.console import check_places, for_people, notices, write_json
from tui.output.extras import require
from tui.page.table import Table
from tui.studies.study import Panel, Study, StudyCurve

PUBLIC = "public"
BOUND = "bound"
_SEGMENTS = 100
"""Of the recording, at half overlap: as long as scatter allows."""
_LONGEST_S, _SHORTEST_S = 400.0, 1.0
_NEIGHBOURS = 1.94
"""Bins that a Hann window makes of one: 1 + 2·(0.67² + 0.17²)."""
_USED = 0.4
"""Of the sampling rate: highest frequency."""


@dataclass(frozen=True, slots=True)
class Level:
    """Mean of one channel in one octave, in dB re 1 unit²/Hz.

    Attributes
    ----------
    test, sensor, channel, unit : str
    low_hz, high_hz : float
    method : str
        Of the estimate; or "bound".
    data, noise, low, high : float
        Level of the samples, the estimate, and its 95 % interval; NaN where it is not positive.
    contradicts : bool
        Whether the interval lies above the upper end of the bound.
    """

    test: str
    sensor: str
    channel: str
    unit: str
    low_hz: float
    high_hz: float
    method: str
    data: float
    noise: float
    low: float
    high: float
    contradicts: bool = False


def model_free_bound(snapshot: Snapshot) -> tuple[FloatArray, FloatArray]:
    """Return the bound of each channel, and the averages that are left to it.

    Returns
    -------
    bound : float64, shape (n_freqs, n_channels)
        In unit²/Hz, without bias: 1/(S⁻¹)ᵢᵢ·n/(n − m) of S without the other channels of the own
        sensor, for m predictors.
    left : float64, shape (n_channels,)
        n − m; the bound has twice as many degrees of freedom at each frequency.
    """
    sensors = np.array([label.sensor for label in snapshot.channels])
    n = float(snapshot.n_effective)
    data = np.einsum("fcc->fc", snapshot.csm).real
    size = np.sqrt(np.where(data > 0, data, np.nan))
    with np.errstate(invalid="ignore"):  # where a channel has no power
        coherency = snapshot.csm / (size[:, :, None] * size[:, None, :])
    bound = np.full(data.shape, np.nan)
    left = np.zeros(len(sensors))
    known = np.isfinite(coherency).all(axis=(1, 2))
    for column, sensor in enumerate(sensors):
        others = np.flatnonzero(sensors != sensor)
        left[column] = n - len(others)
        if left[column] <= 0:
            continue
        kept = np.concatenate([[column], others])
        part = coherency[known][:, kept[:, None], kept[None, :]]
        unpredicted = 1 / np.linalg.inv(part)[:, 0, 0].real
        bound[known, column] = unpredicted * n / left[column]
    return bound * snapshot.data_psd, left


def levels(test: str, result: Result) -> Iterator[Level]:
    """Yield every method, and the bound, of each channel in each octave."""
    snapshot = result.snapshot
    frequency = snapshot.frequency
    bound, left = model_free_bound(snapshot)
    top = _USED * 2 * frequency[-1]
    edges = top / 2.0 ** np.arange(np.log2(top / (4 * frequency[1])))[::-1]
    for low, high in pairwise(edges.tolist()):
        inside = (frequency >= low) & (frequency < high)
        mean = bound[inside].mean(axis=0)
        freedom = 2 * left * max(1.0, inside.sum() / _NEIGHBOURS)
        with np.errstate(invalid="ignore"):
            upper = mean * freedom / chi2.ppf(0.025, freedom)
            lower = mean * freedom / chi2.ppf(0.975, freedom)
        data = data_means(snapshot, (low, high))
        rows = {BOUND: [*zip(mean, lower, upper, strict=True)]}
        for method, noise in snapshot.results.items():
            means = result.means(method, (low, high))
            limits = ((noise.flags[inside] & Flag.UNIDENTIFIED) != 0).any(axis=0)  # no estimates
            rows[method] = [  # what the method itself says: huddle withdraws what is above a bound
                (nan, nan, nan) if is_limit else (each.mean[0], *(end[0] for end in each.scatter))
                for each, is_limit in zip(means, limits, strict=True)
                if each.scatter is not None
            ]
        for method, row in rows.items():
            channels = zip(snapshot.channels, data, row, upper, strict=True)
            for label, samples, (value, least, most), bound_above in channels:
                own = (test, label.sensor, label.channel, label.unit, low, high, method)
                is_above = method != BOUND and bool(least > bound_above)
                yield Level(*own, _db(samples), _db(value), _db(least), _db(most), is_above)


def _db(psd: float) -> float:
    return 10 * float(np.log10(psd)) if psd > 0 else float("nan")


def estimates_of(folder: Path, scratch: Path) -> Result:
    """Return the estimates of a folder of waveforms and responses by every method, and how.

    A single response file is taken for all channels, several by code and date.

    Raises
    ------
    HuddleError
        If the folder does not hold a test that can be estimated.
    """
    if not folder.is_dir():
        raise ImportFormatError(f"{folder}: expected a folder of waveforms and responses")
    files = [each for each in sorted(folder.rglob("*")) if each.is_file()]
    responses = [each for each in files if is_response(each)]
    waveforms = [each for each in files if each not in responses]
    out = scratch / "test.h5"
    assigned = []
    if len(responses) == 1 and _is_of_others(responses[0], waveforms):
        assigned, responses = [("*", responses[0])], []
    imported = import_files(waveforms, out, response=responses, response_for=assigned)
    for problem in imported.problems:
        notices().print(f"not imported: {problem}", soft_wrap=True)
    with Recording.open(out) as recording:
        duration = min(each.n_samples / each.sampling_rate for each in recording.sensors)
        units = {channel.unit for each in recording.sensors for channel in each.channels}
    segment = min(_LONGEST_S, max(_SHORTEST_S, duration / _SEGMENTS))
    settings = Settings(
        unit="m/s²" if all(map(is_motion, units)) else None,
        segment=round(segment, 1),
        methods=("all",),
    )
    return Result(estimate([out], settings), settings)


def _is_of_others(response: Path, waveforms: Sequence[Path]) -> bool:
    """Whether no waveform has the code of a response."""
    from daq.formats.sources import open_sources  # noqa: PLC0415 - seldom needed

    responses = Responses([response])
    sensors = open_sources(waveforms).sensors.values()
    for sensor in sensors:
        for channel in sensor.channels:
            try:
                responses.of(sensor.name, channel)
            except ImportFormatError:
                continue
            return False
    return True


def run(folders: Sequence[str], *, out: Path, json: str | None) -> bool:
    """Estimate public tests; write figures, print tables, say whether no method contradicts.

    Raises
    ------
    typer.BadParameter
        No folder was given.
    """
    if not folders:
        raise typer.BadParameter(f"{PUBLIC}: expected the FOLDER of a test after it, or several")
    check_places(json)
    require("matplotlib")
    from tui.studies.figures import save  # noqa: PLC0415 - matplotlib takes a second

    out.mkdir(parents=True, exist_ok=True)
    found: list[Level] = []
    figures: list[str] = []
    failed = False
    for number, folder in enumerate(map(Path, folders)):
        with TemporaryDirectory() as scratch:
            try:
                result = estimates_of(folder, Path(scratch))
            except (HuddleError, ValueError) as error:
                notices().print(f"{folder}: {error}", soft_wrap=True)
                failed = True
                continue
        name = folder.resolve().name
        own = list(levels(name, result))
        found += own
        _print(own, json)
        figures += map(str, save(_study(f"{PUBLIC}-{number + 1}", name, result.snapshot), out))
    for_people(json).print(f"Figures in {out}.")
    write_json(json, {"levels": [asdict(each) for each in found], "figures": figures})
    return not failed and not any(each.contradicts for each in found)


def _study(name: str, title: str, snapshot: Snapshot) -> Study:
    bound, _ = model_free_bound(snapshot)
    used = slice(4, int(_USED * 2 * len(snapshot.frequency)))
    panels = []
    for column, label in enumerate(snapshot.channels):
        curves = [("samples", snapshot.data_psd, "0.7"), (BOUND, bound, "k")]
        curves += [
            (method, noise.noise_psd, f"C{number}")
            for number, (method, noise) in enumerate(snapshot.results.items())
        ]
        panels.append(
            Panel(
                label.name,
                "frequency (Hz)",
                f"PSD (({label.unit})²/Hz)",
                curves=tuple(
                    StudyCurve(what, snapshot.frequency[used], _positive(psd[used, column]), style)
                    for what, psd, style in curves
                ),
                log="xy",
            )
        )
    return Study(name, title, tuple(panels))


def _positive(psd: FloatArray) -> FloatArray:
    return np.where(psd > 0, psd, np.nan)


def _print(found: Sequence[Level], json: str | None) -> None:
    """Print an octave a row, the mean of all channels that have a level."""
    methods = list(dict.fromkeys(each.method for each in found))
    unit = found[0].unit
    rows = []
    for low, high in dict.fromkeys((each.low_hz, each.high_hz) for each in found):
        band = [each for each in found if each.low_hz == low]
        cells = [f"{low:.3g}–{high:.3g} Hz", f"{_median([each.data for each in band]):.1f}"]
        for method in methods:
            own = [each for each in band if each.method == method]
            above = sum(each.contradicts for each in own)
            level = _median([each.noise for each in own])
            text = f"{level:.1f}" if isfinite(level) else "–"
            cells.append(f"{text} ({above} above)" if above else text)
        rows.append(tuple(cells))
    screen = for_people(json)
    screen.print(f"{found[0].test}: medians over the channels, dB re 1 ({unit})²/Hz")
    screen.print(Table(("band", "samples", *methods), tuple(rows), left=frozenset()))
    n_above = sum(each.contradicts for each in found)
    screen.print(
        f"{n_above} of {sum(each.method != BOUND for each in found)} levels, of one channel and"
        " octave each, contradict the bound: their interval lies above it."
    )


def _median(values: Sequence[float]) -> float:
    known = [each for each in values if each == each]  # noqa: PLR0124 - NaN
    return float(np.median(known)) if known else float("nan")
