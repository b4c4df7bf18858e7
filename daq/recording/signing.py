"""Signatures of closed recordings: who had the key says that this is what was recorded.

Checksums show accidents. Who can write a file can also write its checksums; a signature needs the
private key. The signature of ``NAME.h5`` is ``NAME.sig``, a JSON document beside it. What is signed
is the ed25519 signature of the lines ``huddle recording 1``, run id, root SHA-256 and time of
signing, each with a line feed.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import re
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.errors import HuddleError
from daq.python_process import install_command
from daq.recording.chunks.manifest import root_sha256
from daq.recording.reader import Recording
from daq.recording.storage.opening import open_file
from daq.whole_file import PRIVATE, write_whole
from estimator.records import dataclass

if TYPE_CHECKING:
    from daq.bench.model import Bench

SUFFIX = ".sig"
_VARIABLE = re.compile(r"\$\{(\w+)\}")


class SigningError(HuddleError):
    """A key or signature cannot be read, made or written."""


@dataclass(frozen=True, slots=True)
class Signature:
    """The signature of a recording.

    Attributes
    ----------
    run_id, root_sha256 : str
        Of the recording.
    signed : str
        ISO 8601, by the clock of the computer that signed.
    public_key, signature : str
        In base64, 32 and 64 bytes.
    """

    run_id: str
    root_sha256: str
    signed: str
    public_key: str
    signature: str = ""

    @property
    def key_id(self) -> str:
        """The first 16 digits of the SHA-256 of the public key."""
        return hashlib.sha256(base64.b64decode(self.public_key)).hexdigest()[:16]

    @property
    def message(self) -> bytes:
        """What is signed."""
        lines = ("huddle recording 1", self.run_id, self.root_sha256, self.signed)
        return "".join(f"{line}\n" for line in lines).encode()

    def is_genuine(self) -> bool:
        """Whether it was made with the private key of its public key."""
        ed25519 = _library("asymmetric.ed25519")
        try:
            key = ed25519.Ed25519PublicKey.from_public_bytes(base64.b64decode(self.public_key))
            key.verify(base64.b64decode(self.signature), self.message)
        except Exception:  # noqa: BLE001 - the library raises its own; whatever it is, it is not
            return False
        return True


def make_key(path: Path) -> Path:
    """Make a private key, readable by its owner alone; return the path of the public one.

    Raises
    ------
    SigningError
        If there is a file, or it cannot be written.
    """
    ed25519, forms = _library("asymmetric.ed25519"), _library("serialization")
    key = ed25519.Ed25519PrivateKey.generate()
    private = key.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, forms.NoEncryption())
    public = key.public_key().public_bytes(
        forms.Encoding.PEM, forms.PublicFormat.SubjectPublicKeyInfo
    )
    beside = path.with_name(f"{path.name}.pub")
    try:
        if beside.exists():
            raise FileExistsError(f"{beside} exists")
        write_whole(path, private, mode=PRIVATE, free=True)
        try:
            write_whole(beside, public, free=True)
        except OSError:
            path.unlink()
            raise
    except OSError as error:
        raise SigningError(f"{path}: no key can be written: {error}; nothing is replaced") from None
    return beside


def key_of(bench: Bench) -> Path | None:
    """Return the private key of a bench file; None if its recordings are not signed.

    Raises
    ------
    SigningError
        If it is in the folder of the recordings, or its path is relative.
    """
    if bench.signing is None:
        return None
    stated = bench.signing.key
    path = Path(_VARIABLE.sub(lambda m: os.environ.get(m[1], m[0]), stated)).expanduser()
    if not path.is_absolute():
        raise SigningError(f"signing.key = {stated!r}: expected an absolute path")
    if path.resolve().is_relative_to(bench.recording_directory.resolve()):
        raise SigningError(
            f"signing.key = {stated!r}: in the folder of the recordings; expected another place,"
            " which those who can write recordings cannot read"
        )
    return path


def sign(path: Path, key: Path, *, now: datetime | None = None) -> Signature:
    """Sign a closed recording; its signature is written beside it.

    Raises
    ------
    SigningError
        If it is not closed, of format 1, or the key or the signature cannot be read or written.
    RecordingError
        If the recording cannot be read.
    """
    run_id, root = identity(path)
    if not root:
        raise SigningError(f"{path}: has no manifest; expected a closed recording of this version")
    private = _private(key)
    forms = _library("serialization")
    raw = private.public_key().public_bytes(forms.Encoding.Raw, forms.PublicFormat.Raw)
    moment = (datetime.now(UTC) if now is None else now).isoformat(timespec="seconds")
    unsigned = Signature(run_id, root, moment, base64.b64encode(raw).decode())
    made = base64.b64encode(private.sign(unsigned.message)).decode()
    signature = Signature(run_id, root, moment, unsigned.public_key, made)
    target = path.with_suffix(SUFFIX)
    try:
        write_whole(target, f"{json.dumps(asdict(signature), indent=1)}\n".encode())
    except OSError as error:
        raise SigningError(f"{target}: cannot be written: {error.strerror}") from error
    return signature


def identity(path: Path) -> tuple[str, str]:
    """Return run id and root SHA-256 of a recording, as stored; the latter empty if not closed.

    Raises
    ------
    RecordingError
        If it cannot be read.
    """
    with Recording.open(path) as recording:
        run_id, closed = recording.run_id, recording.closed
    with open_file(path) as file:
        return run_id, root_sha256(file) if closed else ""


def signature_of(path: Path) -> Signature | None:
    """Return the signature beside a recording; None if there is none.

    Raises
    ------
    SigningError
        If it is no signature.
    """
    beside = path.with_suffix(SUFFIX)
    try:
        found: dict[str, Any] = json.loads(beside.read_text(encoding="ascii"))
        signature = Signature(**{name: str(value) for name, value in found.items()})
        _ = signature.key_id  # its key can be decoded
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, AttributeError, binascii.Error) as error:
        raise SigningError(f"{beside}: no signature: {error}") from None
    return signature


def problem(path: Path, run_id: str, root: str, *, public: Path | None = None) -> str:
    """Return what is wrong with the signature of a recording; empty if nothing is.

    Parameters
    ----------
    path : Path
    run_id, root : str
        Of the recording, whose contents were compared with its manifest.
    public : Path, optional
        Public key that must have signed it. Without it, a recording need not be signed.

    Raises
    ------
    SigningError
        If the public key cannot be read.
    """
    wanted = None if public is None else _public(public)
    try:
        found = signature_of(path)
    except SigningError as error:
        return str(error)
    if found is None:
        return "" if wanted is None else "not signed"
    if (found.run_id, found.root_sha256) != (run_id, root):
        return "the signature is of another recording, or the recording was changed since"
    if not found.is_genuine():
        return "the signature is false"
    if wanted is not None and base64.b64decode(found.public_key) != wanted:
        return f"signed with another key, {found.key_id}"
    return ""


def signed_by(path: Path) -> str:
    """Return the id of the key of a genuine signature of this recording; empty if there is none."""
    try:
        found = signature_of(path)
        if found is None or problem(path, *identity(path)):
            return ""
    except SigningError:
        return ""
    return found.key_id


def _private(path: Path) -> Any:  # noqa: ANN401 - a class of the library
    key = _loaded(path, "load_pem_private_key", password=None)
    if not isinstance(key, _library("asymmetric.ed25519").Ed25519PrivateKey):
        raise SigningError(f"{path}: expected an ed25519 key, as huddle sign --new-key makes it")
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise SigningError(f"{path}: others may read it; expected chmod 600")
    return key


def _public(path: Path) -> bytes:
    key = _loaded(path, "load_pem_public_key")
    if not isinstance(key, _library("asymmetric.ed25519").Ed25519PublicKey):
        raise SigningError(f"{path}: expected the public key of huddle sign --new-key ({path}.pub)")
    return bytes(key.public_bytes_raw())


def _loaded(path: Path, function: str, **options: object) -> Any:  # noqa: ANN401 - of the library
    try:
        return getattr(_library("serialization"), function)(path.read_bytes(), **options)
    except OSError as error:
        raise SigningError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, TypeError) as error:
        raise SigningError(f"{path}: no key: {error}") from None


def _library(name: str) -> Any:  # noqa: ANN401 - a module
    from importlib import import_module  # noqa: PLC0415 - takes 50 ms, and seldom needed

    try:
        return import_module(f"cryptography.hazmat.primitives.{name}")
    except ImportError:
        raise SigningError(
            f"signatures need the package cryptography; run: {install_command('signing')}"
        ) from None
