"""Issued certificates: the checklist of ISO/IEC 17025, revisions, and what verification finds."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import pkcs12
from cryptography.x509.oid import NameOID
from lxml import etree
from pypdf import PdfReader
from typer.testing import CliRunner

from daq.recording.chunks.manifest import write_manifest
from daq.recording.description import write_checksums
from daq.recording.repair import write_results
from tests.tui.night_recording import BENCH, HOSTILE, SENSOR, record
from tests.tui.report.written_report import ROOT
from tui.certificate.dcc import NAME
from tui.certificate.issuing import JSON_NAME
from tui.certificate.ledger import Ledger
from tui.certificate.signing import signatures
from tui.commands.main import app

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

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
NAMESPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}

CHECKLIST: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "7.8.2.1 a": (("Calibration certificate: self-noise",), ("//dcc:measurementResult/dcc:name",)),
    "7.8.2.1 b": (
        ("Pier Metrology, 1 Quiet Lane, 12345 Cellarton",),
        ("//dcc:calibrationLaboratory[contains(., 'Pier Metrology')]",),
    ),
    "7.8.2.1 c": (("Place of the test", "cellar"), ("//dcc:performanceLocation",)),
    "7.8.2.1 d": (
        ("PIER-2016-0001", "page 1 of"),
        ("//dcc:uniqueIdentifier[contains(., 'PIER-')]",),
    ),
    "7.8.2.1 e": (
        ("Slow Waves & Sons, 2 Loud Road, buyer@waves.example",),
        ("//dcc:customer/dcc:eMail[.='buyer@waves.example']",),
    ),
    "7.8.2.1 f": (
        ("QP-17, issue 3", "Sleeman"),
        ("//dcc:usedMethod/dcc:reference[.='QP-17, issue 3']",),
    ),
    "7.8.2.1 g": (
        ("Acme Sensors", "M-1", "SN-2", "unopened, no damage"),
        ("//dcc:item[.//dcc:value='SN-2' and contains(., 'Acme Sensors')]",),
    ),
    "7.8.2.1 h": (("2016-07-01",), ("//dcc:receiptDate[.='2016-07-01']",)),
    "7.8.2.1 i": (
        ("2016-07-14 01:00:00 UTC to",),
        ("//dcc:beginPerformanceDate[.='2016-07-14']", "//dcc:endPerformanceDate"),
    ),
    "7.8.2.1 j": (("Date of issue",), ()),
    "7.8.2.1 l": (
        ("relate only to the items listed",),
        ("//dcc:statement[contains(., 'relate only to the items')]",),
    ),
    "7.8.2.1 m": (
        ("Self-noise", "dB re 1 (m/s²)²/Hz"),
        ("//si:unitXMLList[contains(., 'metre')]",),
    ),
    "7.8.2.1 n": (("shortened to one minute",), ()),
    "7.8.2.1 o": (
        ("Authorised by", "Grace Hopper"),
        ("//dcc:respPerson[dcc:mainSigner='true' and contains(., 'Grace Hopper')]",),
    ),
    "7.8.2.2": (("Given by the customer or user, and not verified",), ()),
    "7.8.4.1 a": (
        ("Uncertainty budget (JCGM 100 and 101)", "finite averages", "sensitivity"),
        ("//si:coverageIntervalXMLList/si:intervalMinXMLList",),
    ),
    "7.8.4.1 b": (
        (
            "Place of the test",
            "Atemperature°C24.0026.502",
            "Sensor A was outside of its data sheet's range: 24.0 to 26.5 °C; -40 to 26",
            "Asupply voltageV12.2512.251",
            "computertemperature°C44.0046.502",
        ),
        (
            "//dcc:quantity[contains(., 'Highest temperature of A')]//si:value[.='26.5']",
            "//dcc:influenceCondition//dcc:text[contains(., 'Sensor A was outside')]",
        ),
    ),
    "7.8.4.1 c": (
        ("certificate 123 of the Example Institute",),
        ("//dcc:statement[contains(., 'certificate 123')]",),
    ),
    "7.8.6": (
        ("ILAC-G8:09/2019", "conditional"),
        ("//dcc:norm[.='ILAC-G8:09/2019']", "//dcc:conformity[.='pass']"),
    ),
}
"""By clause: texts of the PDF, and paths in the DCC."""


@dataclass(frozen=True)
class Laboratory:
    """A folder with a recording, and the bench file that describes the parties."""

    folder: Path
    recording: Path
    bench: Path

    def issue(self, *more: str, by: str = "Grace Hopper") -> str:
        """Issue a certificate; a channel is dead, so that the limits are not decided."""
        arguments = ["issue", str(self.recording), "--by", by, "--bench", str(self.bench), *more]
        found = CliRunner().invoke(app, arguments)
        assert found.exit_code == 4, found.output
        return found.output

    def verify(self, *files: Path | str) -> tuple[int, str]:
        """Verify files; return exit code and all that was said."""
        found = CliRunner().invoke(app, ["verify", *map(str, files)])
        return found.exit_code, " ".join((found.output + found.stderr).split())

    @property
    def certificates(self) -> Path:
        """Their folder."""
        return self.folder / "certificates"

    def certificate(self, revision: int = 0) -> Path:
        """Return the file of a revision of the only certificate."""
        (path,) = self.certificates.glob(f"PIER-*-0001-r{revision}.pdf")
        return path


@pytest.fixture(scope="module", autouse=True)
def _empty_figures() -> Iterator[None]:
    """Leave figures empty: curves take most of a certificate's time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tui.report.figures.drawing.draw", lambda *_, **__: None)
        yield


@pytest.fixture(scope="module")
def issued(tmp_path_factory: pytest.TempPathFactory) -> Laboratory:
    """Make a laboratory with one certificate; tests that change it take a copy."""
    folder = tmp_path_factory.mktemp("laboratory")
    made = laboratory(folder)
    made.issue()
    return made


def laboratory(folder: Path) -> Laboratory:
    folder.mkdir(exist_ok=True)
    recording = record(folder / "night.h5")
    sensors = "".join(
        SENSOR.format(name=name, number=number).replace(
            "serial_number", 'manufacturer = "Acme Sensors"\nserial_number'
        )
        + "data_sheet = {temperature = [-40, 26]}\n"
        for number, name in enumerate(("A", "B", "C", HOSTILE))
    )
    sensors = sensors.replace("sensitivity = 1e6", f"sensitivity = 1e6, {CALIBRATED}")
    bench = folder / "bench.toml"
    bench.write_text(BENCH.format(sensors=sensors, psd=2e-9) + ABOUT, encoding="utf-8")
    return Laboratory(folder, recording, bench)


@pytest.fixture
def copied(issued: Laboratory, tmp_path: Path) -> Laboratory:
    folder = tmp_path / "laboratory"
    shutil.copytree(issued.folder, folder)
    return Laboratory(folder, folder / "night.h5", folder / "bench.toml")


def text_of(path: Path) -> str:
    """Return the text of a PDF without white space, where lines may break."""
    return "".join("".join(page.extract_text() for page in PdfReader(path).pages).split())


def test_the_certificate_has_all_of_the_checklist(issued: Laboratory) -> None:
    """Each line of docs/certificate.md, in the text of the PDF and in the DCC."""
    path = issued.certificate()
    text, reader = text_of(path), PdfReader(path)
    year = re.search(r"PIER-(\d{4})-", path.name)
    assert year is not None
    tree = etree.parse(io.BytesIO(reader.attachments[NAME][0]))
    for clause, (words, paths) in CHECKLIST.items():
        for word in words:
            expected = word.replace("2016-0001", f"{year[1]}-0001")
            assert "".join(expected.split()) in text, clause
        for each in paths:
            assert tree.xpath(each, namespaces=NAMESPACES), (clause, each)
    document = (ROOT / "docs" / "certificate.md").read_text(encoding="utf-8")
    assert {line[2:].split(" |")[0] for line in document.splitlines() if line[:4] == "| 7."} >= (
        set(CHECKLIST)
    )


def test_the_dcc_is_valid_by_the_schema_of_the_ptb(issued: Laboratory, tmp_path: Path) -> None:
    """Of a certificate, and of a draft of a recording without a bench file's tables."""
    root = Path(os.environ.get("HUDDLE_DATA", ROOT.parent / "shared" / "data"))
    file = root / "dcc" / "dcc.xsd"
    if not file.is_file():
        pytest.skip(f"no schema at {file} (set HUDDLE_DATA to the folder of data)")
    schema = etree.XMLSchema(etree.parse(file))
    content = PdfReader(issued.certificate()).attachments[NAME][0]
    schema.assertValid(etree.parse(io.BytesIO(content)))
    draft = tmp_path / "draft.xml"
    found = CliRunner().invoke(app, ["report", str(issued.recording), "--out", str(draft)])
    assert found.exit_code == 4, found.output
    tree = etree.parse(draft)
    schema.assertValid(tree)
    assert tree.xpath("//dcc:statement[contains(., 'DRAFT')]", namespaces=NAMESPACES)


def test_every_page_has_number_revision_and_count(issued: Laboratory) -> None:
    pages = PdfReader(issued.certificate()).pages
    for number, page in enumerate(pages, start=1):
        text = " ".join(page.extract_text().split())
        assert re.search(r"PIER-\d{4}-0001, revision 0", text)
        assert f"page {number} of {len(pages)}" in text
        assert "DRAFT" not in text


def test_the_files_inside_have_the_numbers_of_the_page(issued: Laboratory) -> None:
    reader = PdfReader(issued.certificate())
    result = json.loads(reader.attachments[JSON_NAME][0])
    tree = etree.parse(io.BytesIO(reader.attachments[NAME][0]))
    assert result["certificate"]["revision"] == 0
    statements = [each["statement"] for each in result["certificate"]["conformity"]]
    assert statements.count("pass") == 7
    assert statements.count("not-stated") == 1  # the dead channel
    (entry,) = Ledger(issued.certificates).entries()
    assert result["certificate"]["entry"] == entry.hash
    own = next(each for each in result["band_means"] if each["channel"] == "X")
    (value,) = tree.xpath(
        "//dcc:result[dcc:name/dcc:content='Self-noise of A.X']//si:real[si:unit!='\\one']"
        "/si:value/text()",
        namespaces=NAMESPACES,
    )
    numbers = [number for number in own.values() if isinstance(number, float)]
    assert any(abs(float(value) / number - 1) < 1e-6 for number in numbers if number)
    metadata = reader.xmp_metadata
    assert metadata is not None
    assert b"pdfaid:part>3<" in metadata.stream.get_data()


def test_a_revision_says_what_it_replaces_and_what_changed(copied: Laboratory) -> None:
    again = ["issue", str(copied.recording), "--by", "Ada", "--bench", str(copied.bench)]
    refused = CliRunner().invoke(app, again)
    assert refused.exit_code == 2
    assert "--reason" in refused.stderr
    before = copied.certificate().read_bytes()
    copied.issue("--segment", "2s", "--reason", "finer bins")
    assert copied.certificate().read_bytes() == before
    text = text_of(copied.certificate(1))
    for word in ("revision 1", "Replaces revision 0", "finer bins", "segment 1 s → 2 s"):
        assert "".join(word.split()) in text
    listed = CliRunner().invoke(app, ["issues", str(copied.recording), "--json", "-"])
    states = [each["state"] for each in json.loads(listed.stdout)["certificates"]]
    assert states == ["replaced", "issued"]
    code, said = copied.verify(copied.certificate(), copied.recording)
    assert code == 0
    assert "replaced by revision 1" in said


def test_what_is_not_given_is_refused_unless_allowed(tmp_path: Path) -> None:
    recording = record(tmp_path / "night.h5")
    run = CliRunner()
    refused = run.invoke(app, ["issue", str(recording), "--by", "Ada"])
    assert refused.exit_code == 2
    for key in ("[laboratory] name", "[customer] name", "[certificate] procedure"):
        assert key in " ".join(refused.stderr.split())
    assert not (tmp_path / "certificates").exists()
    allowed = run.invoke(app, ["issue", str(recording), "--by", "Ada", "--allow-incomplete"])
    assert allowed.exit_code == 4, allowed.output
    (path,) = (tmp_path / "certificates").glob("HT-*.pdf")
    assert "Issuedincomplete.Notgiven:nameandaddressofthelaboratory" in text_of(path)


def test_no_certificate_is_issued_of_simulated_sensors(tmp_path: Path) -> None:
    recording, run = tmp_path / "s.h5", CliRunner()
    run.invoke(app, ["simulate", "fig4", "--duration", "20s", "--out", str(recording)])
    found = run.invoke(app, ["issue", str(recording), "--by", "Ada", "--allow-incomplete"])
    assert found.exit_code == 2
    assert "simulated" in found.stderr
    assert not (tmp_path / "certificates").exists()


def test_recordings_are_compared_with_their_certificates(copied: Laboratory) -> None:
    """Results may be stored later; nothing else may change, whatever checksums are rewritten."""
    certificate, recording = copied.certificate(), copied.recording
    code, said = copied.verify(recording)
    assert code == 0
    assert said.endswith(f"certified by {Ledger(copied.certificates).entries()[0].name}")
    write_results(recording, {"three-sensor": ({"frequency": np.arange(3.0)}, {"unit": "m/s²"})})
    code, said = copied.verify(copied.folder)
    assert code == 0
    assert "certified by PIER-" in said
    code, said = copied.verify(certificate, recording)
    assert code == 0
    assert "the one certified, its contents unchanged, its file not" in said
    with h5py.File(recording, "r+") as file:
        file["sensors/A/samples"].attrs["sensitivity"] = [2e6, 2e6]
        write_checksums(file)
        write_manifest(file)
    code, said = copied.verify(recording)
    assert code == 3
    assert "changed since certificate PIER-" in said
    code, said = copied.verify(certificate, recording)
    assert code != 0
    assert "was changed since the certificate" in said
    recording.unlink()
    record(recording)  # another run, of the same name
    code, said = copied.verify(recording)
    assert code == 3
    assert "exchanged: certificate PIER-" in said


def test_the_ledger_of_a_recording_is_found_wherever_it_is(tmp_path: Path) -> None:
    """In the folder that its bench names, behind a link; that of another bench is named."""
    made = laboratory(tmp_path / "lab")
    made.recording.unlink()
    record(made.recording, more='[certificate]\nfolder = "papers"\n')
    made.issue("--folder", str(made.folder / "papers"))
    link = tmp_path / "link.h5"
    link.symlink_to(made.recording)
    for path in (made.recording, link):
        code, said = made.verify(path)
        assert code == 0
        assert "certified by PIER-" in said, path
    elsewhere = tmp_path / "elsewhere"
    said = made.issue("--folder", str(elsewhere), "--reason", "another place")
    assert f"huddle verify --certificates {elsewhere}" in " ".join(said.split())
    code, said = made.verify(made.recording, "--certificates", elsewhere)
    assert code == 0
    assert said.count("PIER-") == 2


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


def test_a_signed_certificate_is_verified(
    copied: Laboratory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signing = key(tmp_path / "key.p12", b"secret")
    arguments = ("--sign", str(signing), "--reason", "signed")
    monkeypatch.setenv("HUDDLE_PASSPHRASE", "wrong")
    whole = ["issue", str(copied.recording), "--by", "Ada", "--bench", str(copied.bench)]
    refused = CliRunner().invoke(app, [*whole, *arguments])
    assert refused.exit_code == 2
    assert "passphrase is wrong" in refused.stderr
    monkeypatch.setenv("HUDDLE_PASSPHRASE", "secret")
    copied.issue(*arguments)
    path = copied.certificate(1)
    code, said = copied.verify(path)
    assert code == 0, said
    assert "signed by Common Name: Pier Metrology: intact" in said
    assert signatures(path.read_bytes()) == [("Common Name: Pier Metrology", True)]
    changed = path.read_bytes().replace(b"/Title", b"/Tible", 1)
    assert signatures(changed) == [("Common Name: Pier Metrology", False)]
    assert "not signed" in copied.verify(copied.certificate())[1]
    assert len(Ledger(copied.certificates).entries()) == 2  # the refused one took no number


def changed_certificate(made: Laboratory) -> list[Path]:
    path = made.certificate()
    content = path.read_bytes()
    path.write_bytes(content.replace(b"/Title", b"/Tible", 1))
    return [path]


def other_recording(made: Laboratory) -> list[Path]:
    return [made.certificate(), record(made.folder / "other.h5", psd=1e-9)]


def changed_recording(made: Laboratory) -> list[Path]:
    with h5py.File(made.recording, "r+") as file:
        file["sensors/A/samples"][17] += 1
    return [made.certificate(), made.recording]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (changed_certificate, "changed: its SHA-256 is not that of certificate"),
        (other_recording, "is another recording than the one certified"),
        (changed_recording, "was changed since the certificate"),
    ],
)
def test_what_is_wrong_is_found(
    copied: Laboratory, change: Callable[[Laboratory], list[Path]], said: str
) -> None:
    assert copied.verify(copied.certificate(), copied.recording)[0] == 0
    code, text = copied.verify(*change(copied))
    assert code == 3
    assert said in text
