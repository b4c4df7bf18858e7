"""From a recording to the estimate: live equals offline, and what stands in between."""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.response import PolesZeros
from daq.bench.units import canonical
from daq.errors import CannotAlignError, WrongSettingError
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError, Snapshot
from estimator.errors import InsufficientDataError
from estimator.methods import self_noise
from estimator.spectra.segment_rejection import Reason
from estimator.spectra.welch import CrossSpectra, WelchSettings
from tests.daq.clocks.recordings import ORIGIN, Sensor, blocks, counts, create, later, write

SETTINGS = Settings(segment=1.0, methods=("three-sensor",))


def huddle(
    n_samples: int = 6000,
    seed: int = 1,
    *,
    clock: str = "one",
    utc: bool = False,
    unit: str = "m/s²",
    channel: dict[str, Any] | None = None,
) -> dict[str, Sensor]:
    """Three sensors with two channels that share most of what they record."""
    common = counts(n_samples, 2, seed) * 10
    return {
        name: Sensor(
            common + counts(n_samples, 2, seed + ord(name)),
            clock=clock,
            utc=utc,
            unit=unit,
            channel=channel,
        )
        for name in "abc"
    }


def same(one: Snapshot, other: Snapshot) -> None:
    assert one.n_segments == other.n_segments
    np.testing.assert_allclose(
        one.csm, other.csm, rtol=1e-9, atol=1e-9 * np.nanmax(np.abs(one.csm))
    )
    for method, result in one.results.items():
        np.testing.assert_allclose(
            result.noise_psd, other.results[method].noise_psd, rtol=1e-9, atol=0
        )


def test_the_estimate_is_that_of_the_samples_in_the_file(tmp_path: Path) -> None:
    sensors = huddle()
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    spectra = CrossSpectra(WelchSettings(100.0, 100), 6)
    spectra.add(np.hstack([s.counts for s in sensors.values()]).astype(float), np.arange(119) * 50)
    direct = self_noise(
        "three-sensor", spectra.csm(), dims=(2, 2, 2), n_effective=spectra.n_effective
    )
    assert snapshot.n_segments == 119
    assert snapshot.closed
    assert snapshot.elapsed == 60.0
    assert [(label.sensor, label.channel) for label in snapshot.channels][3] == ("b", "c1")
    np.testing.assert_allclose(
        snapshot.results["three-sensor"].noise_psd[2:], direct.noise_psd[2:], rtol=1e-9
    )
    # real amplitudes at Nyquist: half the degrees of freedom
    ratio = snapshot.results["three-sensor"].cov / direct.cov
    np.testing.assert_allclose(ratio[-1], np.sqrt(2), rtol=1e-8)
    np.testing.assert_allclose(ratio[2:-1], 1, rtol=1e-8)
    psd = spectra.csm()[:, 0, 0].real
    np.testing.assert_allclose(snapshot.data_psd[2:, 0], psd[2:], rtol=1e-12)


@pytest.mark.parametrize("shared", [True, False])
def test_what_is_shown_live_at_the_end_is_the_estimate_from_the_file(
    tmp_path: Path, shared: bool
) -> None:
    path = tmp_path / "r.h5"
    sensors = huddle()
    for name, ppm in zip("abc", (0.0, 15.0, -20.0), strict=True):
        sensors[name].rate *= 1 + (0 if shared else ppm * 1e-6)
        sensors[name].nominal = 100.0
        sensors[name].clock = "one" if shared else name
    writer = create(path, sensors)
    rng = np.random.default_rng(4)
    late = (
        replace(block, received=later(block.received, int(rng.exponential(1e6))))
        for name, sensor in sensors.items()
        for block in blocks(name, sensor)
    )
    seen = []
    with Estimation([path], SETTINGS) as live:
        assert not live.update()
        assert live.snapshot().results == {}
        for number, block in enumerate(sorted(late, key=lambda each: each.received.monotonic_ns)):
            writer.append(block)
            if number % 90 == 89:
                writer.commit()
                live.recordings[0].refresh()
                had, lacked = live.n_seen, [live.lacking(live.n_seen + n) for n in range(1, 4)]
                assert live.lacking() == lacked[0]
                live.update()
                # when to take segments: not before they are there, and never long after
                n_new = live.n_seen - had
                assert all(each <= 0.0 for each in lacked[:n_new])
                assert all(each > -SETTINGS.segment for each in lacked[n_new:])
                assert 0 < live.lacking() <= (SETTINGS.segment if had else 2 * SETTINGS.segment)
                seen.append(live.snapshot().n_segments)
        writer.close()
        live.update()
        assert live.snapshot().closed
        ended = live.finish()
    assert seen == sorted(seen)
    assert seen[0] < seen[-1]
    same(ended, estimate([path], SETTINGS))


def test_short_gaps_all_over_are_bridged_live_and_offline(tmp_path: Path) -> None:
    """Three gaps of 50 ms in each segment; without a bridge no segment is left."""
    sensors = huddle(n_samples=6000)
    holes = {"a": 0, "b": 37, "c": 61}
    for name, offset in holes.items():
        sensors[name].gaps = tuple((n, n + 5) for n in range(20 + offset, 5900, 100))
    path = write(tmp_path / "gaps.h5", sensors)
    found = estimate([path], SETTINGS)
    assert found.bridged is not None
    assert found.bridged.n_segments > 0.8 * found.n_segments
    assert found.left_out[Reason.GAP] == found.n_dropped < 20
    whole = estimate([write(tmp_path / "whole.h5", huddle(n_samples=6000))], SETTINGS)
    assert whole.bridged is None
    inner = slice(2, -5)
    ratio = found.results["three-sensor"].noise_psd / whole.results["three-sensor"].noise_psd
    # The same noise but for a fifth of it, in some 60 averages of 45 bins and six channels.
    assert np.median(ratio[inner]) == pytest.approx(1, abs=0.06)
    with pytest.raises(NoResultError):
        estimate([path], replace(SETTINGS, bridge=0.0))
    with Estimation([path], SETTINGS) as live:
        live.update()
        same(live.finish(), found)


def test_a_gap_drops_the_segments_it_touches_and_nothing_else(tmp_path: Path) -> None:
    sensors = huddle()
    sensors["b"].gaps = ((2020, 2031),)  # in the lattice's segments at 1950 and 2000
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    starts = np.arange(119) * 50
    kept = starts[(starts > 2030) | (starts + 100 <= 2020)]
    assert snapshot.n_segments == len(kept) == 117
    assert snapshot.n_dropped == 2
    spectra = CrossSpectra(WelchSettings(100.0, 100), 6)
    spectra.add(np.hstack([s.counts for s in sensors.values()]).astype(float), kept)
    np.testing.assert_allclose(snapshot.csm[2:], spectra.csm()[2:], rtol=1e-9, atol=1.0)


def test_a_disturbed_segment_is_left_out_where_that_is_asked_for(tmp_path: Path) -> None:
    sensors = huddle()
    disturbed = sensors["b"].counts.copy()
    disturbed[4010:4020] += 40 * np.abs(disturbed).max()  # someone knocks
    sensors["b"].counts = disturbed
    path = write(tmp_path / "r.h5", sensors)
    everything = estimate([path], SETTINGS)
    quiet = estimate([path], replace(SETTINGS, reject=True))
    # Lattice segments at 3950 and 4000.
    assert everything.n_segments - quiet.n_segments == 2
    assert quiet.left_out == {"gap": 0, "clipped": 0, "transient": 2, "chosen": 0, "repeated": 0}
    assert quiet.data_psd[2:6, 2].max() < 0.2 * everything.data_psd[2:6, 2].min()


def test_several_recordings_accumulate(tmp_path: Path) -> None:
    one, two = huddle(seed=1), huddle(4000, seed=9, utc=True)
    later = {name: replace(sensor, start=60.0) for name, sensor in two.items()}
    first, second = write(tmp_path / "1.h5", one), write(tmp_path / "2.h5", later)
    both = estimate([first, second], SETTINGS)
    alone = estimate([first], SETTINGS), estimate([second], SETTINGS)
    assert both.n_segments == sum(each.n_segments for each in alone)
    mean = sum(each.csm * each.n_segments for each in alone) / both.n_segments
    np.testing.assert_allclose(both.csm, mean, rtol=1e-9, atol=1.0)
    odd = write(tmp_path / "3.h5", huddle(unit="m/s"))
    with pytest.raises(CannotAlignError, match="does not match"):
        estimate([first, odd], SETTINGS)


def test_one_recording_counts_once_whatever_it_is_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "r.h5", huddle())
    shutil.copy(path, tmp_path / "copy.h5")
    (tmp_path / "link.h5").symlink_to(path)
    (tmp_path / "same.h5").hardlink_to(path)
    monkeypatch.chdir(tmp_path)
    for again in ("r.h5", "copy.h5", "link.h5", "same.h5"):
        with pytest.raises(WrongSettingError, match=rf"{again} and .*r\.h5 are the same recording"):
            estimate([path, again], SETTINGS)


def test_a_start_beyond_the_end_is_told_with_what_the_recordings_cover(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", huddle())
    origin = datetime.fromtimestamp(ORIGIN.utc_ns / 1e9, tz=UTC)
    for start, end in ((600.0, None), (30.0, 20.0), (59.5, None)):
        between = replace(
            SETTINGS,
            start=origin + timedelta(seconds=start),
            end=None if end is None else origin + timedelta(seconds=end),
        )
        covers = rf"start {between.start:%FT%T}.*covers {origin:%FT%T} to .*\(1m\)"
        with pytest.raises(WrongSettingError, match=covers):
            estimate([path], between)
    create(tmp_path / "empty.h5", huddle()).close()
    with pytest.raises(InsufficientDataError, match="no samples of a, b, c"):
        estimate([tmp_path / "empty.h5"], replace(SETTINGS, start=origin))


def test_only_what_lies_between_start_and_end(tmp_path: Path) -> None:
    sensors = huddle(utc=True)
    path = write(tmp_path / "r.h5", sensors)
    origin = datetime.fromtimestamp(ORIGIN.utc_ns / 1e9, tz=UTC)
    between = replace(
        SETTINGS, start=origin + timedelta(seconds=10.004), end=origin + timedelta(seconds=39.99)
    )
    snapshot = estimate([path], between)
    assert snapshot.start_utc_ns == ORIGIN.utc_ns + 10_010_000_000
    # Samples 1001 to 3999: 2999 of them.
    assert snapshot.n_segments == (2999 - 100) // 50 + 1
    spectra = CrossSpectra(WelchSettings(100.0, 100), 6)
    rows = np.hstack([s.counts for s in sensors.values()]).astype(float)
    spectra.add(rows, 1001 + np.arange(snapshot.n_segments) * 50)
    np.testing.assert_allclose(snapshot.csm[2:], spectra.csm()[2:], rtol=1e-9, atol=1.0)


def test_velocity_becomes_acceleration_by_omega_and_responses_are_taken_out(
    tmp_path: Path,
) -> None:
    path = write(tmp_path / "v.h5", huddle(unit="m/s", channel={"sensitivity": 4.0}))
    pole = PolesZeros(poles=(-30 + 0j,), normalization=30.0)
    with_response = write(
        tmp_path / "w.h5", huddle(unit="m/s", channel={"sensitivity": 4.0, "response": pole})
    )
    velocity = estimate([path], SETTINGS)
    acceleration = estimate([path], replace(SETTINGS, unit="m/s**2"))
    assert (velocity.unit, acceleration.unit) == ("m/s", "m/s²")
    for spelled, unit in {"ug": "µg", "GAL": "Gal", "cm/s^2": "Gal", "um/s": "µm/s"}.items():
        assert canonical(spelled) == unit
    omega = 2 * np.pi * velocity.frequency[1:, None]
    np.testing.assert_allclose(
        acceleration.data_psd[1:], velocity.data_psd[1:] * omega**2, rtol=1e-9
    )
    corrected = estimate([with_response], SETTINGS)
    np.testing.assert_allclose(
        corrected.data_psd[1:], velocity.data_psd[1:] * (1 + (omega / 30) ** 2), rtol=1e-9
    )
    with pytest.raises(CannotAlignError, match="cannot be turned into"):
        estimate([path], replace(SETTINGS, unit="V"))


def test_too_little_is_said_with_what_there_is_and_what_is_needed(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", huddle(150))
    with pytest.raises(InsufficientDataError, match=r"1\.5 s with all sensors.*takes 10 s"):
        estimate([path], replace(SETTINGS, segment=10.0))
    two = {name: sensor for name, sensor in huddle().items() if name != "c"}
    with pytest.raises(InsufficientDataError, match="three"):
        estimate([write(tmp_path / "2.h5", two)], SETTINGS)


def test_progress_tells_every_segment(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    path = write(tmp_path / "r.h5", huddle())
    estimate([path], SETTINGS, progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (119, 119)
