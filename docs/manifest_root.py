"""The root of a recording, one SHA-256 for all of it; nothing of huddle is imported."""

from __future__ import annotations

import hashlib
import json

import h5py
import numpy as np


def sha256(value: object) -> str:
    """Return the hash of a dataset or of the value of an attribute."""
    array = np.asarray(value)
    if array.dtype.kind in "SO" and not isinstance(value, h5py.Dataset):  # texts
        texts = [t.decode() if isinstance(t, bytes) else t for t in array.ravel().tolist()]
        text = json.dumps(texts if array.shape else texts[0], ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()
    kind = array.dtype.newbyteorder("<")
    head = json.dumps([kind.descr if kind.names else kind.str, array.shape], separators=(",", ":"))
    contents = hashlib.sha256(array.astype(kind).tobytes()).digest()
    return hashlib.sha256(head.encode() + b"\n" + contents).hexdigest()


def root(path: str) -> str:
    """Return the root of a recording."""
    found: dict[str, str] = {}

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        for key, value in item.attrs.items():
            found[f"/{name}@{key}"] = sha256(value)
        if isinstance(item, h5py.Dataset):
            found[f"/{name}"] = sha256(item)

    with h5py.File(path) as file:
        add("", file)
        for name, item in file.items():
            if name not in {"manifest", "results", "results_manifest"}:
                add(name, item)
                if isinstance(item, h5py.Group):
                    item.visititems(lambda below, item, name=name: add(f"{name}/{below}", item))
    lines = "".join(f"{found[name]}  {name}\n" for name in sorted(found))
    return hashlib.sha256(lines.encode()).hexdigest()
