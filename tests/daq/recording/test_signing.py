"""Signatures: openssl and the library of others must agree with them, and no change pass."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from daq.recording.chunks.manifest import MANIFEST, write_manifest
from daq.recording.description import write_checksums
from daq.recording.signing import (
    SigningError,
    identity,
    key_of,
    make_key,
    sign,
    signature_of,
    signed_by,
)
from tests.command import huddle
from tests.tui.service.bench_files import HOURLY, bench_of
from tests.tui.service.test_healing import record
from tui.commands.main import app


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a key and a recording that is signed with it."""
    folder = tmp_path_factory.mktemp("laboratory")
    record(folder / "r.h5", 2)
    make_key(folder / "lab.key")
    sign(folder / "r.h5", folder / "lab.key")
    return folder


@pytest.fixture
def signed(laboratory: Path, tmp_path: Path) -> Path:
    """Return a copy of the signed recording, beside ``lab.key``."""
    return Path(shutil.copytree(laboratory, tmp_path, dirs_exist_ok=True)) / "r.h5"


def verified(path: Path, *options: str) -> str:
    """Return what ``huddle verify`` says of a recording."""
    result = CliRunner().invoke(app, ["verify", str(path), "--json", "-", *options])
    (found,) = json.loads(result.stdout)["recordings"]
    assert (result.exit_code == 0) == found["intact"]
    return str(found["state"])


def test_a_signature_is_that_of_openssl(signed: Path, tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    found = signature_of(signed)
    assert found is not None
    (tmp_path / "message").write_bytes(found.message)
    (tmp_path / "signature").write_bytes(base64.b64decode(found.signature))
    command = ["openssl", "pkeyutl", "-verify", "-pubin", "-rawin"]
    command += ["-inkey", str(tmp_path / "lab.key.pub"), "-in", str(tmp_path / "message")]
    said = subprocess.run(
        [*command, "-sigfile", str(tmp_path / "signature")], check=True, capture_output=True
    )
    assert b"Verified Successfully" in said.stdout


def test_verify_names_the_key(signed: Path, tmp_path: Path) -> None:
    key = str(tmp_path / "lab.key.pub")
    state = verified(signed, "--key", key)
    assert state == verified(signed) == f"intact, signed with key {signed_by(signed)}"
    assert len(signed_by(signed)) == 16
    other = make_key(tmp_path / "other.key")
    assert "another key" in verified(signed, "--key", str(other))
    signed.with_suffix(".sig").unlink()
    assert verified(signed) == "intact"
    assert verified(signed, "--key", key) == "not signed"
    assert signed_by(signed) == ""


def test_changed_with_checksums_rewritten(signed: Path) -> None:
    """Checksums do not show it; the signature does."""
    with h5py.File(signed, "r+", libver="latest") as file:
        file.attrs["location"] = np.bytes_(b"elsewhere")
        write_checksums(file)
        write_manifest(file, MANIFEST)
    assert verified(signed).startswith("the signature is of another recording")
    signed.with_suffix(".sig").unlink()
    assert verified(signed) == "intact"


@pytest.mark.parametrize("field", ["run_id", "root_sha256", "signed", "signature", "public_key"])
def test_a_changed_signature_is_false(signed: Path, tmp_path: Path, field: str) -> None:
    beside = signed.with_suffix(".sig")
    found = json.loads(beside.read_text())
    text = found[field]
    found[field] = ("B" if text[0] == "A" else "A") + text[1:]
    beside.write_text(json.dumps(found))
    state = verified(signed, "--key", str(tmp_path / "lab.key.pub"))
    assert not state.startswith("intact")
    assert signed_by(signed) == ""


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"run_id": 1}', "\xff"])
def test_what_is_no_signature_is_named(signed: Path, text: str) -> None:
    signed.with_suffix(".sig").write_text(text, encoding="latin-1")
    assert "no signature" in verified(signed)


def test_keys_are_private_and_not_replaced(signed: Path, tmp_path: Path) -> None:
    key = tmp_path / "lab.key"
    assert key.stat().st_mode & 0o077 == 0
    with pytest.raises(SigningError, match="nothing is replaced"):
        make_key(key)
    key.chmod(0o644)
    with pytest.raises(SigningError, match="others may read it"):
        sign(signed, key)
    with pytest.raises(SigningError, match="no key"):
        sign(signed, signed)


def test_the_command_signs_what_is_intact(tmp_path: Path) -> None:
    record(tmp_path / "r.h5", 2)
    key, path = str(tmp_path / "k"), tmp_path / "r.h5"
    huddle("sign", "--new-key", key)
    huddle("sign", path, "--key", key)
    assert verified(path, "--key", f"{key}.pub").startswith("intact, signed")
    with h5py.File(path, "r+", libver="latest") as file:
        file.attrs["location"] = np.bytes_(b"elsewhere")
    result = CliRunner().invoke(app, ["sign", str(path), "--key", key])
    assert (result.exit_code, "damaged" in result.stderr) == (3, True)


def test_a_key_is_not_beside_the_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "credentials"))
    text = '[signing]\nkey = "${CREDENTIALS_DIRECTORY}/lab.key"\n'
    bench = bench_of(tmp_path, HOURLY + text)
    assert key_of(bench) == tmp_path / "credentials" / "lab.key"
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(bench.recording_directory))
    with pytest.raises(SigningError, match="expected another place"):
        key_of(bench)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", "here")
    with pytest.raises(SigningError, match="absolute"):
        key_of(bench)


def test_an_open_recording_is_not_signed(tmp_path: Path) -> None:
    record(tmp_path / "r.h5", 2, closed=False)
    make_key(tmp_path / "k")
    assert identity(tmp_path / "r.h5")[1] == ""
    with pytest.raises(SigningError, match="no manifest"):
        sign(tmp_path / "r.h5", tmp_path / "k")
