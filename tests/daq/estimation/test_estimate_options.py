"""The estimator's options through a recording: rejection, octaves, dimension, gains, diagnosis."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfilt

import huddle
from daq.bench.channel import Channel
from daq.errors import CannotAlignError
from daq.estimation.contributions import contributions
from daq.estimation.diagnosis import vertical_channel
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.segments.flatline import FlatlineDetector
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError, Snapshot
from daq.protocols.block import Block, BlockFlag
from daq.results.facts.channels import ChannelsStoodStill, ChannelsWrap, ReadingsRepeat
from daq.results.result import Result
from estimator.checks.advice import Rank, Untested
from estimator.checks.advice_on_sensors import Gain, SwappedChannels
from estimator.checks.advice_on_signals import Copies, NoSharedMotion, NoSignal
from estimator.errors import InsufficientDataError
from estimator.levels.contributions import Source
from estimator.methods import Flag, self_noise
from estimator.spectra.segment_rejection import Reason
from estimator.spectra.welch import CrossSpectra, WelchSettings
from tests.daq.clocks.recordings import Sensor, arriving, create, write, written

RATE = 100.0
SETTINGS = Settings(segment=1.0)
N_SAMPLES = 12_000


def bench(
    channels: tuple[int, ...] = (3, 3, 3), *, n_samples: int = N_SAMPLES, motion: int = 3
) -> dict[str, Sensor]:
    """Sensors on one white motion of standard deviation 10⁴ in so many dimensions, noise of 10²."""
    rng = np.random.default_rng(7)
    directions = np.linalg.qr(rng.standard_normal((3, 3)))[0][:motion]
    common = rng.standard_normal((n_samples, motion)) @ directions * 1e4
    return {
        name: Sensor(
            np.rint(common[:, :d] + 100 * rng.standard_normal((n_samples, d))).astype(np.int32),
            clock="one",
        )
        for name, d in zip("abcdef", channels, strict=False)
    }


def spectra_of(sensors: dict[str, Sensor], starts: list[int]) -> CrossSpectra:
    """Spectra of these segments, straight from the samples."""
    spectra = CrossSpectra(
        WelchSettings(RATE, 100), sum(s.counts.shape[1] for s in sensors.values())
    )
    samples = np.hstack([sensor.counts for sensor in sensors.values()]).astype(float)
    spectra.add(samples, np.array(starts, dtype=np.int64))
    return spectra


def followed(path: Path, sensors: dict[str, Sensor], settings: Settings) -> Snapshot:
    """Write a recording bit by bit while it is followed; return how that ends."""
    writer = create(path, sensors)
    with Estimation([path], settings) as live:
        for number, block in enumerate(arriving(sensors)):
            writer.append(block)
            if number % 240 == 239:
                writer.commit()
                live.update()
                growing = live.snapshot()
                found = growing.diagnostics.diagnosis
                assert found is None or len(found.per_frequency.snr) == len(growing.frequency)
        writer.close()
        live.update()
        return live.finish()


def test_what_is_wrong_is_said_within_a_minute_while_recording(tmp_path: Path) -> None:
    """A sensor on another floor, swapped channels, a dead one and a clipped one."""
    sensors = bench((3, 3, 3, 3, 3), n_samples=6000)
    rng = np.random.default_rng(8)
    sensors["a"].counts[:] = np.rint(1e4 * rng.standard_normal((6000, 3)))
    sensors["b"].counts[:] = sensors["b"].counts[:, [1, 0, 2]]
    sensors["c"].counts[:, 2] = 0
    np.clip(sensors["d"].counts[:, 0], -15000, 15000, out=sensors["d"].counts[:, 0])
    writer = written(tmp_path / "r.h5", sensors)
    writer.commit()
    with Estimation([tmp_path / "r.h5"], SETTINGS) as live:
        live.update()
        snapshot = live.snapshot()
    writer.close()
    assert not snapshot.closed
    (stranger,) = [a for a in snapshot.diagnostics.advice if isinstance(a, NoSharedMotion)]
    assert stranger.sensors == (0,)
    assert stranger.share < 0.05
    (dead,) = [a for a in snapshot.diagnostics.advice if isinstance(a, NoSignal)]
    assert dead.channels == (8,)
    swapped = [a for a in snapshot.diagnostics.advice if isinstance(a, SwappedChannels)]
    assert swapped
    assert all(1 in each.sensors for each in swapped)
    assert list(snapshot.diagnostics.counts.clipped) == [9]


def test_a_sensor_whose_time_is_18_s_off_bounds_no_octave() -> None:
    """The seconds between GPS time and UTC; it has no level in any octave, and none is too high."""
    rng = np.random.default_rng(18)
    motion = 30 * rng.standard_normal((60_000, 3))
    samples = {name: motion + rng.standard_normal(motion.shape) for name in "ABC"}
    samples["A"] = np.roll(motion, 1800, axis=0) + rng.standard_normal(motion.shape)
    snapshot = huddle.self_noise(samples, fs=100.0, segment="10s", octaves=True).snapshot
    found = Result(snapshot, Settings())
    for edge in (0.5, 2.0, 12.0, 30.0):
        for mean in found.means(found.method, (edge, 1.5 * edge)):
            assert mean.low[0] <= 0.02 <= mean.high[0]


@pytest.mark.parametrize(
    "options",
    [
        {"reject": True},
        pytest.param({"octaves": True}, marks=pytest.mark.long),
        {"octaves": True, "reject": True},
        pytest.param(
            {"dimension": "auto", "methods": ("maximum-likelihood",)}, marks=pytest.mark.long
        ),
    ],
    ids=["reject", "octaves", "undisturbed octaves", "dimension"],
)
def test_what_was_followed_ends_as_the_estimate_from_the_file(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    sensors = bench()
    if "reject" in options:
        sensors["b"].counts[6010:6020] += 3_000_000  # someone knocks
    sensors["c"].gaps = ((8000, 8100),)
    settings = replace(SETTINGS, **options)
    live = followed(tmp_path / "r.h5", sensors, settings)
    offline = estimate([tmp_path / "r.h5"], settings)
    assert live.left_out == offline.left_out
    assert live.octaves == offline.octaves
    if "reject" in options:
        assert live.left_out[Reason.TRANSIENT] == 2
        assert all(octave.left_out[Reason.TRANSIENT] == 2 for octave in live.octaves[-1:])
    if live.octaves:
        assert live.n_segments == live.octaves[-1].n_segments
    (one,), (other,) = live.results.values(), offline.results.values()
    np.testing.assert_allclose(one.noise_psd, other.noise_psd, rtol=1e-9)
    np.testing.assert_allclose(one.cov, other.cov, rtol=1e-9)


@pytest.mark.parametrize("slope", [0.0, 3.7])
def test_a_channel_that_is_not_measured_for_a_while_counts_as_faulty(
    slope: float, tmp_path: Path
) -> None:
    sensors = bench()
    sensors["b"].counts[4000:7000, 1] = np.rint(17 + slope * np.arange(3000))
    settings = replace(SETTINGS, reject=False)
    found = estimate([write(tmp_path / "r.h5", sensors)], settings)
    assert found.diagnostics.stood_still == {4: pytest.approx(30, abs=1)}
    result = Result(found, settings)
    (fact,) = (each for each in result.facts if isinstance(each, ChannelsStoodStill))
    assert (fact.rank, fact.channels) == (Rank.INVALIDATES, (found.channels[4].name,))
    parts = contributions(found, next(iter(found.results)))
    (faulty,) = (each for each in parts if each.source is Source.FAULTY)
    assert np.flatnonzero(np.isinf(faulty.below).all(axis=0)).tolist() == [4]
    gains = [each for each in found.diagnostics.advice if isinstance(each, Gain)]
    assert not gains  # it stood still: its sensitivity is not wrong


def test_gaps_of_all_sensors_that_are_interpolated_are_in_the_interval(tmp_path: Path) -> None:
    sensors = bench()
    for sensor in sensors.values():
        for begin in range(500, N_SAMPLES, 3000):  # 10 % of the time, in steps that round
            ends = sensor.counts[[begin, begin + 300]]
            lines = ends[0] + np.linspace(0, 1, 301)[:, None] * (ends[1] - ends[0])
            sensor.counts[begin : begin + 301] = np.rint(lines)
    found = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    assert sorted(found.diagnostics.stood_still) == list(range(9))
    assert min(found.diagnostics.stood_still.values()) > 8
    (mean,) = Result(found, SETTINGS).means(next(iter(found.results)), (2.0, 40.0))[:1]
    noise = 2 / RATE * 100**2
    assert float(mean.mean[0]) < 0.95 * noise < noise < float(mean.high[0])


@pytest.mark.parametrize("decimals", [4, 17])
def test_lines_of_decimals_are_seen_but_for_their_rounding(decimals: int) -> None:
    samples = np.round(np.random.default_rng(2).standard_normal((60_000, 1)), decimals)
    samples[10_000:13_000, 0] = np.round(np.linspace(0.3, -0.8, 3_000), decimals)
    detector = FlatlineDetector(500, 1, RATE)
    detector.add(samples, np.ones(len(samples), np.bool_))
    assert detector.for_a_while()[0] == pytest.approx(30, abs=1)


@pytest.mark.parametrize("counts", [0, 200])
def test_gaps_that_a_spline_fills_are_seen(counts: int) -> None:
    samples = np.random.default_rng(3).standard_normal(60_000) * max(counts, 1)
    known = np.r_[9_980:10_000, 10_500:10_520]
    samples[10_000:10_500] = CubicSpline(known, samples[known])(np.arange(10_000, 10_500))
    samples = np.rint(samples) if counts else samples
    detector = FlatlineDetector(500, 1, RATE)
    detector.add(samples[:, None], np.ones(len(samples), np.bool_))
    assert detector.for_a_while()[0] == pytest.approx(5, abs=1)


@pytest.mark.parametrize("unit", [1.0, 1.2345e-9])
@pytest.mark.parametrize("counts", [0, 1000])
def test_short_gaps_that_lines_fill_are_seen(counts: int, unit: float) -> None:
    rng = np.random.default_rng(5)
    samples = rng.standard_normal((60_000, 2)) * max(counts, 1)
    for at in 100 * rng.choice(np.arange(1, 599), 50, replace=False):
        before, after = samples[[at - 1, at + 8], 1]
        samples[at : at + 8, 1] = np.linspace(before, after, 10)[1:-1]
    samples = np.rint(samples) if counts else samples
    detector = FlatlineDetector(500, 2, RATE)
    for some in np.split(unit * samples, 6):
        detector.add(some, np.ones(len(some), np.bool_))
    assert detector.for_a_while() == pytest.approx([0, 50 * 8 / RATE], rel=0.1)


@pytest.mark.parametrize("unit", [1.0, 1.2345e-9])
def test_coarse_counts_are_no_lines(unit: float) -> None:
    """Of three counts, one of a few second differences is 0, four times together by chance."""
    samples = unit * np.rint(3 * np.random.default_rng(6).standard_normal((60_000, 2)))
    detector = FlatlineDetector(500, 2, RATE)
    detector.add(samples, np.ones(len(samples), np.bool_))
    assert detector.for_a_while().tolist() == [0, 0]


def test_slow_motion_in_coarse_counts_or_gusts_is_not_interpolated() -> None:
    rng, time = np.random.default_rng(0), np.arange(60_000) / RATE
    samples = np.rint(1000 * np.sin(2 * np.pi * 0.1 * time))[:, None].repeat(9, axis=1)
    slow, gusts = (
        sosfilt(butter(order, low, output="sos"), rng.standard_normal((60_000, 8)), axis=0)
        for order, low in ((4, 0.005), (2, 2e-4))
    )
    samples[:, 1:] = slow * np.exp(1.5 * gusts / gusts.std(axis=0))
    detector = FlatlineDetector(200, 9, RATE)
    detector.add(samples, np.ones(len(samples), np.bool_))
    assert detector.for_a_while().tolist() == [0] * 9


def test_clipped_blocks_are_left_out_unless_that_is_turned_off(tmp_path: Path) -> None:
    def clipped(block: Block) -> Block:
        if block.sensor != "b" or block.first_sample != 5000:  # samples 5000 to 5199
            return block
        counts = np.full_like(block.counts, 70_000)
        return replace(block, flags=block.flags | BlockFlag.CLIPPED, counts=counts)

    sensors = bench()
    found = estimate([write(tmp_path / "r.h5", sensors, clipped)], SETTINGS)
    assert not found.diagnostics.counts.clipped  # what says so itself is left out
    kept = [start for start in range(0, N_SAMPLES - 99, 50) if not 4900 < start < 5200]
    assert found.left_out == {"gap": 0, "clipped": 5, "transient": 0, "chosen": 0, "repeated": 0}
    direct = spectra_of(sensors, kept).csm()
    np.testing.assert_allclose(found.csm[2:], direct[2:], rtol=1e-9, atol=1e-3)
    assert estimate([tmp_path / "r.h5"], replace(SETTINGS, reject=False)).n_dropped == 0


def test_channels_that_are_cut_off_without_saying_so_are_named(tmp_path: Path) -> None:
    sensors = bench()
    n = np.arange(N_SAMPLES)
    sensors["a"].counts[:, 0] = np.rint(3000 * np.sin(2 * np.pi * n / 77.7))  # a shaker is no fault
    sensors["a"].counts[:, 2] = np.rint(sensors["a"].counts[:, 2] / 1e4)  # nor are few values
    sensors["b"].counts[:, 1] = np.clip(sensors["b"].counts[:, 1], -30_000, 20_000)
    sensors["c"].counts[:, 1] = 5
    found = estimate([write(tmp_path / "r.h5", sensors)], replace(SETTINGS, methods=("all",)))
    shares = found.diagnostics.counts.clipped
    assert set(shares) == {4}  # b.c1
    at_ends = np.mean(
        (sensors["b"].counts[:, 1] == 20_000) | (sensors["b"].counts[:, 1] == -30_000)
    )
    assert shares[4] == pytest.approx(at_ends, rel=0.2)


def test_counts_that_wrap_and_readings_that_repeat_invalidate_a_result(tmp_path: Path) -> None:
    sensors = bench()
    slow = np.repeat(sensors["a"].counts[::5], 5, axis=0)[:N_SAMPLES]
    sensors["a"].counts[:] = slow  # polled five times as often as it refreshes
    n = np.arange(N_SAMPLES)
    swell = 40_000 * np.sin(2 * np.pi * n / 777)[:, None]
    sensors["b"].counts[:] = (sensors["b"].counts // 100 + swell + 32768) % 65536 - 32768
    found = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    facts = {each.name: each for each in Result(found, SETTINGS).facts}
    assert isinstance(wrap := facts["channels-wrap"], ChannelsWrap)
    assert wrap.bits == (16, 16, 16)
    assert isinstance(repeat := facts["readings-repeat"], ReadingsRepeat)
    assert repeat.sensors == ("a",)
    assert repeat.refresh == pytest.approx(repeat.polled / 5, rel=0.01)
    assert {wrap.rank, repeat.rank} == {Rank.INVALIDATES}
    assert found.diagnostics.faulty == {*range(6)}


@pytest.mark.parametrize(
    ("reject", "duration"),
    [
        (None, 5),
        pytest.param(True, 5, marks=pytest.mark.long),
        pytest.param(True, 30, marks=pytest.mark.long),
    ],
)
def test_a_channel_that_was_dead_for_a_while_is_named_and_its_sensitivity_is_not_blamed(
    tmp_path: Path, reject: bool | None, duration: int
) -> None:
    sensors = bench()
    sensors["b"].counts[3000 : 3000 + 100 * duration, 1] = 7
    sensors["a"].counts[:, 2] = np.rint(sensors["a"].counts[:, 2] / 3e4)  # coarse, often at rest
    sensors["c"].counts[:, 0] = 5  # dead throughout is said elsewhere
    found = estimate([write(tmp_path / "r.h5", sensors)], replace(SETTINGS, reject=reject))
    blamed = [each for each in found.diagnostics.advice if isinstance(each, Gain)]
    assert not any(4 in {each.channel, each.counterpart} for each in blamed)  # b.c1
    if reject and duration == 5:  # all of it is left out; what lasts is taken for a new level
        assert not found.diagnostics.stood_still
        assert found.left_out[Reason.TRANSIENT] >= 9
    else:
        assert set(found.diagnostics.stood_still) == {4}
        assert found.diagnostics.stood_still[4] == pytest.approx(duration, abs=1)


def test_octaves_join_at_the_true_noise_from_far_below_one_over_the_segment(tmp_path: Path) -> None:
    snapshot = estimate(
        [write(tmp_path / "r.h5", bench(n_samples=40_000))], replace(SETTINGS, octaves=True)
    )
    assert snapshot.octaves[0].segment >= 16 * snapshot.octaves[-1].segment == 16.0
    assert all(o.n_effective >= 20 for o in snapshot.octaves)
    assert np.all(np.diff(snapshot.frequency) > 0)
    assert snapshot.frequency[1] <= 1 / 16
    assert snapshot.frequency[-1] == RATE / 2
    truth = 100.0**2 / (RATE / 2)
    noise = snapshot.results["three-sensor"]
    for octave in snapshot.octaves:
        inside = (snapshot.frequency > 0) & (snapshot.frequency < RATE / 2)
        inside &= (snapshot.frequency >= octave.low) & (snapshot.frequency <= octave.high)
        inside[:2] = False  # bent by the mean
        mean = noise.noise_psd[inside].mean()
        std = np.median(noise.cov[inside]) * truth / np.sqrt(inside.sum() * 9 / 1.5)
        assert abs(mean - truth) < 4 * std


def test_octaves_of_several_recordings_add(tmp_path: Path) -> None:
    sensors = {name: replace(each, utc=True) for name, each in bench(n_samples=3000).items()}
    later = {name: replace(each, start=60.0) for name, each in sensors.items()}
    paths = [write(tmp_path / "1.h5", sensors), write(tmp_path / "2.h5", later)]
    settings = replace(SETTINGS, octaves=True, methods=("three-sensor",))
    once, twice = estimate(paths[:1], settings), estimate(paths, settings)
    assert twice.octaves[-1].n_segments == 2 * once.octaves[-1].n_segments
    top = once.frequency > once.octaves[-1].low
    np.testing.assert_allclose(
        twice.csm[-top.sum() :], once.csm[top], rtol=1e-9, atol=1e-9 * np.nanmax(np.abs(once.csm))
    )


def test_the_dimension_is_chosen_by_band_and_lowers_the_scatter(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", bench(motion=1))
    usual = replace(SETTINGS, methods=("maximum-likelihood",))
    found = estimate([path], replace(usual, dimension="auto"))
    choices = found.diagnostics.dimensions
    assert sum(choice.n_factors == 1 for choice in choices) >= 0.8 * len(choices)
    one, three = (estimate([path], replace(usual, dimension=q)) for q in (1, None))
    with_one, with_three = (each.results["maximum-likelihood"].cov for each in (one, three))
    diagnoses = [each.diagnostics.diagnosis for each in (one, three, found)]
    assert [each.n_factors for each in diagnoses if each is not None] == [1, 3, 3]
    assert np.nanmedian(with_one[1:-1]) < 0.9 * np.nanmedian(with_three[1:-1])
    with pytest.raises(InsufficientDataError, match="at most"):
        estimate([path], replace(usual, dimension=9))


def test_while_live_the_dimension_is_chosen_anew_when_segments_have_doubled(
    tmp_path: Path,
) -> None:
    sensors = bench()
    writer = create(tmp_path / "r.h5", sensors)
    settings = replace(SETTINGS, methods=("maximum-likelihood",), dimension="auto")
    chosen_at: list[int] = []
    last, n_before = None, 0
    with Estimation([tmp_path / "r.h5"], settings) as live:
        for number, block in enumerate(arriving(sensors)[:480]):  # 80 s, 160 segments
            writer.append(block)
            if number % 30 == 29:
                writer.commit()
                live.update()
                choices = live.snapshot().diagnostics.dimensions
                if choices and choices is not last:
                    chosen_at.append(n_before if chosen_at else live.n_segments)
                    last = choices
                n_before = live.n_segments
                if (choice := live.choose_again()) is not None:
                    choice.result()
        writer.close()
    assert len(chosen_at) >= 3
    assert all(later >= 2 * earlier for earlier, later in pairwise(chosen_at))


def test_gains_known_beforehand_are_those_of_the_two_channel_method(tmp_path: Path) -> None:
    sensors = bench((1, 1))
    sensors["b"].counts *= 3
    path = write(tmp_path / "r.h5", sensors)
    settings = replace(SETTINGS, methods=("two-channel",), gains={"b": 3.0})
    found = estimate([path], settings)
    known = self_noise(
        "two-channel",
        found.csm,
        dims=(1, 1),
        n_effective=found.n_effective,
        response=np.array([1, 3], dtype=complex),
    )
    np.testing.assert_array_equal(found.results["two-channel"].noise_psd, known.noise_psd)
    by_channel = estimate([path], replace(settings, gains={"b.c0": 3.0}))
    np.testing.assert_array_equal(by_channel.results["two-channel"].noise_psd, known.noise_psd)
    assert found.diagnostics.untested is Untested.TOO_FEW_SENSORS
    for wrong in ({"z": 1.0}, {"b": 0.0}):
        with pytest.raises(CannotAlignError, match="gain"):
            estimate([path], replace(settings, gains=wrong))


def test_samples_that_are_no_numbers_are_gaps(tmp_path: Path) -> None:
    sensors = bench()
    for sensor in sensors.values():
        sensor.counts = sensor.counts.astype(np.float64)
    sensors["a"].counts[3000, 1] = np.nan
    sensors["c"].counts[7030, 0] = -np.inf
    found = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    # 2950, 3000; 6950, 7000
    assert found.left_out == {"gap": 4, "clipped": 0, "transient": 0, "chosen": 0, "repeated": 0}
    assert np.isfinite(found.results["three-sensor"].noise_psd[2:]).all()


@pytest.mark.parametrize(
    "value",
    [pytest.param(0, marks=pytest.mark.long), 7, pytest.param(8_388_607, marks=pytest.mark.long)],
)
def test_a_channel_that_stands_still_is_dead_and_the_others_are_not(
    tmp_path: Path, value: int
) -> None:
    sensors = bench()
    sensors["b"].counts[:, 1] = value
    settings = replace(SETTINGS, methods=("all",), target_cov=0.1)
    found = estimate([write(tmp_path / "r.h5", sensors)], settings)
    for noise in found.results.values():
        assert np.all(noise.flags[2:, 4] & Flag.DEAD_CHANNEL)
        assert np.isnan(noise.noise_psd[:, 4]).all()
    others = np.delete(found.results["maximum-likelihood"].noise_psd[2:-1], 4, axis=1)
    assert np.isfinite(others).all()
    chosen = estimate([tmp_path / "r.h5"], replace(settings, methods=("auto",)))
    np.testing.assert_allclose(
        np.delete(chosen.results["three-sensor"].noise_psd[2:-1], 4, axis=1), others
    )
    worst = found.diagnostics.advice[0]
    assert isinstance(worst, NoSignal)
    assert worst.channels == (4,)
    assert found.diagnostics.diagnosis is not None
    assert np.isfinite([band.test.p_value for band in found.diagnostics.diagnosis.bands]).all()
    assert found.diagnostics.untested is None


def test_duplicates_are_flagged_and_nothing_alive_is_an_error(tmp_path: Path) -> None:
    sensors = bench()
    sensors["b"].counts[:, 1] = sensors["a"].counts[:, 1]
    settings = replace(SETTINGS, methods=("maximum-likelihood",))
    found = estimate([write(tmp_path / "r.h5", sensors)], settings)
    flags = found.results["maximum-likelihood"].flags
    copies = (flags[1:-1] & Flag.DUPLICATE).any(axis=0)
    assert np.flatnonzero(copies).tolist() == [1, 4]
    # by three-sensor nothing is left, and the advice says why
    with pytest.raises(NoResultError, match="by three-sensor: check the samples") as nothing:
        estimate([tmp_path / "r.h5"], SETTINGS)
    worst, *_ = nothing.value.snapshot.diagnostics.advice
    assert isinstance(worst, Copies)
    assert worst.channels == ((1, 4),)
    for sensor in sensors.values():
        sensor.counts[:] = 0
    with pytest.raises(NoResultError) as nothing:
        estimate([write(tmp_path / "0.h5", sensors)], settings)
    assert sum(isinstance(a, NoSignal) for a in nothing.value.snapshot.diagnostics.advice) == 3


def test_sensors_with_different_numbers_of_channels(tmp_path: Path) -> None:
    found = estimate([write(tmp_path / "r.h5", bench((3, 2, 1, 3)))], SETTINGS)
    noise, flags = found.results["three-sensor"].noise_psd, found.results["three-sensor"].flags
    alone = np.isnan(noise).all(axis=0)
    assert np.flatnonzero(alone).tolist() == [2, 8]  # only two sensors have a third channel
    assert np.all(flags[2:, alone] & Flag.NO_COUNTERPART)
    truth = 100.0**2 / (RATE / 2)
    np.testing.assert_allclose(noise[2:-1, ~alone].mean(axis=0), truth, rtol=0.1)
    # By three directions nobody but they themselves feels they cannot be compared.
    assert found.diagnostics.diagnosis is not None
    responses = found.diagnostics.diagnosis.responses
    assert all({pair.first, pair.second} != {0, 3} for pair in responses)


def test_the_diagnosis_is_that_of_the_estimator(tmp_path: Path) -> None:
    sensors = bench()
    angle = np.radians(4.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    sensors["c"].counts[:, :2] = np.rint(sensors["c"].counts[:, :2] @ turn)
    found = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS).diagnostics.diagnosis
    assert found is not None
    assert found.pairs == ((0, 1), (0, 2), (1, 2))
    rotation = {(pair.first, pair.second): pair.rotation_deg for pair in found.responses}
    assert rotation[0, 1] == pytest.approx(0.0, abs=0.2)
    assert rotation[0, 2] == pytest.approx(4.0, abs=0.2)
    assert {band.test.p_value > 1e-4 for band in found.bands} == {True}
    assert found.per_frequency.p_value.shape == (51,)
    assert found.per_frequency.coherence.shape == (51, 3)


def test_which_channel_is_vertical() -> None:
    def named(*names: str) -> list[Channel]:
        return [Channel(name=name, sensitivity=1.0) for name in names]

    assert vertical_channel(named("BHE", "BHN", "BHZ")) == 2
    assert vertical_channel(named("BH0", "BH1", "BH2")) == 0
    third = Channel(name="3", sensitivity=1.0, direction="Z")
    assert vertical_channel([*named("1", "2"), third]) == 2
    assert vertical_channel(named("1", "2", "3")) is None
    assert vertical_channel(named("X", "Z")) is None
