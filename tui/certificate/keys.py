"""Public keys of laboratories: what names them, and what they have signed.

A key is named by its id, the first 16 digits of the SHA-256 of the public key: of its 32 bytes for
ed25519, as `daq.recording.signing` does it, and of its SubjectPublicKeyInfo (DER) for others.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding, rsa

from daq.errors import HuddleError

if TYPE_CHECKING:
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric.types import (
        CertificateIssuerPrivateKeyTypes,
        PublicKeyTypes,
    )


class KeyFileError(HuddleError, ValueError):
    """A key cannot be used; the message says which."""

    is_usage_error = True


def public_key(file: Path) -> PublicKeyTypes:
    """Return the public key of a file: a key or an X.509 certificate, in PEM.

    Raises
    ------
    KeyFileError
        If the file cannot be read, or is neither.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise KeyFileError(f"{file}: cannot be read: {error.strerror}") from None
    try:
        if b"BEGIN CERTIFICATE" in content:
            return x509.load_pem_x509_certificate(content).public_key()
        return serialization.load_pem_public_key(content)
    except (ValueError, TypeError) as error:
        raise KeyFileError(
            f"{file}: no public key: {error}; expected PEM, a public key or a certificate"
        ) from None


def loaded(text: str) -> PublicKeyTypes:
    """Return the public key of a text in PEM.

    Raises
    ------
    ValueError
        If it is none.
    """
    return serialization.load_pem_public_key(text.encode())


def in_pem(key: PublicKeyTypes) -> str:
    """Return a public key as text."""
    forms = serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    return key.public_bytes(*forms).decode()


def key_id(key: PublicKeyTypes) -> str:
    """Return the id of a public key."""
    if isinstance(key, ed25519.Ed25519PublicKey):
        content = key.public_bytes_raw()
    else:
        content = key.public_bytes(
            serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
        )
    return hashlib.sha256(content).hexdigest()[:16]


def sign(key: CertificateIssuerPrivateKeyTypes, message: bytes) -> bytes:
    """Return the signature of a message.

    Raises
    ------
    KeyFileError
        If the key is of a kind that this program does not use.
    """
    if isinstance(key, ec.EllipticCurvePrivateKey):
        return key.sign(message, ec.ECDSA(hashes.SHA256()))
    if isinstance(key, rsa.RSAPrivateKey):
        return key.sign(message, padding.PKCS1v15(), hashes.SHA256())
    if isinstance(key, ed25519.Ed25519PrivateKey):
        return key.sign(message)
    raise KeyFileError(f"{type(key).__name__}: expected a key of RSA, ECDSA or Ed25519")


def is_genuine(key: PublicKeyTypes, message: bytes, signature: bytes) -> bool:
    """Whether a message was signed with the private key of a public one."""
    try:
        if isinstance(key, ec.EllipticCurvePublicKey):
            key.verify(signature, message, ec.ECDSA(hashes.SHA256()))
        elif isinstance(key, rsa.RSAPublicKey):
            key.verify(signature, message, padding.PKCS1v15(), hashes.SHA256())
        elif isinstance(key, ed25519.Ed25519PublicKey):
            key.verify(signature, message)
        else:
            return False
    except InvalidSignature:
        return False
    return True
