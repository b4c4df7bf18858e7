"""What people's files have wrong is named, quickly, and never taken for a fault of the program."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from daq.errors import ImportFormatError
from daq.formats.importer import import_files
from daq.formats.readers import npz
from daq.recording.reader import Recording
from tests.daq.formats.test_libraries import opened
from tests.traced_memory import peak_of

SAMPLES = np.arange(500)
AT: dict[str, Any] = {"sampling_rate": 100.0}


def refused(path: Path, said: str, **options: Any) -> None:  # noqa: ANN401 - of `import_files`
    """See that a file is refused in words, and that nothing is written beside it."""
    before = sorted(path.parent.iterdir())
    with pytest.raises(ImportFormatError, match=said):
        import_files([path], path.parent / "a.h5", **options)
    assert sorted(path.parent.iterdir()) == before


@pytest.mark.parametrize("encoding", ["cp1252", "utf-16", "utf-8", "utf-8-sig"])
def test_a_csv_is_read_in_the_encoding_it_has(tmp_path: Path, encoding: str) -> None:
    rows = "\n".join(f"{k / 100:.2f},{k % 7}" for k in range(200))
    source = tmp_path / "a.csv"
    source.write_text(f"time [s],A.X [m/s²]\n{rows}\n", encoding=encoding)
    import_files([source], tmp_path / "a.h5")
    with Recording.open(tmp_path / "a.h5") as recording:
        (channel,) = recording.sensors[0].channels
    assert (channel.name, channel.unit) == ("X", "m/s²")


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"a/b": SAMPLES, **AT}, "sensor name 'a/b': expected a printable name without '/'"),
        ({"x" * 80: SAMPLES, **AT}, "expected a name of 1 to 64 bytes"),
        ({"\x1b[31mred": SAMPLES, **AT}, r"sensor name '\\x1b\[31mred': expected a printable name"),
        ({"A": SAMPLES, "sampling_rate": np.inf}, "positive sampling_rate"),
        ({"A": SAMPLES, "sampling_rate": 1e300}, r"of 1e\+300 Hz; expected 1e-06 to 1e\+07 Hz"),
        ({"A": SAMPLES, "sampling_rate": 1e-300}, "of 1e-300 Hz"),
        ({"A": np.zeros((3, 200_000)), **AT}, "200000 channels; expected at most 1000"),
        ({"A": np.zeros((5, 2))}, "sampling_rate"),
        ({"A": np.zeros((5, 2)), "sampling_rate": 0.0}, "positive sampling_rate"),
        ({"A": np.zeros((5, 2)), "sampling_rate": np.ones(2)}, "one number"),
        (AT, "no sensors"),
        ({"A": np.zeros((5, 2, 1)), **AT}, r"\(n_samples, n_channels\)"),
        ({"A": np.array(["x"]), **AT}, "expected numbers"),
        ({"A": np.zeros(5), "start_time": "noon", **AT}, "start_time"),
        ({"A": np.zeros(5), "start_time": 1_764_500_000, **AT}, "found 1764500000"),
    ],
)
def test_what_an_archive_has_wrong_is_named(
    tmp_path: Path, arrays: dict[str, Any], said: str
) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    refused(tmp_path / "a.npz", said)


def header(shape: tuple[int, ...]) -> bytes:
    content = io.BytesIO()
    described = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(content, described)
    return content.getvalue()


def test_an_archive_that_says_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("A.npy", header((1 << 40,)) + bytes(1000))
    refused(tmp_path / "a.npz", r"shape \(1099511627776,\) in 1128 bytes", sampling_rate=100.0)


def test_an_archive_that_inflates_to_gigabytes_is_refused(tmp_path: Path) -> None:
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("A.npy", "w") as file,
    ):
        file.write(header((1 << 26,)))
        for _ in range(1 << 6):
            file.write(bytes(1 << 23))
    refused(tmp_path / "a.npz", r"A\.npy: \d+ bytes that become 536871040", sampling_rate=100.0)


def test_a_matlab_file_that_inflates_to_gigabytes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(npz, "_LARGE", 1 << 20)  # of 256 MB, which would take a second
    savemat(tmp_path / "a.mat", {"sampling_rate": 100.0, "A": SAMPLES}, do_compression=True)
    packed = zlib.compress(bytes(1 << 22))
    with (tmp_path / "a.mat").open("ab") as file:
        file.write(struct.pack("<II", 15, len(packed)) + packed)
    refused(tmp_path / "a.mat", r"array: \d+ bytes that become 42\d{5}")


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@pytest.mark.parametrize(("of_class", "said"), [(1, "found cell"), (4, "in 192 bytes")])
def test_a_matlab_file_that_says_more_than_it_holds_is_refused(
    tmp_path: Path, of_class: int, said: str
) -> None:
    matrix = element(6, struct.pack("<II", of_class, 0)) + element(
        5, struct.pack("<ii", 1, 1 << 28)
    )
    matrix += element(1, b"A") + element(16, b"")
    (tmp_path / "a.mat").write_bytes(
        b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + element(14, matrix)
    )

    def read() -> None:
        refused(tmp_path / "a.mat", said, sampling_rate=100.0)

    assert peak_of(read) < 1 << 24


def test_all_arrays_of_a_file_together_become_no_more_than_it_can_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(npz, "_LARGE", 1 << 20)
    many: dict[str, Any] = {f"A{n}": np.zeros(1 << 16) for n in range(9)}
    np.savez_compressed(tmp_path / "a.npz", **many)
    savemat(tmp_path / "a.mat", many, do_compression=True)
    for name in ("a.npz", "a.mat"):
        refused(tmp_path / name, "bytes that become 1", sampling_rate=100.0)


@pytest.mark.parametrize(
    ("name", "method", "said"),
    [
        ("A.npy", zipfile.ZIP_BZIP2, "packed otherwise than numpy does"),
        ("A.npy", zipfile.ZIP_LZMA, "packed otherwise than numpy does"),
        ("README", zipfile.ZIP_STORED, "not an array"),
    ],
)
def test_what_numpy_does_not_write_is_refused(
    tmp_path: Path, name: str, method: int, said: str
) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr(name, header((1 << 20,)) + bytes(8 << 20))
    refused(tmp_path / "a.npz", f"{name}: {said}", sampling_rate=100.0)


_WAV, _FORMAT = b"RIFF\x24\0\0\0WAVEfmt ", struct.Struct("<IHHIIHH")


def test_a_wav_file_that_is_cut_off_is_read_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    described = _FORMAT.pack(16, 1, 1, 100, 200, 2, 16) + b"data\xff\xff\0\0"
    (tmp_path / "a.wav").write_bytes(b"RIFF\x23\0\1\0" + _WAV[8:] + described + bytes(400))
    assert opened(tmp_path / "a.wav")["a"].stretches[0].n_samples == 200
    assert "ends after 200 samples, before its header says" in caplog.text


def test_the_unit_of_times_without_one_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "daq.formats")
    (tmp_path / "a.csv").write_bytes(b"time,A.X\n1e12,1\n1000000000010,2\n")
    assert opened(tmp_path / "a.csv")["A"].sampling_rate == 100.0
    assert "times such as 1e12 have no unit; read as ms since 1970" in caplog.text
    (tmp_path / "b.csv").write_bytes(b"time,A.X\n0,1\n10,2\n20,1\n")
    assert opened(tmp_path / "b.csv")["A"].sampling_rate == 0.1
    assert "times such as 0 and 10 have no unit; read as s: state the unit" in caplog.text


@pytest.mark.parametrize(
    ("kind", "content", "said"),
    [
        ("csv", b"\x00\x01\x02" * 1000, "not a text; expected a CSV file"),
        (
            "csv",
            ",".join(f"A.c{k}" for k in range(200_000)).encode(),
            "200000 columns; expected one a",
        ),
        ("csv", b"time,A.X,A.X\n0.0,1,2\n0.1,1,2\n", "several channels are named 'X'"),
        ("csv", b"time,A.X\n", "expected rows of 2 cells"),
        ("csv", b"", "expected a first line that names every column"),
        ("csv", b"time (s),A.X\n1e12,1\n1000000000001,2\n", "time '1e12': beyond the year 2262"),
        (
            "csv",
            b"time,A.X\n2500-01-01T00:00:00,1\n2500-01-01T00:00:01,2\n",
            "beyond the year 2262",
        ),
        ("csv", b"time,A.X\n0,1\ninf,2\n", "time 'inf': expected a finite number"),
        ("csv", b"time,A.X\nnan,1\n1,2\n", "time 'nan': expected a finite number"),
        ("csv", b"1,2\n3,4\n", "names every column"),
        ("csv", b"time,X\n0,1\n1,oops\n", "oops"),
        ("csv", b"time,X\n0,1\n1,2,3\n", "cells"),
        ("csv", b"time,X\n0,1\n0,2\n", "always increases"),
        ("csv", b"time,X\nnoon,1\n1,2\n", "noon"),
        ("csv", b"time\n0\n1\n", "column of samples"),
        ("wav", b"\x86\xa8 world \xff", "not a WAV file: it does not begin with RIFF"),
        ("wav", b"RIFF", "not a WAV file"),
        ("wav", _WAV, "damaged or cut off"),
        ("wav", _WAV + _FORMAT.pack(16, 7, 1, 8000, 8000, 1, 8) + b"data\0\0\0\0", "MULAW"),
        ("mat", b"nothing of the kind", r"a\.mat: .*MATLAB"),
        ("mat", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM", r"a\.mat: .*MATLAB"),
        ("npz", b"not a zip", "a.npz"),
    ],
)
def test_what_a_file_has_wrong_is_named(
    tmp_path: Path, kind: str, content: bytes, said: str
) -> None:
    path = tmp_path / f"a.{kind}"
    path.write_bytes(content)
    refused(path, said)
