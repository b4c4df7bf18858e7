"""Where a mask is judged: bands, notches, the ends of the spectrum, units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.bench.loading import parse
from daq.results.decision.limits import mask_psd
from daq.results.result import Result
from estimator.decision.comparison import mask_edges
from estimator.decision.verdict import Obstacle, Verdict
from estimator.self_noise.result import SelfNoise
from tests.daq.results.decision.benches import PLAIN, bench_with, verdict_on
from tests.tui.example_snapshot import SETTINGS, made_snapshot
from tui.wording.verdict_text import not_judged


def test_a_mask_outside_the_spectrum_decides_nothing() -> None:
    found = verdict_on(made_snapshot(), 1e-15, frequency=(300.0, 400.0))
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.OUTSIDE_SPECTRUM,)
    assert found.prediction is None


def test_a_band_is_judged_only_if_all_of_it_is_known() -> None:
    snapshot = made_snapshot(n_effective=5000.0)
    noise = snapshot.results["three-sensor"]
    psd = noise.noise_psd.copy()
    psd[25, 0] = np.nan  # 12.5 Hz
    found = verdict_on(
        replace(snapshot, results={"three-sensor": replace(noise, noise_psd=psd)}), 12e-12
    )
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.NO_ESTIMATE,)


@pytest.mark.parametrize(
    ("psd", "verdict"),
    [
        ((12e-12, 12e-12, 4e-12, 4e-12, 12e-12, 12e-12), Verdict.FAIL),  # noise up to 9e-12
        ((12e-12, 12e-12, 11e-12, 11e-12, 12e-12, 12e-12), Verdict.PASS),
    ],
)
def test_a_mask_is_judged_in_a_notch_narrower_than_a_band(
    psd: tuple[float, ...], verdict: Verdict
) -> None:
    points = (1.0, 15.9, 16.0, 17.0, 17.1, 30.0)
    found = verdict_on(made_snapshot(n_effective=20_000.0), psd, frequency=points)
    assert found.verdict is verdict
    if verdict is Verdict.FAIL:
        assert all(15.9 < each.frequency < 17.1 for each in found.having(Verdict.FAIL))


@pytest.mark.parametrize(("slope", "divided"), [(-15.0, True), (-14.0, False)])
def test_the_point_of_a_mask_divides_a_band_where_it_bends_by_a_factor_of_two(
    slope: float, *, divided: bool
) -> None:
    """Beside the straight line from the first to the last frequency of the band."""
    spectrum = np.linspace(0.0, 100.0, 201)
    mask = np.maximum(spectrum / 41, 1.0) ** slope
    edges = mask_edges(spectrum, mask, np.array([1.0, 41.0, 90.0]), known=(0.0, np.inf))
    assert (82 in edges) is divided


def test_a_band_of_one_frequency_is_named_by_it() -> None:
    found = verdict_on(made_snapshot(), 12e-12, frequency=(1.0, 2.0))
    assert {each.frequency for each in found.limits} <= {1.0, 1.5, 2.0}


def test_a_mask_is_in_the_unit_of_its_own_channel() -> None:
    """Another channel of the bench file has another unit."""
    bench = bench_with(12e-12)
    first, *others = bench.sensors
    channels = [replace(each, unit="m/s") for each in first.channels]
    bench = bench.model_copy(
        update={"sensors": [first.model_copy(update={"channels": channels}), *others]}
    )
    label = made_snapshot().channels[3]
    psd = mask_psd(bench, bench.limits[0], label, np.array([1.0, 10.0]))
    np.testing.assert_allclose(psd, 12e-12)


def test_a_mask_is_in_the_unit_of_the_bench_file() -> None:
    snapshot = made_snapshot(n_effective=1000.0)
    scale = 9.80665e-6**-2  # (µg)² in (m/s²)²
    (noise,) = [snapshot.results["three-sensor"]]
    in_micro_g = replace(
        snapshot,
        unit="µg",
        csm=snapshot.csm * scale,
        channels=tuple(replace(label, unit="µg") for label in snapshot.channels),
        results={
            "three-sensor": SelfNoise.of(
                noise.method,
                noise.noise_psd * scale,
                noise.cumulants * np.array([scale**k for k in (2, 3, 4)])[:, None, None],
                noise.flags,
            )
        },
    )
    found = verdict_on(in_micro_g, 6.5e-12)
    assert [each.name for each in found.having(Verdict.FAIL)] == ["C.X", "C.Y", "C.Z"]


@pytest.mark.parametrize(
    ("low", "high", "judged", "words"),
    [
        (1.0, 30.0, (1.0, 30.0), []),
        (1.0, 100.0, (1.0, 100.0), []),  # the spectrum goes to 100 Hz
        (1.0, 400.0, (1.0, 99.5), ["above 99.5 Hz", "from 1 to 400 Hz"]),
        (0.01, 30.0, (0.5, 30.0), ["below 0.5 Hz", "from 0.01 to 30 Hz"]),
        (0.01, 400.0, (0.5, 99.5), ["below 0.5 Hz and above 99.5 Hz"]),
    ],
)
def test_where_a_mask_goes_beyond_the_spectrum_the_verdict_says_so(
    low: float, high: float, judged: tuple[float, float], words: list[str]
) -> None:
    found = verdict_on(made_snapshot(n_effective=5000.0), 12e-12, frequency=(low, high))
    assert found.verdict is Verdict.PASS
    assert {(each.covers, each.judged) for each in found.limits} == {((low, high), judged)}
    lines = not_judged(found)
    assert len(lines) == bool(words)
    assert all(word in lines[0] for word in words)


def test_unusable_high_frequencies_are_not_judged_and_said() -> None:
    """Resampling leaves nothing to be said above some frequency."""
    snapshot = made_snapshot(n_effective=5000.0)
    csm, known = snapshot.csm.copy(), snapshot.frequency <= 45
    csm[~known] = np.nan
    blank = np.where(known[:, None], 1.0, np.nan)
    results = {
        name: replace(noise, noise_psd=noise.noise_psd * blank, cov=noise.cov * blank)
        for name, noise in snapshot.results.items()
    }
    known_to_45 = replace(snapshot, csm=csm, results=results)
    found = verdict_on(known_to_45, 12e-12, frequency=(1.0, 90.0))
    assert found.verdict is Verdict.PASS
    (line,) = not_judged(found)
    assert found.limits[0].judged == (1.0, 45.0)
    assert "above 45 Hz" in line


def test_a_model_is_a_limit_in_any_unit() -> None:
    """The ground's noise models are in m/s²; the channels of this bench are, too."""
    more = '[[limits]]\nname = "loud"\nmodel = "ahnm"\n[[limits]]\nname = "quiet"\nmodel = "nlnm"'
    found = Result(made_snapshot(n_effective=5000.0), SETTINGS, parse(f"{PLAIN}\n{more}")).verdict
    assert found is not None
    verdicts = {(each.limit, each.verdict) for each in found.limits}
    # noise of -120 to -110 dB: below -91 dB in part, above -120 dB at 0.8 s, above the NLNM
    assert verdicts == {("loud", Verdict.FAIL), ("quiet", Verdict.FAIL), ("loud", Verdict.PASS)}


def test_a_smooth_mask_of_many_points_has_no_more_bands_than_one_of_two() -> None:
    """However steep it is."""
    spectrum = np.linspace(0.0, 100.0, 201)
    points = np.geomspace(1.0, 90.0, 300)
    mask = 1e-9 * np.clip(spectrum, 1.0, 90.0) ** -4
    many, two = (
        mask_edges(spectrum, mask, each, known=(0.0, np.inf)) for each in (points, points[[0, -1]])
    )
    np.testing.assert_array_equal(many, two)
