"""Signs certificates by the key of a laboratory, and checks signatures, by pyHanko.

Whether an authority stands behind the signer is for the reader's program to say, which knows whom
its user trusts: here a signature is intact or not, and names its signer.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, cast

from pyhanko.pdf_utils.incremental_writer import IncrementalPdfFileWriter
from pyhanko.pdf_utils.reader import PdfFileReader
from pyhanko.sign import signers
from pyhanko.sign.validation import validate_pdf_signature
from pyhanko.sign.validation.status import SignatureCoverageLevel
from pyhanko_certvalidator import ValidationContext

from daq.errors import HuddleError

if TYPE_CHECKING:
    from pathlib import Path

FIELD = "Laboratory"


class SigningError(HuddleError, ValueError):
    """A key cannot be used; the message says which."""

    is_usage_error = True


class Signer:
    """The key and the X.509 certificate of a laboratory.

    Parameters
    ----------
    file : Path
        PKCS #12 (``.p12``, ``.pfx``).
    passphrase : str

    Raises
    ------
    SigningError
        If the file is none, or the passphrase is wrong.
    """

    def __init__(self, file: Path, passphrase: str) -> None:
        if not file.is_file():
            raise SigningError(f"{file}: there is no such file; expected a key (.p12)")
        load = cast("Any", signers.SimpleSigner).load_pkcs12
        signer = load(str(file), passphrase=passphrase.encode() or None)
        if signer is None:
            raise SigningError(f"{file}: no key (.p12), or the passphrase is wrong")
        self._signer = signer

    def __call__(self, content: bytes) -> bytes:
        """Return a PDF with a signature over all of it."""
        writer = IncrementalPdfFileWriter(io.BytesIO(content))
        about = signers.PdfSignatureMetadata(field_name=FIELD, reason="Issue of the certificate")
        signed: bytes = signers.sign_pdf(writer, about, self._signer).getvalue()
        return signed


def signatures(content: bytes) -> list[tuple[str, bool]]:
    """Return the signer of each signature of a PDF, and whether it is intact and of all of it."""
    found = []
    for each in PdfFileReader(io.BytesIO(content)).embedded_signatures:
        own = ValidationContext(trust_roots=[each.signer_cert], allow_fetching=False)
        status = validate_pdf_signature(each, own)
        whole = status.coverage is SignatureCoverageLevel.ENTIRE_FILE
        name = each.signer_cert.subject.human_friendly
        found.append((name, bool(status.intact and status.valid and whole)))
    return found
