"""What is packed becomes no more than its file can hold, whoever wrote it."""

from __future__ import annotations

import ctypes
import io
import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.errors import NotARecordingError
from daq.recording.sensor_record import ChunkedRows
from daq.recording.storage.journal import journal_path, read_journal
from daq.recording.storage.packing import PIPELINE, InflationError
from daq.recording.storage.refusals import check_all, dataset, hdf5_function, member
from daq.recording.storage.whole_hdf5 import contents_sha256
from tests.traced_memory import peak_of

MAGIC = b"huddle-journal 1\n"


def forged(recording: Path, payloads: Sequence[bytes]) -> None:
    """Write a journal as its theory of operation says, by other code."""
    frames = [zlib.compress(each, 9) for each in payloads]
    heads = [struct.pack("<II", len(each), zlib.crc32(each)) for each in frames]
    content = b"".join(head + frame for head, frame in zip(heads, frames, strict=True))
    journal_path(recording).write_bytes(MAGIC + content)


def created() -> bytes:
    """Return a small HDF5 file."""
    held = io.BytesIO()
    with h5py.File(held, "w", libver="latest") as file:
        file.attrs["run_id"] = "0" * 32
    return held.getvalue()


def commit(size: int = 0) -> bytes:
    """Return the payload of a commit, with bytes that nothing reads behind it."""
    head = json.dumps({"counts": [[0, 0, 0]], "stored": {}, "tables": {}})
    return head.encode() + b"\n" + bytes(size)


@pytest.mark.parametrize("n_frames", [1, 20])
def test_a_journal_becomes_no_more_than_its_file_can_hold(tmp_path: Path, n_frames: int) -> None:
    path = tmp_path / "r.h5"
    forged(path, [created(), *[commit((100 << 20) // n_frames)] * n_frames])
    assert journal_path(path).stat().st_size < 200_000
    assert peak_of(lambda: read_journal(path)) < 60 << 20
    forged(path, [created(), commit()])
    found = read_journal(path)
    assert found is not None
    assert found.counts is not None


@pytest.mark.parametrize(
    "payload",
    [b"", b"[]", b"{}", b'{"counts": 1, "stored": [], "tables": {}}', b"\xff", b"[" * 9999],
)
def test_a_journal_ends_where_it_is_not_of_a_recorder(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "r.h5"
    forged(path, [created(), commit(), payload])
    found = read_journal(path)
    assert found is not None
    assert found.counts is not None
    assert found.counts.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("rows", [(0, 2000), (10, 20)])
def test_a_chunk_inflates_to_no_more_than_its_rows(tmp_path: Path, rows: tuple[int, int]) -> None:
    path = tmp_path / "r.h5"
    length = 1000
    with h5py.File(path, "w") as file:
        made = file.create_dataset(
            "samples", (2 * length, 3), "i4", chunks=(length, 3),
            shuffle=True, compression="gzip", fletcher32=True,
        )  # fmt: skip
        made[...] = 7
        made.id.write_direct_chunk((0, 0), zlib.compress(bytes(64 << 20), 9), 0b100)
        plist = made.id.get_create_plist()
        assert tuple(plist.get_filter(n)[0] for n in range(3)) == PIPELINE
    with h5py.File(path) as file:
        reader = ChunkedRows(file["samples"])
        with pytest.raises(InflationError, match="inflates to more"):
            reader.read(*rows, 2 * length)
        assert (reader.read(length, 2 * length, 2 * length) == 7).all()
        assert (reader.read(length + 1, length + 9, 2 * length) == 7).all()


BOMB = zlib.compress(bytes(64 << 20), 9)


def shuffled(stream: bytes, size: int) -> bytes:
    """Return bytes as the filter shuffle stores elements of a size."""
    whole = len(stream) // size * size
    return np.frombuffer(stream[:whole], "u1").reshape(-1, size).T.tobytes() + stream[whole:]


@pytest.mark.parametrize(
    ("filters", "mask", "content"),
    [
        ("deflate", 0, BOMB),
        ("deflate", 0b10, BOMB),  # the second of one filter is left out
        ("shuffle deflate fletcher32", 0b100, BOMB),
        ("deflate shuffle", 0, shuffled(BOMB, 8)),
        ("deflate deflate", 0, zlib.compress(BOMB, 9)),
    ],
)
def test_a_table_inflates_to_no_more_than_its_rows(
    tmp_path: Path, filters: str, mask: int, content: bytes
) -> None:
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        created = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        created.set_chunk((100, 3))
        for each in filters.split():
            getattr(created, f"set_{each}")()
        space = h5py.h5s.create_simple((100, 3))
        made = h5py.h5d.create(file.id, b"table", h5py.h5t.STD_I64LE, space, created)
        made.write_direct_chunk((0, 0), content, mask)

    def read() -> None:
        with h5py.File(path) as file, pytest.raises((NotARecordingError, InflationError)):
            dataset(file, "table")
        with h5py.File(path) as file, pytest.raises((NotARecordingError, InflationError)):
            contents_sha256(dataset(file, "table", in_parts=True))

    assert peak_of(read) < 4 << 20


def test_names_of_groups_are_not_packed(tmp_path: Path) -> None:
    pack = hdf5_function("H5Pset_deflate", ctypes.c_int64, ctypes.c_uint)
    if pack is None:
        pytest.skip("the library of HDF5 is not found")
    of_group, of_link = (
        h5py.h5p.create(each) for each in (h5py.h5p.GROUP_CREATE, h5py.h5p.LINK_CREATE)
    )
    pack(of_group.id, 9)
    path = tmp_path / "r.h5"
    with h5py.File(path, "w", libver="latest") as file:
        group = h5py.Group(h5py.h5g.create(file.id, b"results", of_link, of_group))
        made = file.create_dataset("table", data=1)
        for number in range(20):
            group[f"{number}" + "a" * 60_000] = made
    assert path.stat().st_size < 50_000
    with h5py.File(path) as file:
        assert member(file, "table")[()] == 1
        with pytest.raises(NotARecordingError, match="/results: its names are packed"):
            member(file, "results")
        with pytest.raises(NotARecordingError, match="its names are packed"):
            check_all(file)
