"""The manifest of a closed recording: SHA-256 of every dataset and attribute, and of all of them.

``/manifest`` has one row for each dataset (its path) and each attribute (``path@name``), in the
order of the paths. Its first row, ``/``, is the root: the SHA-256 of the lines of all other rows,
as ``sha256sum`` writes them. ``/results`` can be made again, so it has a manifest of its own,
``/results_manifest``, and the root of a recording never changes.

The SHA-256 of a dataset or attribute is that of a line of JSON with type and shape, and of the
SHA-256 of its contents: numbers little-endian in C order, texts as JSON. So it does not depend on
chunks, compression or the length of strings. `docs/recording-format.md` has a program that computes
it.

The tables have their final size from the beginning, because an SWMR writer cannot add objects. They
are zeros until the recording is closed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.errors import NotARecordingError
from daq.recording.file_format import texts
from daq.recording.storage.refusals import dataset, member
from daq.recording.storage.whole_hdf5 import contents_sha256, little_endian

MANIFEST, RESULTS = "manifest", "results"
RESULTS_MANIFEST = "results_manifest"
ROOT = "/"
UNREADABLE = "cannot be read"
"""In place of the SHA-256 of a dataset."""


def make_manifest(file: h5py.File) -> None:
    """Create the empty ``/manifest`` of a new recording, whose other objects are all there."""
    names = [ROOT, *(name for name, _ in items(file, MANIFEST))]
    file.create_dataset(MANIFEST, data=np.zeros(len(names), _dtype(names)))


def write_manifest(
    file: h5py.File, name: str = MANIFEST, contents: Mapping[str, bytes] | None = None
) -> None:
    """Write a manifest of a complete recording, or of its results.

    Parameters
    ----------
    file : h5py.File
    name : str
        `MANIFEST` or `RESULTS_MANIFEST`.
    contents : mapping, optional
        SHA-256 of the contents of datasets by path, where the writer knows them; the others are
        read.
    """
    rows = _rows(computed(file, name, contents=contents))
    if name in file and file[name].dtype == rows.dtype and file[name].shape == rows.shape:
        file[name][...] = rows
        return
    if name in file:
        del file[name]
    file.create_dataset(name, data=rows)


def differences(file: h5py.File, *, progress: Callable[[], object] = lambda: None) -> list[str]:
    """Read every object of a closed recording; return what differs from its manifests.

    Raises
    ------
    NotARecordingError, OSError, RuntimeError
        If a group or attribute cannot be read, or an object is one that no recording has.
    """
    # Also indexes that nothing here needs: other programs visit objects by them.
    file.visititems(lambda _name, _found: None)
    changed = []
    for name in (MANIFEST, RESULTS_MANIFEST):
        found = computed(file, name, progress=progress)
        if name not in file:
            changed += [path for path, digest in found.items() if digest == UNREADABLE]
            if name == MANIFEST and int(file.attrs["format_version"]) > 1:
                changed.append(f"/{MANIFEST}")
            continue
        expected = _stored(file, name)
        if name == MANIFEST and expected.get(ROOT) != _root(found):
            changed.append(f"/{MANIFEST}")
        expected.pop(ROOT, None)
        changed += sorted(n for n in {*found, *expected} if found.get(n) != expected.get(n))
    return changed


def root_sha256(file: h5py.File) -> str:
    """Return the root of a recording, as stored; empty if it was not closed, or is of version 1."""
    return _stored(file, MANIFEST).get(ROOT, "") if MANIFEST in file else ""


def computed(
    file: h5py.File,
    name: str = MANIFEST,
    *,
    contents: Mapping[str, bytes] | None = None,
    progress: Callable[[], object] = lambda: None,
) -> dict[str, str]:
    """Return the SHA-256 of all datasets and attributes that a manifest covers, by name."""
    known = contents or {}
    found = {}
    for path, value in items(file, name):
        if isinstance(value, h5py.Dataset):
            try:
                inner = known[path] if path in known else contents_sha256(value, progress)
                found[path] = _sha256(value.dtype, value.shape, inner)
            except (OSError, RuntimeError):
                found[path] = UNREADABLE
        else:
            found[path] = _attribute_sha256(value)
        progress()
    return found


def items(file: h5py.File, manifest: str = MANIFEST) -> Iterator[tuple[str, Any]]:
    """Yield the datasets, and the values of the attributes, that a manifest covers."""
    if manifest == RESULTS_MANIFEST:
        if RESULTS in file:
            yield from _below(member(file, RESULTS), set())
        return
    yield from _attributes(file)
    for name in file:
        if name not in {MANIFEST, RESULTS, RESULTS_MANIFEST}:
            yield from _within(file, name, set())


def _within(group: h5py.Group, name: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    found = member(group, name)
    if isinstance(found, h5py.Group):
        yield from _below(found, seen)
    else:
        found = dataset(group, name, in_parts=True)
        yield found.name, found
        yield from _attributes(found)


def _below(group: h5py.Group, seen: set[int]) -> Iterator[tuple[str, Any]]:
    address = h5py.h5o.get_info(group.id).addr
    if address in seen:  # a damaged group that holds itself would never end
        raise NotARecordingError(f"{group.file.filename}: {group.name}: a group within itself")
    seen.add(address)
    yield from _attributes(group)
    for name in group:
        yield from _within(group, name, seen)


def _attributes(found: h5py.Group | h5py.Dataset) -> Iterator[tuple[str, Any]]:
    path = found.name.rstrip("/") or "/"
    for name in found.attrs:
        yield f"{path}@{name}", found.attrs[name]


def _attribute_sha256(value: Any) -> str:  # noqa: ANN401 - any attribute
    value = texts(value)
    if isinstance(value, (str, list)):
        text = json.dumps(value, ensure_ascii=False)
        return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()
    numbers = np.asarray(value)
    inner = hashlib.sha256(little_endian(numbers)).digest()
    return _sha256(numbers.dtype, numbers.shape, inner)


def _sha256(dtype: np.dtype[Any], shape: tuple[int, ...], inner: bytes) -> str:
    described = dtype.newbyteorder("<")
    fields = described.descr if described.names else described.str
    head = json.dumps([fields, shape], separators=(",", ":"))
    return hashlib.sha256(f"{head}\n".encode() + inner).hexdigest()


def _root(entries: Mapping[str, str]) -> str:
    lines = "".join(f"{entries[name]}  {name}\n" for name in sorted(entries))
    return hashlib.sha256(lines.encode()).hexdigest()


def _dtype(names: list[str]) -> np.dtype[Any]:
    return np.dtype([("path", f"S{max(len(n.encode()) for n in names)}"), ("sha256", "S64")])


def _rows(entries: Mapping[str, str]) -> NDArray[np.void]:
    names = sorted(entries)
    rows = [(ROOT, _root(entries)), *((name, entries[name]) for name in names)]
    encoded = [(name.encode(), digest.encode()) for name, digest in rows]
    return np.array(encoded, _dtype([ROOT, *names]))


def _stored(file: h5py.File, name: str) -> dict[str, str]:
    rows = dataset(file, name)[...]
    if rows.dtype.names != ("path", "sha256") or rows.ndim != 1:
        raise NotARecordingError(f"{file.filename}: damaged: /{name} is no manifest")
    return {
        row["path"].decode(errors="replace"): row["sha256"].decode(errors="replace")
        for row in rows
        if row["path"]
    }
