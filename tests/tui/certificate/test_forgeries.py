"""Forgeries of certificates, ledgers and recordings, each found and named."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import sqlite3
import sys
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.serialization import pkcs12
from pypdf import PdfReader, PdfWriter
from pypdf.generic import ContentStream, NameObject

from tests.traced_memory import peak_of
from tests.tui.certificate.laboratory import Laboratory, key, laboratory, rescale
from tui.certificate.ledger import NAME, Ledger
from tui.certificate.signing import PdfSignature, Signer, signatures
from tui.certificate.verification import JSON_NAME, Claims, VerificationError, _signatures, verify

pytestmark = pytest.mark.usefixtures("short_pages")


def bomb(n: int) -> bytes:
    """Return a PDF with n results, each of which becomes 64 MB."""
    packed = zlib.compress(zlib.compress(bytes(64 << 20), 9), 9)
    names = " ".join(f"(result.json) {2 * k + 2} 0 R" for k in range(n))
    parts = [
        f"<</Type/Catalog/Names<</EmbeddedFiles<</Names[{names}]>>>>"
        f"/Pages<</Type/Pages/Kids[]/Count 0>>>>".encode()
    ]
    for k in range(n):
        parts.append(
            f"<</Type/Filespec/F(result.json)/UF(result.json)/EF<</F {2 * k + 3} 0 R>>>>".encode()
        )
        about = f"<</Filter[/FlateDecode/FlateDecode]/Length {len(packed)}>>stream\n"
        parts.append(about.encode() + packed + b"\nendstream")
    content, places = b"%PDF-1.7\n", []
    for number, part in enumerate(parts, 1):
        places.append(len(content))
        content += b"%d 0 obj\n" % number + part + b"\nendobj\n"
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    head = b"xref\n0 %d\n0000000000 65535 f \n" % (len(parts) + 1)
    end = b"trailer<</Size %d/Root 1 0 R>>\nstartxref\n%d\n%%%%EOF\n"
    return content + head + table + end % (len(parts) + 1, len(content))


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux")
def test_what_is_in_a_pdf_takes_no_more_memory_than_it_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "C-1.pdf"
    path.write_bytes(bomb(10))
    assert path.stat().st_size < 20_000

    def read() -> None:
        with pytest.raises(VerificationError, match="not genuine"):
            verify(path, [], Ledger(tmp_path))

    assert peak_of(read) < 300 << 20


OLDER = "older.sqlite"
"""A copy of the ledger, made before its last certificate."""
SECRET = "secret"  # noqa: S105 - of keys that the tests make
DROP = "".join(
    f"DROP TRIGGER IF EXISTS {each};"
    for each in ("no_change", "no_removal", "no_change_of_heads", "no_removal_of_heads")
)


@dataclass(frozen=True)
class Signed:
    """A laboratory that signs, and the public key that it gives to its customers."""

    lab: Laboratory
    public: Path
    other: Path
    """Private key of somebody who uses the same name."""

    def check(self, *files: Path, trusted: bool = True, code: int = 0) -> str:
        """Verify; `trusted`: with the public key of the laboratory."""
        return self.lab.verify(*files, *(("--key", self.public) if trusted else ()), code=code)

    @property
    def certificate(self) -> Path:
        """The second certificate, a revision of the first."""
        return self.lab.certificate(1)


@pytest.fixture(scope="module")
def signing(tmp_path_factory: pytest.TempPathFactory) -> Signed:
    """Make a laboratory with two signed revisions."""
    folder = tmp_path_factory.mktemp("signing")
    private, other = (key(folder / name, SECRET.encode()) for name in ("lab.p12", "other.p12"))
    made = laboratory(folder / "lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HUDDLE_PASSPHRASE", SECRET)
        made.issue("--sign", str(private))
        shutil.copy(made.certificates / NAME, made.folder / OLDER)
        made.issue("--sign", str(private), "--reason", "again")
    return Signed(made, exported(private), other)


@pytest.fixture
def forged(signing: Signed, tmp_path: Path) -> Signed:
    """Return a copy that a test may forge."""
    lab = Laboratory(shutil.copytree(signing.lab.folder, tmp_path / "lab"))
    return Signed(lab, signing.public, signing.other)


def exported(private: Path) -> Path:
    """Write the X.509 certificate of a key, as openssl pkcs12 -nokeys does."""
    _, certificate, _ = pkcs12.load_key_and_certificates(private.read_bytes(), SECRET.encode())
    assert isinstance(certificate, x509.Certificate)
    public = private.with_suffix(".pem")
    public.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    return public


def rewrite(
    folder: Path, change: Callable[[list[dict[str, Any]]], list[dict[str, Any]]]
) -> list[str]:
    """Write a ledger again: its records changed, chain and count made to fit, heads dropped."""
    with closing(sqlite3.connect(folder / NAME)) as rows:
        records = [
            json.loads(r) for (r,) in rows.execute("SELECT record FROM entries ORDER BY row")
        ]
        rows.executescript(DROP)
        rows.executescript("DELETE FROM entries; DELETE FROM heads;")
        previous, hashes = "", []
        for row, record in enumerate(change(records), start=1):
            text = json.dumps(record | {"previous": previous}, ensure_ascii=False, sort_keys=True)
            previous = hashlib.sha256(text.encode()).hexdigest()
            hashes.append(previous)
            rows.execute("INSERT INTO entries VALUES (?, ?, ?)", (row, text, previous))
        rows.execute("UPDATE sqlite_sequence SET seq = ?", (len(hashes),))
        rows.commit()
    return hashes


def with_hash_of(path: Path) -> Callable[[list[dict[str, Any]]], list[dict[str, Any]]]:
    """Return what gives the row of a changed certificate its new SHA-256."""

    def change(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
        for record in records:
            if record.get("file") == path.name:
                record["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        return records

    return change


def stripped(path: Path) -> None:
    """Take the signature off: the file as it was before it was signed."""
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"%%EOF") + 6])


def edited(path: Path, change: Callable[[PdfWriter], None]) -> None:
    """Write a certificate again with a change."""
    writer = PdfWriter(clone_from=path)
    change(writer)
    content = io.BytesIO()
    writer.write(content)
    path.write_bytes(content.getvalue())


def another_authoriser(made: Signed) -> None:
    def change(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [r | ({"by": "Mallory"} if r["kind"] == "allotted" else {}) for r in records]

    rewrite(made.lab.certificates, change)


def rows_under_the_heads(made: Signed) -> None:
    """Do the same, and leave the signed heads where they are."""
    with closing(sqlite3.connect(made.lab.certificates / NAME)) as rows:
        heads = rows.execute("SELECT * FROM heads").fetchall()
    another_authoriser(made)
    with closing(sqlite3.connect(made.lab.certificates / NAME)) as rows:
        rows.executemany("INSERT INTO heads VALUES (?, ?, ?, ?)", heads)
        rows.commit()


def heads_without_a_key(made: Signed) -> None:
    with closing(sqlite3.connect(made.lab.certificates / NAME)) as rows:
        rows.executescript(DROP)
        rows.execute("UPDATE heads SET key = 'none'")
        rows.commit()


def unsigned(made: Signed) -> None:
    stripped(made.certificate)
    rewrite(made.lab.certificates, with_hash_of(made.certificate))


def of_the_same_name(made: Signed) -> None:
    stripped(made.certificate)
    signer = Signer(made.other, SECRET)
    made.certificate.write_bytes(signer(made.certificate.read_bytes()))
    rewrite(made.lab.certificates, with_hash_of(made.certificate))


def swapped(made: Signed) -> None:
    first, second = made.lab.certificate(0), made.certificate
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


def another_text(made: Signed) -> None:
    def change(writer: PdfWriter) -> None:
        page = writer.pages[0]
        stream = ContentStream(None, writer)
        old = page.get_contents()
        assert old is not None
        stream.set_data(old.get_data() + b"\n1 1 1 rg 0 700 600 60 re f\n")
        page[NameObject("/Contents")] = writer._add_object(stream)  # noqa: SLF001 - pypdf has no other

    edited(made.certificate, change)
    rewrite(made.lab.certificates, with_hash_of(made.certificate))


def another_revision(made: Signed) -> None:
    """Give the first revision out as the second, in the ledger, too."""
    first, second = made.lab.certificate(0), made.certificate
    shutil.copy(first, second)
    rewrite(made.lab.certificates, with_hash_of(second))


def truncated(made: Signed) -> None:
    rewrite(made.lab.certificates, lambda records: records[:2])


def rolled_back(made: Signed) -> None:
    """Put the ledger back to what it was after the first certificate, its signed head included."""
    shutil.copy(made.lab.folder / OLDER, made.lab.certificates / NAME)


def checksums_rewritten(made: Signed) -> None:
    rescale(made.lab.recording)


def flipped_bit(made: Signed) -> None:
    content = bytearray(made.certificate.read_bytes())
    at = content.index(b"/Title") + 9
    content[at] ^= 1
    made.certificate.write_bytes(content)


def another_attachment(made: Signed) -> None:
    def change(writer: PdfWriter) -> None:
        result = json.loads(PdfReader(made.certificate).attachments[JSON_NAME][0])
        result["certificate"]["by"] = "Mallory"
        for each in writer.attachment_list:
            if each.name == JSON_NAME:
                each.content = json.dumps(result).encode()

    edited(made.certificate, change)
    rewrite(made.lab.certificates, with_hash_of(made.certificate))


def appended(made: Signed) -> None:
    """Add something behind the signature: what it covers is genuine."""
    with made.certificate.open("ab") as file:
        file.write(b"\n% approved\n")
    rewrite(made.lab.certificates, with_hash_of(made.certificate))


FORGERIES: dict[Callable[[Signed], None], str] = {
    another_authoriser: "the ledger has another row for it than the one it names",
    rows_under_the_heads: "is not the one that was signed",
    heads_without_a_key: "is not the one that was signed",
    unsigned: "was removed",
    of_the_same_name: "in the ledger with",
    swapped: "under the name of",
    another_text: "is not intact",
    another_revision: "it is PIER",
    truncated: "is not in the ledger",
    rolled_back: "is not in the ledger",
    checksums_rewritten: "was changed since the certificate",
    flipped_bit: "its SHA-256 is not that of the ledger",
    another_attachment: "authorised by Mallory",
    appended: "not of the whole file",
}


def test_the_genuine_one_is(signing: Signed) -> None:
    for trusted in (False, True):
        said = signing.check(signing.certificate, signing.lab.recording, trusted=trusted)
        assert "the one certified, unchanged" in said
    content = signing.certificate.read_bytes()
    (found,) = signatures(content)
    assert found == PdfSignature("Common Name: Pier Metrology", found.key_id, is_intact=True)
    assert f"signed by Common Name: Pier Metrology with key {found.key_id}: intact" in said
    assert f"ledger signed with key {found.key_id}" in said
    assert not signatures(content.replace(b"/Title", b"/Tible", 1))[0].is_intact


def test_who_does_not_know_the_passphrase_issues_nothing(
    forged: Signed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HUDDLE_PASSPHRASE", "wrong")
    refused = forged.lab.refused("--reason", "signed", "--sign", str(forged.other))
    assert "passphrase is wrong" in refused
    assert len(Ledger(forged.lab.certificates).entries()) == 2  # it took no number


@pytest.mark.parametrize(
    ("forge", "words", "trusted"),
    [
        *((forge, words, False) for forge, words in FORGERIES.items()),
        *((forge, FORGERIES[forge], True) for forge in (unsigned, of_the_same_name, rolled_back)),
    ],
    ids=lambda each: each.__name__ if callable(each) else None,
)
def test_a_forgery_is_named(
    forged: Signed, forge: Callable[[Signed], None], words: str, *, trusted: bool
) -> None:
    """With the key of the laboratory, and without, which is harder."""
    forge(forged)
    said = forged.check(forged.certificate, forged.lab.recording, trusted=trusted, code=3)
    assert words in said
    assert "signed by" not in said


@pytest.mark.parametrize(
    ("forge", "words"),
    [
        (another_authoriser, "is not signed with key"),
        (rows_under_the_heads, "not the one that was"),
    ],
)
def test_recordings_are_not_certified_by_a_ledger_without_its_signature(
    forged: Signed, forge: Callable[[Signed], None], words: str
) -> None:
    forged.lab.verify(forged.lab.recording)
    forge(forged)
    assert words in forged.lab.verify(forged.lab.recording, code=3)


@pytest.mark.parametrize("forge", [truncated, rolled_back])
def test_a_ledger_without_its_last_rows_hides_no_certificate_of_its_folder(
    forged: Signed, forge: Callable[[Signed], None]
) -> None:
    """Neither beside an earlier certificate nor of the recording; nor does `issue` go on."""
    first, lacking = forged.lab.certificate(0), forged.certificate.stem
    forge(forged)
    for each in (first, forged.lab.recording):
        assert f"the ledger lacks {lacking} of the folder" in forged.lab.verify(each, code=3)
    assert "the ledger" in forged.lab.refused("--despite", "x", "--reason", "y")


def test_what_an_older_copy_of_a_ledger_proves_is_what_it_proved_then(forged: Signed) -> None:
    """Without any later certificate, only a truncated ledger lacks its signature."""
    forged.certificate.unlink()
    rolled_back(forged)
    forged.check(forged.lab.certificate(0), forged.lab.recording)
    truncated(forged)
    assert "the ledger is not signed with key" in forged.check(forged.lab.certificate(0), code=3)


def test_another_laboratory_of_the_same_name_does_not_have_the_key(
    forged: Signed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it anew, with a key whose certificate has the same name: only --key shows it."""
    monkeypatch.setenv("HUDDLE_PASSPHRASE", SECRET)
    shutil.rmtree(forged.lab.certificates)
    forged.lab.issue("--sign", str(forged.other))
    path = forged.lab.certificate(0)
    assert "whose key this is, --key or a reader shows" in forged.check(path, trusted=False)
    said = forged.check(path, code=3)
    assert "not genuine" in said
    assert "expected" in said
    missing = tmp_path / "nonexistent"
    said = forged.lab.verify(path, "--key", missing, code=2)
    assert str(missing) in "".join(said.split())
    assert "no public key" in forged.lab.verify(path, "--key", forged.lab.bench, code=2)


def test_who_has_the_key_and_no_ledger_verifies_the_signature(
    signing: Signed, tmp_path: Path
) -> None:
    path = Path(shutil.copy(signing.certificate, tmp_path / "received.pdf"))
    assert "there is no ledger" in signing.check(path, trusted=False, code=3)
    said = signing.check(path, signing.lab.recording)
    assert "no ledger here: a later revision would not be known" in said
    assert "the one certified" in said
    folder = signing.lab.certificates
    assert "ledger signed with key" in signing.lab.verify(path, "--certificates", folder)
    recording = Path(shutil.copy(signing.lab.recording, tmp_path / "night.h5"))
    rescale(recording)
    assert "was changed since the certificate" in signing.check(path, recording, code=3)
    stripped(path)
    assert "was removed" in signing.check(path, code=3)


def test_a_damaged_certificate_is_refused_whatever_the_damage(signing: Signed) -> None:
    """By what is inside, or by its signature; no other error escapes the libraries."""
    content, rng = signing.certificate.read_bytes(), np.random.default_rng(11)
    (entry,) = (e for e in Ledger(signing.lab.certificates).entries() if e.revision == 1)
    marks = [b"/Length", b" obj", b"/EF", b"/Names", b"/Filter", b"/ByteRange", b"xref"]
    for number in range(24):
        damaged = bytearray(content)
        at = content.index(marks[number % len(marks)], int(rng.integers(len(content) // 2)))
        if number % 3:
            damaged[at + int(rng.integers(12))] = int(rng.integers(1, 255))
        else:
            del damaged[at:]
        if damaged == content:
            continue
        try:
            Claims.of(signing.certificate, bytes(damaged))
        except VerificationError:
            continue
        _, wrong = _signatures(bytes(damaged), entry, "")
        assert wrong
