"""The results of all methods are written into a recording in one pass."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.recording.reader import Recording, SensorRecord
from daq.recording.repair import write_results
from daq.results.store import store_results, stored_verdict
from estimator.decision.verdict import Verdict
from tests.tui.example_snapshot import growing, made_snapshot


def test_all_methods_are_stored_with_one_copy_and_no_sample_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        writer.close()
    copies, copyfile = [], shutil.copyfile

    def copy(source: Path, target: Path) -> None:
        copies.append(target)
        copyfile(source, target)

    def refuse(*_: object) -> NDArray[np.int32]:
        pytest.fail("a sample was read")

    monkeypatch.setattr(shutil, "copyfile", copy)
    monkeypatch.setattr(SensorRecord, "counts", refuse)
    snapshot = made_snapshot(closed=True)
    store_results(path, snapshot)
    assert len(copies) == 1
    with Recording.open(path) as recording:
        stored = recording.results()
    assert list(stored) == sorted(snapshot.results)
    for method, noise in snapshot.results.items():
        arrays, attributes = stored[method]
        np.testing.assert_array_equal(arrays["noise_psd"], noise.noise_psd)
        np.testing.assert_array_equal(arrays["data_psd"], snapshot.data_psd)
        assert attributes["segments"] == snapshot.n_segments
        assert list(attributes["channels"][:2]) == ["A.X", "A.Y"]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ((), (False, None)), ((None,), (True, None)), (("fail",), (True, Verdict.FAIL)),
        (("pass", "pass"), (True, Verdict.PASS)), (("pass", "fail"), (True, None)),
        (("perhaps",), (True, None)), (("perhaps", "pass"), (True, Verdict.PASS)),
    ],
)  # fmt: skip
def test_the_verdict_is_the_one_that_was_stored(
    tmp_path: Path, words: tuple[str | None, ...], found: tuple[bool, Verdict | None]
) -> None:
    """None where methods say different ones, or an earlier version wrote the result."""
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        writer.close()
    arrays = {"frequency": np.arange(3.0)}
    results = {
        f"method-{number}": (arrays, {} if word is None else {"verdict": word})
        for number, word in enumerate(words)
    }
    if results:
        write_results(path, results)
    with Recording.open(path) as recording:
        assert stored_verdict(recording) == found
