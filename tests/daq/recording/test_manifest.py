"""The manifest covers every dataset and attribute of a closed recording."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.errors import RecordingError
from daq.recording.chunks.manifest import MANIFEST, RESULTS_MANIFEST
from daq.recording.reader import Recording
from daq.recording.repair import verify, write_results
from tests.daq.recording.version_1 import as_version_1
from tests.torture.damaged_files import make_recording

PROGRAM = Path(__file__).parents[3] / "docs" / "manifest_root.py"


@pytest.fixture
def closed(tmp_path: Path) -> Path:
    path = tmp_path / "closed.h5"
    make_recording(path)
    return path


def documented_root(path: Path) -> str:
    """Run the program that the documentation gives; it imports nothing of huddle."""
    return str(runpy.run_path(str(PROGRAM))["root"](path))


def rename_a_unit(file: h5py.File) -> None:
    unit = file["sensors/a/samples"].attrs["unit"]
    file["sensors/a/samples"].attrs["unit"] = np.char.replace(unit, b"m", b"k")


def exchange_a_sample(file: h5py.File) -> None:
    file["sensors/b/samples"][5, 1] += 1


def shift_an_instant(file: h5py.File) -> None:
    file["sensors/b/instants"][7] += 1000


def change_a_token(file: h5py.File) -> None:
    file.attrs["continues"] = "another run"


def rename_a_result(file: h5py.File) -> None:
    file.move("results/m", "results/n")


def add_an_object(file: h5py.File) -> None:
    file.create_dataset("sensors/a/more", data=np.arange(3))


def empty_the_manifest(file: h5py.File) -> None:
    file[MANIFEST][...] = np.zeros_like(file[MANIFEST][...])


def remove_the_manifest(file: h5py.File) -> None:
    del file[MANIFEST]


def change_an_unused_row(file: h5py.File) -> None:
    file["checksums"].attrs["columns"] = np.array([b"x", b"y", b"z"])


def change_the_firmware(file: h5py.File) -> None:
    file["sensors/a"].attrs["firmware"] = np.bytes_("9.9")


def test_the_root_is_that_of_the_documented_program(closed: Path) -> None:
    report = verify(closed)
    assert report.intact
    assert report.root_sha256 == documented_root(closed)
    with h5py.File(closed) as file:
        stored = dict(file[MANIFEST][...].tolist())
    assert {b"/", b"/@run_id", b"/sensors/b/instants", b"/sensors/a/samples@unit"} <= set(stored)


def test_results_are_covered_and_leave_the_root_as_it_was(closed: Path) -> None:
    before = verify(closed).root_sha256
    write_results(closed, {"m": ({"noise_psd": np.arange(4.0)}, {"unit": "V", "n": 3})})
    report = verify(closed)
    assert report.intact
    assert report.root_sha256 == before
    with h5py.File(closed) as file:
        assert b"/results/m/noise_psd" in file[RESULTS_MANIFEST]["path"]
    with Recording.open(closed) as recording:
        assert recording.results()["m"][1] == {"unit": "V", "n": 3}
        assert recording.result_attributes()["m"]["unit"] == "V"


@pytest.mark.parametrize(
    "change",
    [
        rename_a_unit,
        exchange_a_sample,
        shift_an_instant,
        change_a_token,
        rename_a_result,
        add_an_object,
        empty_the_manifest,
        remove_the_manifest,
        change_an_unused_row,
        change_the_firmware,
    ],
)
def test_a_change_is_found(closed: Path, change: Callable[[h5py.File], None]) -> None:
    with h5py.File(closed, "r+") as file:
        change(file)
    if change is rename_a_unit:  # a description is checked whenever the file is opened
        with pytest.raises(RecordingError, match="description of sensor 'a'"):
            verify(closed)
    else:
        report = verify(closed)
        assert not report.intact
        assert report.changed or report.sensors[1].bad_blocks


def test_a_group_within_itself_ends(closed: Path) -> None:
    with h5py.File(closed, "r+") as file:
        file["sensors/a/again"] = file["sensors/a"]
    with pytest.raises(RecordingError, match="a group within itself"):
        verify(closed)


def test_a_file_that_plain_hdf5_refuses_is_not_intact(closed: Path) -> None:
    content = bytearray(closed.read_bytes())
    content[45] ^= 4  # the checksum of the superblock
    closed.write_bytes(content)
    with pytest.raises(OSError, match="checksum"):
        h5py.File(closed)
    with pytest.raises(RecordingError, match="damaged"):
        verify(closed)


def test_a_recording_of_version_1_is_read_and_verified(closed: Path) -> None:
    as_version_1(closed)
    assert b"GCOL" in closed.read_bytes()
    report = verify(closed)
    assert report.intact
    assert not report.root_sha256
    with h5py.File(closed, "r+") as file:
        place = file["sensors/b/instants"].id.get_chunk_info(2)
    content = bytearray(closed.read_bytes())
    content[place.byte_offset + 9] ^= 1
    closed.write_bytes(content)
    assert verify(closed).changed == ("/sensors/b/instants",)


def test_a_recording_has_no_global_heap(closed: Path) -> None:
    long = "# ä\n" * 40_000  # longer than HDF5 keeps in an object's header
    write_results(
        closed, {"m": ({"noise_psd": np.arange(4.0)}, {"unit": "m/s²", "settings": long})}
    )
    assert b"GCOL" not in closed.read_bytes()
    assert verify(closed).intact
    with Recording.open(closed) as recording:
        assert recording.results()["m"][1]["settings"] == long
