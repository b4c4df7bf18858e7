"""A laboratory with a recording, the bench file of its certificates, and keys."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import pkcs12
from cryptography.x509.oid import NameOID
from pypdf import PdfReader

from daq.recording.chunks.manifest import write_manifest
from daq.recording.description import write_checksums
from tests.command import huddle, words_of
from tests.tui.night_recording import BENCH, HOSTILE, SENSOR, record

ABOUT = """
[laboratory]
name = "Pier Metrology"
address = "1 Quiet Lane, 12345 Cellarton"
country = "DE"
email = "lab@pier.example"
accreditation = "Accredited by the Example Body, D-K-99999"
[customer]
name = "Slow Waves & Sons"
address = "2 Loud Road"
email = "buyer@waves.example"
order = "PO-4711"
[certificate]
prefix = "PIER"
procedure = "QP-17, issue 3"
received = 2016-07-01
condition = "unopened, no damage"
traceability = "sensitivities by certificate 123 of the Example Institute"
deviations = "shortened to one minute"
responsible = "Grace Hopper"
decision_rule = "guard-band"
"""
CALIBRATED = 'certificate = {value = 1e6, expanded_uncertainty = 2e4, k = 2, number = "C-9"}'
"""Of every channel, in the bench file of the laboratory."""
DESPITE = "the dead channel is not used"


@dataclass(frozen=True)
class Laboratory:
    """A folder with a recording, and the bench file that describes the parties."""

    folder: Path

    def issue(self, *more: str, by: str = "Grace Hopper") -> str:
        """Issue a certificate; a channel is dead: not decided, and invalid without a reason."""
        arguments = ["issue", str(self.recording), "--by", by, "--bench", str(self.bench)]
        arguments += ["--despite", DESPITE, *more]
        return huddle(*arguments, code=4).output

    @property
    def recording(self) -> Path:
        """Of one night."""
        return self.folder / "night.h5"

    @property
    def bench(self) -> Path:
        """Its bench file."""
        return self.folder / "bench.toml"

    def refused(self, *more: str) -> str:
        """Ask for a certificate that is not issued; return what is said."""
        ordered = ["issue", self.recording, "--by", "Ada", "--bench", self.bench]
        return words_of(*ordered, *more, code=2)

    def verify(self, *files: Path | str, code: int = 0) -> str:
        """Verify files; return all that is said."""
        return words_of("verify", *files, code=code)

    @property
    def certificates(self) -> Path:
        """Their folder."""
        return self.folder / "certificates"

    def certificate(self, revision: int = 0) -> Path:
        """Return the file of a revision of the only certificate."""
        (path,) = self.certificates.glob(f"PIER-*-0001-r{revision}.pdf")
        return path


def laboratory(folder: Path) -> Laboratory:
    folder.mkdir(exist_ok=True)
    made = Laboratory(folder)
    record(made.recording)
    sensors = "".join(
        SENSOR.format(name=name, number=number).replace(
            "serial_number", 'manufacturer = "Acme Sensors"\nserial_number'
        )
        + "data_sheet = {temperature = [-40, 26]}\n"
        for number, name in enumerate(("A", "B", "C", HOSTILE))
    )
    sensors = sensors.replace("sensitivity = 1e6", f"sensitivity = 1e6, {CALIBRATED}")
    made.bench.write_text(BENCH.format(sensors=sensors, psd=2e-9) + ABOUT, encoding="utf-8")
    return made


def rescale(recording: Path) -> None:
    """Change a sensitivity, and the checksums with it."""
    with h5py.File(recording, "r+") as file:
        file["sensors/A/samples"].attrs["sensitivity"] = [1.5e6, 1.5e6]
        write_checksums(file)
        write_manifest(file)


def text_of(path: Path) -> str:
    """Return the text of a PDF without white space, where lines may break."""
    return "".join("".join(page.extract_text() for page in PdfReader(path).pages).split())


def key(file: Path, passphrase: bytes) -> Path:
    """Write a key with a certificate of its own."""
    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Pier Metrology")])
    now = datetime(2026, 1, 1, tzinfo=UTC)
    usage = dict.fromkeys(
        ("key_encipherment", "data_encipherment", "key_agreement", "key_cert_sign", "crl_sign"),
        False,
    )
    certificate = (
        x509.CertificateBuilder(name, name, private.public_key(), 1, now, now + timedelta(36500))
        .add_extension(
            x509.KeyUsage(
                digital_signature=True, content_commitment=True, encipher_only=False,
                decipher_only=False, **usage,
            ),
            critical=True,
        )
        .sign(private, hashes.SHA256())
    )  # fmt: skip
    locked = serialization.BestAvailableEncryption(passphrase)
    file.write_bytes(
        pkcs12.serialize_key_and_certificates(b"p", private, certificate, None, locked)
    )
    return file
