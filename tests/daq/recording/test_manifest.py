"""The manifest covers all of a closed recording, whose blocks and rows agree."""

from __future__ import annotations

import contextlib
import re
import runpy
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.errors import NotARecordingError, RecordingError
from daq.recording.chunks.manifest import MANIFEST, RESULTS_MANIFEST
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify, write_results
from tests.daq.recording.version_1 import as_version_1
from tests.torture.damaged_files import make_recording, plain_h5py_reads

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


# --- blocks, rows and ``/committed`` agree ---------------------------------------------------


def change_block(path: Path, row: int, field: str, bit: int) -> None:
    """Flip one bit of a row of the block table, as a damaged disk does."""
    with h5py.File(path, "r+") as file:
        table = file["sensors/a/blocks"]
        rows = table[...]
        rows[field][row] ^= np.int64(1) << bit
        table[...] = rows


@pytest.mark.parametrize("field", ["first_row", "n_samples"])
@pytest.mark.parametrize(("bit", "row"), [(0, 17), (7, 0), (11, 59), (40, 17), (62, 0)])
def test_no_block_of_a_closed_recording_is_left_out_unseen(
    closed: Path, field: str, bit: int, row: int
) -> None:
    change_block(closed, row, field, bit)
    certain = 50 * max(0, row - 1)  # the damaged block, and in doubt the one before
    for read in (Recording.open, verify, repair):
        with pytest.raises(NotARecordingError, match="damaged") as said:
            read(closed)
        lost = re.search(r"sensor 'a': (\d+) of 3000 samples are lost", str(said.value))
        assert lost is not None
        assert 50 <= int(lost[1]) <= 3000 - certain


@pytest.mark.parametrize("name", ["samples", "blocks", "instants"])
def test_a_closed_recording_has_the_lengths_that_were_committed(closed: Path, name: str) -> None:
    with h5py.File(closed, "r+") as file:
        rows = file["sensors/b"][name]
        rows.resize(len(rows) + 50, axis=0)
    expected = "110 rows; expected 60" if name == "blocks" else "3050 rows; expected 3000"
    with pytest.raises(NotARecordingError, match=expected):
        verify(closed)


def test_a_recording_left_open_is_cut_to_its_whole_blocks(tmp_path: Path) -> None:
    path = tmp_path / "open.h5"
    make_recording(path)
    with h5py.File(path, "r+") as file:
        del file["checksums"]
        file["committed"][-1, 1] = 0
        file["committed"][0, 0] = 2960  # older than the row of the table
    with Recording.open(path) as recording:
        assert recording.sensor("a").n_samples == 2950


def test_a_changed_byte_of_the_superblock_is_damage(closed: Path) -> None:
    content = closed.read_bytes()
    for at in range(48):
        changed = bytearray(content)
        changed[at] ^= 0x80  # an offset becomes one that no file can have
        closed.write_bytes(changed)
        with contextlib.suppress(NotARecordingError):
            assert not verify(closed, tried=True).intact


# --- what `verify` calls intact is readable by any program -----------------------------------


_HEADER = re.compile(rb"(?:BTHD|BTLF|FRHP|FHDB|EAHD|FSHD|FSSE)\x00")
"""Of indexes, heaps and lists of free space, which our own reader may not need."""


@pytest.mark.parametrize(("rows", "version"), [([], 2), ([[0, 3, 5]], 3)])
def test_only_recordings_that_lack_rows_of_channels_need_a_later_program(
    rows: list[list[int]], version: int
) -> None:
    """Programs of before refuse version 3, and read version 2."""
    channels = (Channel(name="x", sensitivity=1.0),)
    absent = np.array(rows, np.int64).reshape(-1, 3)
    layout = SensorLayout("a", channels, 100.0, np.dtype("i4"), absent=absent)
    assert layout.format_version == version


@pytest.mark.parametrize("offset", [5, 20])
def test_a_damaged_header_is_damage(tmp_path: Path, offset: int) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    content = path.read_bytes()
    headers = [match.start() for match in _HEADER.finditer(content)]
    n_unreadable = 0
    for start in headers:
        changed = bytearray(content)
        changed[start + offset] ^= 0x80
        path.write_bytes(changed)
        if plain_h5py_reads(path):
            continue
        n_unreadable += 1
        try:
            report = verify(path, tried=True)
        except RecordingError:
            continue
        assert not report.intact, content[start : start + 4]
    assert n_unreadable > 0
