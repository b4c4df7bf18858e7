"""Nothing that a file holds is followed, loaded, or allocated beyond what the file can fill."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.errors import NotARecordingError, RecordingError
from daq.recording.reader import Recording, control_address
from daq.recording.repair import verify
from tests.torture.damaged_files import make_recording


def external_storage(file: h5py.File) -> None:
    shape = file["sensors/a/samples"].shape
    attributes = dict(file["sensors/a/samples"].attrs)
    del file["sensors/a/samples"]
    made = file["sensors/a"].create_dataset(
        "samples", shape, "i4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    )
    made.attrs.update(attributes)


def external_link(file: h5py.File) -> None:
    del file["sensors/a/blocks"]
    file["sensors/a/blocks"] = h5py.ExternalLink("other.h5", "/sensors/a/blocks")


def soft_link(file: h5py.File) -> None:
    del file["sensors/a/gaps"]
    file["sensors/a/gaps"] = h5py.SoftLink("/sensors/b/gaps")


def virtual_dataset(file: h5py.File) -> None:
    shape = file["sensors/b/instants"].shape
    del file["sensors/b/instants"]
    layout = h5py.VirtualLayout(shape, "<i8")
    layout[:] = h5py.VirtualSource("other.h5", "x", shape)
    file["sensors/b"].create_virtual_dataset("instants", layout)


def object_type(file: h5py.File) -> None:
    del file["events"]
    file.create_dataset("events", (3,), h5py.string_dtype())


def reference_type(file: h5py.File) -> None:
    del file["events"]
    file.create_dataset("events", (3,), h5py.ref_dtype)


def foreign_filter(file: h5py.File) -> None:
    del file["sensors/b/instants"]
    file["sensors/b"].create_dataset(
        "instants", (0,), "<i8", maxshape=(None,), chunks=(9,), compression="lzf"
    )


def attribute_of_another_type(file: h5py.File) -> None:
    del file.attrs["bench"]
    file.attrs["bench"] = file["events"].ref


def no_such_length(file: h5py.File) -> None:
    file["sensors/a/samples"].resize(1 << 55, axis=0)


def chunk_of_gigabytes(file: h5py.File) -> None:
    del file["sensors/b/instants"]
    file["sensors/b"].create_dataset(
        "instants", (0,), "<i8", maxshape=(None,), chunks=(1 << 28,), compression="gzip"
    )


def negative_count(file: h5py.File) -> None:
    file["committed"][0, 2] = -1


def more_than_there_is(file: h5py.File) -> None:
    file["committed"][-1, 0] = 1 << 40


def sensor_named_as_a_path(file: h5py.File) -> None:
    file["committed"].attrs["sensors"] = ["../sensors/a", "b"]


def sensor_named_twice(file: h5py.File) -> None:
    file["committed"].attrs["sensors"] = ["a", "a"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "r.h5"
    make_recording(path)
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (external_storage, "stored in other files"),
        (external_link, "a link"),
        (soft_link, "a link"),
        (virtual_dataset, "stored in other files"),
        (object_type, "expected numbers"),
        (reference_type, "expected numbers"),
        (foreign_filter, "expected gzip"),
        (attribute_of_another_type, "expected a text"),
        (no_such_length, "more than a file of"),
        (chunk_of_gigabytes, "expected smaller ones"),
        (negative_count, "expected none below 0"),
        (more_than_there_is, "were committed"),
        (sensor_named_as_a_path, "not a name"),
        (sensor_named_twice, "expected different names"),
    ],
)
def test_contents_that_recordings_never_have_are_refused(
    whole: Path, tmp_path: Path, change: Callable[[h5py.File], None], said: str
) -> None:
    path = tmp_path / "r.h5"
    shutil.copyfile(whole, path)
    shutil.copyfile(whole, tmp_path / "other.h5")
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(NotARecordingError, match=said):
        Recording.open(path)
    with pytest.raises(RecordingError, match=said):
        verify(path)


def test_results_that_are_links_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    with h5py.File(path, "r+") as file:
        file["results/other"] = h5py.ExternalLink("/etc/passwd", "/x")
    with Recording.open(path) as recording, pytest.raises(NotARecordingError, match="a link"):
        recording.results()


def test_control_address_of_another_type_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    with h5py.File(path, "r+") as file:
        file["committed"][-1, 1] = 0
        file.attrs["control_port"], file.attrs["control_token"] = np.arange(3), "x"
    with pytest.raises(NotARecordingError, match="control_port"):
        control_address(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_a_pipe_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "r.h5")
    with pytest.raises(NotARecordingError, match="not a huddle recording"):
        Recording.open(tmp_path / "r.h5")
