"""Channels without samples for a while: the others count, and intervals hold the true noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

import huddle
from daq.errors import NotARecordingError
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.segments.clipping import limits_of
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.formats.importer import import_files
from daq.recording.reader import Recording
from daq.results.facts.model import SharedByTwo
from daq.results.facts.recordings import SpanShortened
from daq.results.facts.segments import ChannelsAbsent
from daq.results.result import Result
from estimator.checks.advice import Untested
from estimator.checks.advice_on_noise import ResponseChanges
from estimator.checks.count_limits import CountLimits
from estimator.levels.pooled import blocks_of
from estimator.self_noise.result import Flag, SelfNoise, combined
from estimator.spectra.segment_rejection import Reason

RATE, PART, N_PARTS = 20.0, 4000, 4
NOISE = 3.0
SETTINGS = Settings(segment=2.0, methods=("three-sensor",))
LOUDER = (1.0, 30.0, 2.0, 300.0)
"""Motion by part: averages of different parts do not fit together."""


def sensors(names: str, lacking: dict[str, list[int]], seed: int) -> dict[str, NDArray[np.float64]]:
    """Return triaxial sensors of one motion, each with NaN in parts that a channel lacks."""
    random = np.random.default_rng(seed)
    n = N_PARTS * PART
    motion = random.standard_normal((n, 3)) * np.repeat(LOUDER, PART)[:, None]
    found = {}
    for number, name in enumerate(names):
        turned, _ = np.linalg.qr(np.eye(3) + 0.1 * number * random.standard_normal((3, 3)))
        samples = motion @ turned + NOISE * random.standard_normal((n, 3))
        for column in range(3):
            for part in lacking.get(f"{name}{column}", []):
                samples[part * PART : (part + 1) * PART, column] = np.nan
        found[name] = samples
    return found


def estimated(
    names: str, lacking: dict[str, list[int]], seed: int = 1, settings: Settings = SETTINGS
) -> Snapshot:
    arrays = sensors(names, lacking, seed)
    return estimate([recording_of_arrays(arrays, RATE)], settings)


def deviations(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return by how many standard deviations the mean of all frequencies is off."""
    noise = snapshot.results["three-sensor"]
    inner = slice(2, -2)
    truth = 2 * NOISE**2 / RATE
    independent = len(noise.noise_psd[inner]) / 1.9  # neighbours under a Hann window
    spread = np.sqrt(noise.cumulants[0][inner].mean(axis=0) / independent)
    return np.asarray((noise.noise_psd[inner].mean(axis=0) - truth) / spread)


DAYS = {"A2": [1], "B0": [2, 3], "C1": [0]}
NEVER_TOGETHER = {"A2": [0, 1], "B0": [2, 3]}
WHOLE_SENSORS = {"A0": [1], "A1": [1], "A2": [1], "B0": [2], "B1": [2], "B2": [2]}


@pytest.mark.parametrize(
    ("names", "lacking", "octaves"),
    [
        ("ABC", DAYS, False),
        pytest.param("ABC", DAYS, True, marks=pytest.mark.long),
        ("ABC", NEVER_TOGETHER, False),
        ("ABC", NEVER_TOGETHER, True),
        ("ABCD", WHOLE_SENSORS, False),
    ],
)
def test_noise_is_right_where_channels_lack_samples(
    names: str, lacking: dict[str, list[int]], octaves: bool
) -> None:
    snapshot = estimated(names, lacking, settings=replace(SETTINGS, octaves=octaves))
    off = deviations(snapshot)
    assert np.isfinite(off).all()
    assert np.abs(off).max() < 4
    assert np.sqrt(np.mean(off**2)) < 1.7  # 12 values at most
    assert (len(snapshot.octaves) > 2) == octaves
    expected = [
        N_PARTS - len(lacking.get(f"{name}{column}", [])) for name in names for column in range(3)
    ]
    per_part = PART / RATE / SETTINGS.segment * 2
    np.testing.assert_allclose(
        snapshot.channel_segments, np.array(expected) * per_part, atol=N_PARTS
    )
    assert snapshot.n_dropped < 2 * N_PARTS


def test_two_sensors_that_are_alone_for_a_while_refuse_no_method() -> None:
    snapshot = estimated("ABC", {f"B{column}": [1] for column in range(3)})
    assert snapshot.results.keys() == {"three-sensor"}
    assert not snapshot.refused


@pytest.mark.parametrize("octaves", [False, True])
def test_segments_with_transients_are_left_out_of_every_set(octaves: bool) -> None:
    settings = replace(SETTINGS, octaves=octaves)
    arrays = sensors("ABC", NEVER_TOGETHER, 1)
    for second in range(5, 800, 40):  # on 5 % of the segments, of each set
        at = int(second * RATE)
        for each in arrays.values():
            each[at : at + 3] += 3e4
    recording = recording_of_arrays(arrays, RATE)
    with_them = deviations(estimate([recording], settings))
    snapshot = estimate([recording], replace(settings, reject=True))
    assert np.abs(with_them).max() > 20
    off = deviations(snapshot)
    assert np.abs(off).max() < 4
    assert snapshot.diagnostics.untested is Untested.INCOMPLETE
    assert np.nanmax(snapshot.results["three-sensor"].low) == -np.inf  # nothing is tested
    n_all = sum(snapshot.left_out.values())
    assert snapshot.left_out[Reason.TRANSIENT] >= 40
    assert snapshot.left_out[Reason.GAP] < 2 * N_PARTS
    assert n_all == snapshot.n_dropped


def test_octaves_have_the_channels_that_are_there() -> None:
    octaves = replace(SETTINGS, octaves=True)
    whole = estimated("ABC", {}, settings=octaves)
    lost = estimated("ABC", {"A2": [1]}, settings=octaves)
    # Bursts of motion disturb one octave: that is no change of a response.
    assert not any(isinstance(each, ResponseChanges) for each in whole.diagnostics.advice)
    assert len(lost.octaves) >= len(whole.octaves) - 1 > 2
    assert lost.octaves[0].low == 0
    left_out = [sum(octave.left_out.values()) for octave in lost.octaves]
    assert max(left_out[-2:]) <= 4
    assert left_out[0] > 4  # too few averages of the set
    few = lost.results["three-sensor"].cov[-20:-2].mean(axis=0)
    all_of_it = whole.results["three-sensor"].cov[-20:-2].mean(axis=0)
    wider = few / all_of_it
    assert np.median(wider) < 1.05
    assert 1.1 < wider[2] < 1.3  # √(4/3) without a quarter


def test_octaves_of_few_complete_segments_are_those_of_the_sets() -> None:
    arrays = sensors("ABC", NEVER_TOGETHER, 1)
    for column in (arrays["A"][:, 2], arrays["B"][:, 0]):
        column[2 * PART - 100 : 2 * PART + 100] = 0.1  # some seconds that all channels have
    snapshot = estimate([recording_of_arrays(arrays, RATE)], replace(SETTINGS, octaves=True))
    assert len(snapshot.octaves) > 2
    assert np.isfinite(snapshot.results["three-sensor"].noise_psd[2:-1]).all()
    assert sum(snapshot.left_out.values()) == snapshot.n_dropped > 4


@pytest.mark.parametrize(
    ("methods", "only"),
    [(("three-sensor",), ()), (("all",), ("two-channel", "three-channel", "multi-part"))],
)
def test_methods_that_pair_channels_by_number_are_named(
    methods: tuple[str, ...], only: tuple[str, ...]
) -> None:
    snapshot = estimated("ABC", {"B0": [1]}, settings=replace(SETTINGS, methods=methods))
    (fact,) = [
        each for each in Result(snapshot, Settings()).facts if isinstance(each, ChannelsAbsent)
    ]
    assert set(fact.complete_only) == set(only)


@pytest.mark.parametrize(
    ("parts", "octaves"), [([0], False), ([3], False), ([0, 3], True)], ids=str
)
def test_a_sensor_that_begins_late_or_ends_early_costs_three_others_nothing(
    parts: list[int], octaves: bool
) -> None:
    lacking = {f"D{column}": parts for column in range(3)}
    snapshot = estimated("ABCD", lacking, settings=replace(SETTINGS, octaves=octaves))
    off = deviations(snapshot)
    assert np.abs(off).max() < 4
    assert np.sqrt(np.mean(off**2)) < 1.7
    assert snapshot.elapsed == N_PARTS * PART / RATE
    per_part = PART / RATE / SETTINGS.segment * 2
    counts = np.array(snapshot.channel_segments)
    np.testing.assert_allclose(counts[:9], N_PARTS * per_part, atol=N_PARTS)
    np.testing.assert_allclose(counts[9:], (N_PARTS - len(parts)) * per_part, atol=N_PARTS)
    assert not [
        fact for fact in Result(snapshot, Settings()).facts if isinstance(fact, SpanShortened)
    ]


def test_a_third_sensor_that_begins_late_shortens_the_estimate_and_is_named() -> None:
    snapshot = estimated("ABC", {f"B{column}": [0] for column in range(3)})
    assert snapshot.elapsed == (N_PARTS - 1) * PART / RATE
    (fact,) = [
        fact for fact in Result(snapshot, Settings()).facts if isinstance(fact, SpanShortened)
    ]
    assert (fact.sensors, fact.unused, fact.at_end) == (("B",), PART / RATE, False)


def test_a_live_estimate_has_them_too(tmp_path: Path) -> None:
    path = imported(tmp_path, DAYS)
    with Estimation([path], SETTINGS) as live:
        live.update()
        growing = live.snapshot()
        final = live.finish()
    assert growing.channel_segments == final.channel_segments != ()
    np.testing.assert_array_equal(
        growing.results["three-sensor"].noise_psd, final.results["three-sensor"].noise_psd
    )


def test_a_part_without_any_channel_missing_gives_the_same_as_alone() -> None:
    whole = sensors("ABC", {}, 1)
    cut = {name: samples[: 2 * PART].copy() for name, samples in whole.items()}
    alone = estimate([recording_of_arrays(cut, RATE)], SETTINGS)
    assert alone.channel_segments == ()
    whole["A"][2 * PART :] = np.nan  # two sensors give no result by this method
    lost = estimate([recording_of_arrays(whole, RATE)], SETTINGS)
    np.testing.assert_array_equal(lost.csm, alone.csm)
    for one, other in zip(lost.results.values(), alone.results.values(), strict=True):
        np.testing.assert_array_equal(one.noise_psd, other.noise_psd)
    assert lost.channel_segments == ()


def test_short_holes_in_a_channel_are_gaps_as_before() -> None:
    given = sensors("ABC", {}, 1)
    given["B"][::400, 1] = np.nan
    snapshot = estimate([recording_of_arrays(given, RATE)], SETTINGS)
    assert snapshot.channel_segments == ()
    assert snapshot.left_out  # those with holes


@pytest.mark.parametrize("methods", [("auto",), ("maximum-likelihood", "three-sensor")])
def test_two_that_share_noise_are_named_beside_a_channel_with_gaps(
    methods: tuple[str, ...],
) -> None:
    """The others count by themselves; C and D share noise, and keep their places."""
    rng, n = np.random.default_rng(3), 6000
    motion, source = rng.normal(0, 1, n), rng.normal(0, 4, n)
    given = {name: motion + rng.normal(0, 1, n) + source * (name in "CD") for name in "ABCDEFG"}
    given["A"][50::40] = np.nan
    settings = Settings(segment=2.0, methods=methods, bridge=0.0, dimension="auto")
    result = Result(estimate([recording_of_arrays(given, RATE)], settings), settings)
    (fact,) = (each for each in result.facts if isinstance(each, SharedByTwo))
    assert fact.sensors == ("C", "D")
    for method in result.snapshot.results:
        low = [means.low[0] for means in result.means(method, (3.0, 9.0))]
        assert max(low[2:4]) < 2 * 2 / RATE


def imported(tmp_path: Path, lacking: dict[str, list[int]]) -> Path:
    arrays = {name: np.rint(each * 50) for name, each in sensors("ABC", lacking, 2).items()}
    source, out = tmp_path / "given.npz", tmp_path / "given.h5"
    start = {"start_time": "2026-11-25T00:00:00"}
    np.savez(source, sampling_rate=RATE, **arrays, **start)  # type: ignore[arg-type]
    import_files([source], out)
    return out


def test_a_recording_says_where_channels_have_no_samples(tmp_path: Path) -> None:
    path = imported(tmp_path, DAYS)
    with h5py.File(path) as file:
        assert file.attrs["format_version"] == 3
        absent = file["sensors/B/samples"].attrs["absent"]
        np.testing.assert_array_equal(absent, [[0, 2 * PART, 4 * PART]])
    with Recording.open(path) as recording:
        assert limits_of(recording.sensor("B")) == CountLimits({}, {}, {}, {})
    opened = huddle.open(path)
    samples = opened.samples("B")
    assert np.isnan(samples[2 * PART :, 0]).all()
    assert np.isfinite(samples[:, 1:]).all()
    result = huddle.estimate(path, segment=2.0)
    read = huddle.read(tmp_path / "given.npz")
    np.testing.assert_array_equal(huddle.self_noise(read, segment=2.0).noise_psd, result.noise_psd)
    (fact,) = [each for each in result.facts if each.name == "channels-absent"]
    assert len(fact.channels) == 3
    (tmp_path / "all").mkdir()
    complete = imported(tmp_path / "all", {})
    with h5py.File(complete) as file:
        assert file.attrs["format_version"] == 2
        assert "absent" not in file["sensors/B/samples"].attrs


def test_rows_absent_from_other_columns_are_refused(tmp_path: Path) -> None:
    path = imported(tmp_path, DAYS)
    with h5py.File(path, "r+") as file:
        file["sensors/B/samples"].attrs["absent"] = np.array([[3, 0, 10]])
    with pytest.raises(NotARecordingError, match="absent of other columns"):
        Recording.open(path)


def test_exported_channels_have_no_samples_where_they_are_absent(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy", reason="ObsPy is an extra")
    path = imported(tmp_path, DAYS)
    huddle.export(path, tmp_path / "out.mseed")
    stream = obspy.read(str(tmp_path / "out.mseed"), format="MSEED").merge()
    lengths = [[0] * 3 for _ in "ABC"]
    for trace in stream:
        lengths["ABC".index(trace.stats.station)]["123".find(trace.stats.channel[-1])] += int(
            np.ma.count(trace.data)
        )
    lacking = sum(map(len, DAYS.values()))
    assert sum(map(sum, lengths)) == (9 * N_PARTS - lacking) * PART


def test_estimates_combine_by_their_precision() -> None:
    random = np.random.default_rng(4)
    n_freqs, truth = 480, 2.0
    blocks = blocks_of(np.linspace(0, 50, n_freqs))

    def part(n: int) -> SelfNoise:
        psd = truth * random.gamma(n, 1 / n, (n_freqs, 1))
        cumulants = np.stack([psd**2 / n, 2 * psd**3 / n**2, 6 * psd**4 / n**3])
        return SelfNoise.of("three-sensor", psd, cumulants, np.zeros((n_freqs, 1), np.int64))

    parts = [part(40), part(160)]
    parts[1].noise_psd[:48] = np.nan
    whole = combined(parts, blocks)
    np.testing.assert_array_equal(whole.noise_psd[:48], parts[0].noise_psd[:48])
    rest = whole.noise_psd[48:]
    assert rest.mean() == pytest.approx(truth, abs=4 * truth / np.sqrt(200 * len(rest)))
    assert rest.std() == pytest.approx(truth / np.sqrt(200), rel=0.15)
    assert whole.cumulants[0, 48:].mean() == pytest.approx(truth**2 / 200, rel=0.1)
    assert combined(parts[:1], blocks) is parts[0]
    parts[0].noise_psd[:48] = np.nan
    parts[0].flags[:48] = int(Flag.SINGULAR)
    nowhere = combined(parts, blocks)
    assert np.isnan(nowhere.noise_psd[:48]).all()
    assert (nowhere.flags[:48] == int(Flag.SINGULAR)).all()
