"""Files inside archives, and names with blanks."""

from __future__ import annotations

import bz2
import gzip
import io
import tarfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.errors import ImportFormatError
from daq.formats.importer import import_files
from daq.recording.reader import Recording
from tests.daq.formats.test_sources import counts, write_records

if TYPE_CHECKING:
    from numpy.typing import NDArray


def packed(folder: Path, kind: str, names: dict[str, bytes]) -> Path:
    """Pack files."""
    path = folder / f"day.mseed.{kind}" if kind in {"gz", "bz2"} else folder / f"day.{kind}"
    if kind == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in names.items():
                archive.writestr(name, content)
    elif "tar" in kind or kind == "tgz":
        with tarfile.open(path, "w:gz" if kind in {"tgz", "tar.gz"} else "w") as tar:
            for name, content in names.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
    else:
        whole = b"".join(names.values())
        path.write_bytes((gzip if kind == "gz" else bz2).compress(whole))
    return path


def samples_of(path: Path) -> NDArray[np.int32]:
    with Recording.open(path) as recording:
        (sensor,) = recording.sensors
        return np.asarray(sensor.counts())


@pytest.mark.parametrize("kind", ["gz", "bz2", "zip", "tar", "tar.gz", "tgz"])
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
    path = packed(tmp_path, "bz2", {"": b"\0" * (50 << 20)})
    with pytest.raises(ImportFormatError, match="more than 100 times its size"):
        import_files([path], tmp_path / "a.h5")
    with pytest.raises(ImportFormatError, match="cannot be unpacked"):
        import_files([tmp_path / "none.zip"], tmp_path / "a.h5")
    assert not (tmp_path / "a.h5").exists()


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
