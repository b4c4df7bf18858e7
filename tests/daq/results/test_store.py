"""The results of all methods are written into a recording in one pass."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.recording.reader import Recording, SensorRecord
from daq.results.store import store_results
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
