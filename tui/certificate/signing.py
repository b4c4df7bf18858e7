"""Signs certificates by the key of a laboratory, and checks signatures, by pyHanko.

Whether an authority stands behind the signer is for the reader's program to say, which knows whom
its user trusts: here a signature is intact or not, and names its signer and the key.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.serialization import pkcs12
from pyhanko.pdf_utils.incremental_writer import IncrementalPdfFileWriter
from pyhanko.pdf_utils.reader import PdfFileReader
from pyhanko.sign import signers
from pyhanko.sign.validation import validate_pdf_signature
from pyhanko.sign.validation.status import SignatureCoverageLevel
from pyhanko_certvalidator import ValidationContext

from tui.certificate.keys import KeyFileError, in_pem, key_id, sign

FIELD = "Laboratory"


class Signer:
    """The key and the X.509 certificate of a laboratory.

    Parameters
    ----------
    file : Path
        PKCS #12 (``.p12``, ``.pfx``).
    passphrase : str

    Raises
    ------
    KeyFileError
        If the file is none, or the passphrase is wrong.
    """

    def __init__(self, file: Path, passphrase: str) -> None:
        if not file.is_file():
            raise KeyFileError(f"{file}: there is no such file; expected a key (.p12)")
        secret = passphrase.encode() or None
        try:
            key, certificate, _ = pkcs12.load_key_and_certificates(file.read_bytes(), secret)
        except ValueError:
            raise KeyFileError(f"{file}: no key (.p12), or the passphrase is wrong") from None
        if key is None or certificate is None:
            raise KeyFileError(f"{file}: expected a key with its certificate")
        self._key, public = cast("Any", key), certificate.public_key()
        load = cast("Any", signers.SimpleSigner).load_pkcs12
        self._signer = load(str(file), passphrase=secret)
        self.key_id, self.public_key = key_id(public), in_pem(public)

    def __call__(self, content: bytes) -> bytes:
        """Return a PDF with a signature over all of it."""
        writer = IncrementalPdfFileWriter(io.BytesIO(content))
        about = signers.PdfSignatureMetadata(field_name=FIELD, reason="Issue of the certificate")
        signed: bytes = signers.sign_pdf(writer, about, self._signer).getvalue()
        return signed

    def sign(self, message: bytes) -> bytes:
        """Return the signature of a message."""
        return sign(self._key, message)


@dataclass(frozen=True, slots=True)
class PdfSignature:
    """One signature of a PDF.

    Attributes
    ----------
    signer : str
        As its certificate names it: anybody can make a certificate with any name.
    key_id : str
        Of the key that signed.
    is_intact : bool
        Whether it is genuine, and of the whole file.
    """

    signer: str
    key_id: str
    is_intact: bool


def signatures(content: bytes) -> list[PdfSignature]:
    """Return the signatures of a PDF."""
    found = []
    for each in PdfFileReader(io.BytesIO(content)).embedded_signatures:
        own = ValidationContext(trust_roots=[each.signer_cert], allow_fetching=False)
        status = validate_pdf_signature(each, own)
        whole = status.coverage is SignatureCoverageLevel.ENTIRE_FILE
        key = serialization.load_der_public_key(each.signer_cert.public_key.dump())
        found.append(
            PdfSignature(
                each.signer_cert.subject.human_friendly,
                key_id(key),
                bool(status.intact and status.valid and whole),
            )
        )
    return found
