"""Files inside archives, and names with blanks."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import lzma
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.errors import HuddleError, ImportFormatError
from daq.formats.importer import import_files
from daq.recording.reader import Recording
from tests.daq.formats.test_sources import counts, write_records
from tests.traced_memory import peak_of

ZIPS = {
    "zip": zipfile.ZIP_DEFLATED, "zip, bzip2": zipfile.ZIP_BZIP2, "zip, lzma": zipfile.ZIP_LZMA
}  # fmt: skip


def packed(folder: Path, kind: str, names: dict[str, bytes]) -> Path:
    """Pack files."""
    path = folder / (f"day.mseed.{kind}" if kind in {"gz", "bz2", "xz"} else f"day.{kind}")
    if kind in ZIPS:
        path = folder / "day.zip"
        with zipfile.ZipFile(path, "w", ZIPS[kind]) as archive:
            for name, content in names.items():
                archive.writestr(name, content)
    elif "tar" in kind or kind == "tgz":
        mode = {"tar": "w", "tar.xz": "w:xz", "tar.bz2": "w:bz2"}.get(kind, "w:gz")
        with tarfile.open(path, mode) as tar:  # type: ignore[call-overload]  # any of them
            for name, content in names.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
    else:
        whole = b"".join(names.values())
        by: Callable[[bytes], bytes] = (
            gzip.compress if kind == "gz" else bz2.compress if kind == "bz2" else lzma.compress
        )
        half = len(whole) // 2  # as `cat` and parallel programs do
        path.write_bytes(by(whole[:half]) + by(whole[half:]))
    return path


def samples_of(path: Path) -> NDArray[np.int32]:
    with Recording.open(path) as recording:
        (sensor,) = recording.sensors
        return np.asarray(sensor.counts())


KINDS = ["gz", "bz2", "xz", *ZIPS, "tar", "tar.gz", "tgz", "tar.xz", "tar.bz2"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_packed_file_is_imported_as_it_is(tmp_path: Path, kind: str) -> None:
    names: dict[str, bytes] = {}
    for channel, name in (("HHN", "a/day"), ("HHZ", "b/day")):
        path = write_records(tmp_path / channel, counts(600, len(names)), channel=channel)
        names[name] = path.read_bytes()
    path = packed(tmp_path, kind, names)
    import_files([path], tmp_path / "a.h5")
    expected = np.stack([counts(600, 0), counts(600, 1)], 1)
    np.testing.assert_array_equal(samples_of(tmp_path / "a.h5"), expected)
    with Recording.open(tmp_path / "a.h5") as recording:
        assert recording.bench is not None
        assert recording.bench.sensors[0].port == str(path)


def test_archives_that_are_damaged_empty_or_a_trap_are_refused(tmp_path: Path) -> None:
    day = write_records(tmp_path / "day", counts(60_000, 1)).read_bytes()
    path = packed(tmp_path, "gz", {"": day})
    path.write_bytes(path.read_bytes()[: len(day) // 2])
    with pytest.raises(ImportFormatError, match=r"day\.mseed\.gz: cannot be unpacked"):
        import_files([path], tmp_path / "a.h5")
    with pytest.raises(ImportFormatError, match="no file in it"):
        import_files([packed(tmp_path, "tar", {})], tmp_path / "a.h5")
    path = packed(tmp_path, "bz2", {"": b"\0" * (34 << 20)})
    with pytest.raises(ImportFormatError, match="more than 100 times its size"):
        import_files([path], tmp_path / "a.h5")
    with pytest.raises(ImportFormatError, match="cannot be unpacked"):
        import_files([tmp_path / "none.zip"], tmp_path / "a.h5")
    assert not (tmp_path / "a.h5").exists()


def headed(name: bytes, size: int) -> bytes:
    """Return the head of a tar whose name is said to be in the following bytes."""
    head = tarfile.TarInfo(name.decode())
    head.type, head.size = tarfile.GNUTYPE_LONGNAME, size
    return head.tobuf(tarfile.GNU_FORMAT)


def as_zip(method: int) -> bytes:
    """Return a zip of nothing but zeros, many of them."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", method) as archive, archive.open("day", "w") as file:
        for _ in range(64):
            file.write(bytes(1 << 20))
    return held.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.tar.gz", lambda: gzip.compress(headed(b"././@LongLink", 64 << 20) + bytes(64 << 20))),
        ("a.zip", lambda: as_zip(zipfile.ZIP_BZIP2)),
        pytest.param(
            "a.zip", lambda: as_zip(zipfile.ZIP_LZMA), marks=pytest.mark.long, id="zip, lzma"
        ),
    ],
)
def test_a_bomb_is_refused_before_it_takes_memory(
    tmp_path: Path, name: str, content: Callable[[], bytes]
) -> None:
    (tmp_path / name).write_bytes(content())

    def read() -> None:
        with pytest.raises(ImportFormatError, match="more than 100 times its size"):
            import_files([tmp_path / name], tmp_path / "a.h5")

    assert peak_of(read) < 50 << 20


def test_a_decoder_of_xz_takes_no_more_memory_than_the_largest_of_its_presets(
    tmp_path: Path,
) -> None:
    day = write_records(tmp_path / "day", counts(600, 1)).read_bytes()
    path = tmp_path / "day.xz"
    path.write_bytes(lzma.compress(day, preset=9))
    import_files([path], tmp_path / "a.h5")
    greedy = [{"id": lzma.FILTER_LZMA2, "preset": 0, "dict_size": 1 << 28}]
    for name, content in (("day.xz", day), ("day.tar.xz", bytes(10240))):
        (tmp_path / name).write_bytes(lzma.compress(content, filters=greedy))
        with pytest.raises(ImportFormatError, match="cannot be unpacked: Memory usage limit"):
            import_files([tmp_path / name], tmp_path / "a.h5")


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz", *ZIPS, "tar.gz"])
def test_a_changed_byte_of_an_archive_is_no_fault_of_huddle(tmp_path: Path, kind: str) -> None:
    day = write_records(tmp_path / "day", counts(600, 1)).read_bytes()
    path = packed(tmp_path, kind, {"day": day})
    whole = path.read_bytes()
    for at in range(0, len(whole), 97):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        with contextlib.suppress(HuddleError):
            import_files([path], tmp_path / "a.h5")
            assert np.array_equal(samples_of(tmp_path / "a.h5")[:, 0], counts(600, 1))
        (tmp_path / "a.h5").unlink(missing_ok=True)


def test_names_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    inside = tmp_path / "x" / "y"
    inside.mkdir(parents=True)
    content = write_records(tmp_path / "day", counts(600, 1)).read_bytes()
    path = packed(inside, "tar", {"../../../escaped": content, "/tmp/also-escaped": content})  # noqa: S108 - the trap
    import_files([path], tmp_path / "a.h5")
    assert not list(tmp_path.rglob("*escaped"))
    np.testing.assert_array_equal(samples_of(tmp_path / "a.h5")[:, 0], counts(600, 1))


def test_names_of_gse1_with_blanks(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy", reason="ObsPy is an extra")
    path = next(Path(obspy.__file__).parent.rglob("loc_STAU20031119011659.z"))
    result = import_files([path], tmp_path / "a.h5")
    assert [(each.sensor, each.channels) for each in result.sensors] == [("LE0083", ("Z",))]
    np.testing.assert_array_equal(
        samples_of(tmp_path / "a.h5")[:, 0], obspy.read(str(path), format="GSE1")[0].data
    )
