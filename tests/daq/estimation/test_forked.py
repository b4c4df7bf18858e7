"""Processes that take pieces of a long recording: sums are those of one, to the bit."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.errors import EndedProcessError
from daq.estimation.estimation import estimate
from daq.estimation.segments import forked, segment_pass
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from tests.daq.clocks.recordings import ORIGIN, Sensor, write
from tests.daq.estimation.test_own_samples import free

RATE, SEGMENT, HOP = 100.0, 2.0, 100
GAPS = ((4_000, 4_040), (15_300, 16_000), (23_500, 23_505))
SETTINGS = Settings(segment=SEGMENT, methods=("three-sensor",), equalise="off")
ODD = datetime.fromtimestamp(ORIGIN.utc_ns * 1e-9, UTC) + timedelta(seconds=13.37)
pytestmark = pytest.mark.skipif(not forked.IS_POSSIBLE, reason="no forks on this system")


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make several pieces of each part of time; no process may remain, but those of other tests."""
    monkeypatch.setattr(segment_pass, "_VALUES_AT_ONCE", 4 * 9 * HOP)
    before = _children()
    yield
    assert _children() <= before


def _children() -> set[str]:
    """Return the processes that the main thread of this one has started."""
    return set(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split())


def _record(folder: Path, gaps: tuple[tuple[int, int], ...] = ()) -> Path:
    rng = np.random.default_rng(3)
    motion = rng.standard_normal((30_000, 3))
    sensors = {
        name: Sensor(
            np.rint(1e4 * motion + 300 * rng.standard_normal(motion.shape)).astype(np.int32),
            rate=RATE,
            clock="one",
            gaps=gaps if name == "b" else (),
        )
        for name in "abc"
    }
    return write(folder / "one.h5", sensors)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three triaxial sensors by one clock, without gaps."""
    return _record(tmp_path_factory.mktemp("whole"))


def _compare(path: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch, jobs: int = 2) -> int:
    """Compare what one and several processes sum; return the segments that the others took."""
    counts: list[int] = []
    take, found = vars(Pass)["_take_sums"], []
    rows: list[NDArray[Any]]

    def counted(self: Pass, part: Any, first: int, count: int) -> None:  # noqa: ANN401
        counts.append(count if number > 1 else 0)
        take(self, part, first, count)

    monkeypatch.setattr(Pass, "_take_sums", counted)
    for number in (1, jobs):
        with Recording.open(path) as recording:
            one = Pass(recording, settings, jobs=number)
            one.finish()
            parts = () if one.parts is None else one.parts.each
            rows = [one.kept_at, one.drift(), one.stillness.counts, one.single.values()]
            rows += [each.csm() for each in (one.spectra, *one.sets.spectra.values())]
            rows += [each.packed(slice(None)) for each in parts]
            numbers = one.n_segments, one.n_seen, one.n_bridged, +one.left_out
            clocks = [repr(each) for each in one.aligned.clocks]
            found.append((numbers, clocks, [each.tobytes() for each in rows]))
    assert found[0] == found[1]
    return sum(counts)


@pytest.mark.parametrize(
    ("jobs", "changes", "taken"),
    [
        (2, {}, (280, 300)),
        (3, {"start": ODD, "exclude": ("100s/107s",)}, (250, 284)),
        pytest.param(
            *(2, {"window": "rectangular", "overlap": 0.0}, (120, 150)), marks=pytest.mark.long
        ),
    ],
)
def test_sums_are_equal_to_the_bit(
    whole: Path,
    monkeypatch: pytest.MonkeyPatch,
    jobs: int,
    changes: dict[str, Any],
    taken: tuple[int, int],
) -> None:
    low, high = taken
    assert low < _compare(whole, replace(SETTINGS, **changes), monkeypatch, jobs) < high


def test_segments_beside_gaps_are_taken_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert 250 < _compare(_record(tmp_path, GAPS), SETTINGS, monkeypatch) < 290


def test_free_clocks_are_set_by_the_same_delays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = vars(Pass)["_survey"]

    def surveyed(self: Pass) -> None:
        survey(self)
        self._every = 3

    monkeypatch.setattr(Pass, "_survey", surveyed)
    monkeypatch.setattr(segment_pass, "_VALUES_AT_ONCE", 2 * 9 * 250)
    path = write(tmp_path / "free.h5", free())
    assert _compare(path, replace(SETTINGS, segment=5.0), monkeypatch) > 60


def test_a_result_is_that_of_one_process(whole: Path) -> None:
    settings = replace(SETTINGS, equalise="estimated")
    one, two = (estimate([whole], settings, jobs=n).results for n in (1, 2))
    for each, other in zip(one.values(), two.values(), strict=True):
        np.testing.assert_array_equal(each.noise_psd, other.noise_psd)


@pytest.mark.parametrize("changes", [{"octaves": True}, {"reject": True}, {"segment": 20.0}])
def test_what_needs_the_samples_or_is_short_takes_one_process(
    whole: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
) -> None:
    monkeypatch.setattr(forked, "worked_out", None)
    with Recording.open(whole) as recording:
        one = Pass(recording, replace(SETTINGS, **changes), jobs=2)
        one.finish()
        assert one.n_segments


def test_a_killed_process_is_an_error(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> bool:
        os.kill(os.getpid(), signal.SIGKILL)
        return False

    monkeypatch.setattr(Pass, "_summed", killed)
    with pytest.raises(EndedProcessError, match=r"signal 9.*--jobs 1"):
        estimate([whole], SETTINGS, jobs=2)


def test_what_fails_in_a_process_is_left_to_this_one() -> None:
    rooms = [[forked.shared((1,), np.int64) for _ in range(forked.ROOMS)] for _ in range(2)]

    def work(piece: int, room: np.ndarray) -> bool:
        room[0] = 100 // piece
        return True

    coming = forked.worked_out(work, [5, 0, 4, 2, 0, 1, 3], rooms)
    found = [None if room is None else int(room[0]) for room in coming]
    assert found == [20, None, 25, 50, None, 100, 33]


def test_ctrl_c_ends_the_processes(whole: Path) -> None:
    def interrupt(n: int, _: int) -> None:
        if n > 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate([whole], SETTINGS, progress=interrupt, jobs=2)


def test_hdf5_reads_without_a_position_that_forks_would_share(whole: Path) -> None:
    with Recording.open(whole) as recording:
        sensor = recording.sensors[0]
        assert len(sensor.blocks[:]) > 0
        assert len(sensor.counts(0, 30)) == 30  # a part of a chunk: HDF5 reads it
        handles = [each for each in Path("/proc/self/fd").iterdir() if each.is_file()]
        own = [int(each.name) for each in handles if each.resolve() == recording.path.resolve()]
        assert [os.lseek(handle, 0, os.SEEK_CUR) for handle in own] == [0]
