"""Issued certificates: the checklist of ISO/IEC 17025, revisions, and what verification finds."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import sqlite3
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
import pytest
from lxml import etree
from pypdf import PdfReader

from daq.recording.repair import write_results
from daq.recording.signing import identity, make_key, sign
from tests.command import huddle, printed, words_of
from tests.tui.certificate.laboratory import CALIBRATED, Laboratory, laboratory, rescale, text_of
from tests.tui.night_recording import record
from tests.tui.report.written_report import ROOT, assert_as_kept, lines_of
from tui.certificate.dcc import NAME
from tui.certificate.ledger import Ledger
from tui.certificate.verification import JSON_NAME
from tui.page.blocks import Report
from tui.service.records.store import NAME as RUNS

pytestmark = pytest.mark.usefixtures("short_pages")
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
    huddle("report", issued.recording, "--out", draft, code=4)
    tree = etree.parse(draft)
    schema.assertValid(tree)
    assert tree.xpath("//dcc:statement[contains(., 'DRAFT')]", namespaces=NAMESPACES)


@pytest.mark.parametrize("form", ["pages", "dcc"])
def test_every_cell_of_a_certificate_is_as_kept(
    issued: Laboratory, drawn_up: list[Report], form: str
) -> None:
    xml = PdfReader(issued.certificate()).attachments[NAME][0]
    (report,) = drawn_up
    head = [report.title, report.subtitle, report.verdict.text, *(e.text for e in report.notices)]
    pages = [*head, *lines_of(report.sections)]
    text = "\n".join(pages if form == "pages" else cells_of(etree.fromstring(xml)))
    for changing, word in CHANGING:
        text = re.sub(changing, word, text)
    assert_as_kept([text], Path(__file__).parent / f"{form}.txt")


CHANGING = (
    (r"\b[0-9a-f]{64}\b", "SHA-256"),
    (r"\b[0-9a-f]{32}\b", "RUN"),
    (r"PIER-\d{4}", "PIER-YEAR"),
    (r"(issued |issue: |issue \| )\d{4}-\d\d-\d\d", r"\1TODAY"),
    (r"\d\.\d MB", "SIZE"),
    (re.escape(version("huddle-bench")), "VERSION"),
)
"""What differs between two certificates of one recording."""


def cells_of(root: etree._Element) -> Iterator[str]:
    """Yield the text of each element behind its name."""
    for element in root.iter("{*}*"):
        if element.text and element.text.strip():
            yield f"{etree.QName(element).localname}: {element.text}"


def test_every_page_has_number_revision_and_count(issued: Laboratory) -> None:
    pages = PdfReader(issued.certificate()).pages
    for number, page in enumerate(pages, start=1):
        text = " ".join(page.extract_text().split())
        assert re.search(r"PIER-\d{4}-0001, revision 0", text)
        assert f"page {number} of {len(pages)}" in text
        assert "DRAFT" not in text


def test_the_result_inside_has_the_statements_and_the_row_of_the_ledger(issued: Laboratory) -> None:
    reader = PdfReader(issued.certificate())
    result = json.loads(reader.attachments[JSON_NAME][0])
    assert result["certificate"]["revision"] == 0
    statements = [each["statement"] for each in result["certificate"]["conformity"]]
    assert statements.count("pass") == 7
    assert statements.count("not-stated") == 1  # the dead channel
    (entry,) = Ledger(issued.certificates).entries()
    assert result["certificate"]["entry"] == entry.hash
    metadata = reader.xmp_metadata
    assert metadata is not None
    assert b"pdfaid:part>3<" in metadata.stream.get_data()


def test_a_revision_says_what_it_replaces_and_what_changed(copied: Laboratory) -> None:
    assert "--reason" in copied.refused("--despite", "a test")
    before = copied.certificate().read_bytes()
    copied.issue("--segment", "2s", "--reason", "finer bins")
    assert copied.certificate().read_bytes() == before
    text = text_of(copied.certificate(1))
    for word in ("revision 1", "Replaces revision 0", "finer bins", "segment 1 s → 2 s"):
        assert "".join(word.split()) in text
    tree = etree.fromstring(PdfReader(copied.certificate(1)).attachments[NAME][0])
    (of_dcc,) = tree.xpath("//dcc:previousReport", namespaces=NAMESPACES)
    sha256 = hashlib.sha256(before).hexdigest()
    number = copied.certificate().stem.removesuffix("-r0")
    assert of_dcc.xpath("string()").split() == (
        f"finer bins {number}, revision 0 SHA-256 {sha256}".split()
    )
    listed = json.loads(printed("issues", copied.recording, "--json", "-"))
    states = [each["state"] for each in listed["certificates"]]
    assert states == ["replaced", "issued"]
    assert "replaced by revision 1" in copied.verify(copied.certificate(), copied.recording)
    nowhere = words_of("issues", copied.folder / "nowhere", code=3)
    assert "there is no ledger; huddle issue makes one" in nowhere


def test_what_is_not_given_is_refused_unless_allowed(tmp_path: Path) -> None:
    recording = record(tmp_path / "night.h5", stated=", tolerance = 0.02")
    command = ["issue", str(recording), "--by", "Ada", "--despite", "a test"]
    refused = words_of(*command, code=2)
    for asked in ("[laboratory] name", "[customer] name", "[certificate] procedure"):
        assert asked in refused
    assert not (tmp_path / "certificates").exists()
    huddle(*command, "--allow-incomplete", code=4)
    (path,) = (tmp_path / "certificates").glob("HT-*.pdf")
    assert "Issuedincomplete.Notgiven:nameandaddressofthelaboratory" in text_of(path)


def simulated(folder: Path) -> Path:
    recording = folder / "s.h5"
    huddle("simulate", "fig4", "--duration", "20s", "--out", recording)
    return recording


def test_of_simulated_sensors_there_are_specimens_alone(tmp_path: Path) -> None:
    recording = simulated(tmp_path)
    arguments = ["issue", str(recording), "--by", "Ada", "--allow-incomplete", "--despite", "x"]
    assert "simulated" in words_of(*arguments, code=2)
    assert not (tmp_path / "certificates").exists()
    place = tmp_path / "an absent folder"
    huddle("issue", recording, "--specimen", "--folder", place)
    assert not (tmp_path / "certificates").exists()
    path = place / "s-specimen.pdf"
    pages = ["".join(page.extract_text().split()) for page in PdfReader(path).pages]
    for page in pages:
        assert page.count("SPECIMEN") >= 2  # across the page, and at its foot
    assert "SPECIMEN:notacertificate.Ithasnonumber" in pages[0]
    assert "SIMULATEDSENSORS" in pages[0]
    assert "Acertificatewouldberefused:" in pages[0]
    assert "uncertaintyofthesensitivitynotstated" in pages[0]
    tree = etree.fromstring(PdfReader(path).attachments[NAME][0])
    for word in ("SPECIMEN", "SIMULATED SENSORS"):
        assert tree.xpath(f"//dcc:statement[contains(., '{word}')]", namespaces=NAMESPACES)
    assert "Dateofissuenotissued" in "".join(pages)
    assert "Entryoftheledger" not in "".join(pages)
    assert "a specimen, no certificate" in words_of("verify", path, code=3)


def test_a_result_that_a_fact_invalidates_needs_a_reason(
    issued: Laboratory, tmp_path: Path
) -> None:
    refused = issued.refused("--folder", str(tmp_path / "papers"), "--allow-incomplete")
    assert "the result is invalid" in refused
    assert "no signal; check cable and power" in refused
    assert "--despite REASON" in refused
    assert not (tmp_path / "papers").exists()
    first = "".join(PdfReader(issued.certificate()).pages[0].extract_text().split())
    assert "Issueddespitefactsthatinvalidatetheresult.Reason:thedeadchannelisnotused." in first


def flipped(recording: Path) -> None:
    with h5py.File(recording, "r") as file:
        at = file["sensors/A/samples"].id.get_chunk_info(0).byte_offset
    content = bytearray(recording.read_bytes())
    content[at + 100] ^= 1
    recording.write_bytes(content)


def rescaled(recording: Path) -> None:
    """Change a sensitivity, and the checksums with it; the database of the service knows more."""
    run_id, root = identity(recording)
    with closing(sqlite3.connect(recording.parent / RUNS)) as rows:
        rows.executescript("CREATE TABLE identities (part TEXT, run_id TEXT, root_sha256 TEXT);")
        rows.execute("INSERT INTO identities VALUES (?, ?, ?)", (recording.name, run_id, root))
        rows.commit()
    rescale(recording)


def of_another_signature(recording: Path) -> None:
    private = recording.parent.parent / "lab.key"
    make_key(private)
    sign(recording, private)
    content = json.loads(recording.with_suffix(".sig").read_text("ascii"))
    content["root_sha256"] = "0" * 64
    recording.with_suffix(".sig").write_text(json.dumps(content), "ascii")


@pytest.mark.parametrize(
    ("spoil", "wrong"),
    [
        (flipped, "damaged"),
        (rescaled, "exchanged: not the recording that the service has made"),
        (of_another_signature, "the signature is of another recording"),
    ],
)
def test_no_certificate_is_issued_of_what_verify_refuses(
    tmp_path: Path, spoil: Callable[[Path], None], wrong: str
) -> None:
    made = laboratory(tmp_path / "lab")
    spoil(made.recording)
    assert wrong in made.verify(made.recording, code=3)
    assert wrong in made.refused("--despite", "whatever")
    assert not made.certificates.exists()


def test_only_closed_recordings_are_certified(tmp_path: Path) -> None:
    recording, killed = tmp_path / "night.h5", tmp_path / "killed.h5"
    order = ("--by", "Ada", "--despite", "x")

    def before_end() -> None:
        shutil.copyfile(recording, killed)
        growing = words_of("issue", recording, *order, code=2)
        assert f"{recording}: not closed; wait for its end" in growing

    record(recording, before_end=before_end)
    left = words_of("issue", killed, *order, code=2)
    assert f"{killed}: not closed; huddle repair closes it" in left
    assert not (tmp_path / "certificates").exists()


def test_no_revision_is_issued_of_a_recording_changed_since_its_certificate(
    copied: Laboratory,
) -> None:
    rescale(copied.recording)
    refused = copied.refused("--despite", "x", "--reason", "y")
    assert "changed since certificate PIER-" in refused


@pytest.mark.skipif(sys.platform == "win32", reason="no permissions there")
def test_only_the_owner_can_read_certificates_and_ledger(issued: Laboratory) -> None:
    files = {path.name: stat.S_IMODE(path.stat().st_mode) for path in issued.certificates.iterdir()}
    assert set(files) == {"ledger.sqlite", "ledger.lock", issued.certificate().name}
    assert set(files.values()) == {0o600}


def test_pages_json_and_dcc_have_one_uncertainty(issued: Laboratory) -> None:
    """U of the PSD by each form of one certificate: sensitivities of 1 % (k = 1) are in it."""
    reader = PdfReader(issued.certificate())
    result = json.loads(reader.attachments[JSON_NAME][0])
    tree = etree.parse(io.BytesIO(reader.attachments[NAME][0]))
    text = " ".join("".join(page.extract_text() for page in reader.pages).split())
    for own in result["band_means"][:7]:  # the last channel is dead
        name = f"{own['sensor']}.{own['channel']}"
        sources = {each["source"]: each for each in own["contributions"]}
        of_sensitivity = sources["sensitivity"]["above"] / own["noise_psd"]
        assert of_sensitivity == pytest.approx(np.exp(1.96 * 0.02) - 1, rel=1e-3)
        expanded = own["k"] * own["standard_uncertainty"]
        assert own["expanded_uncertainty"] == pytest.approx(expanded)
        ends = own["noise_psd_low"], own["noise_psd_high"]
        assert expanded == pytest.approx((ends[1] - ends[0]) / 2)
        assert expanded / own["noise_psd"] > 1.96 * 0.02
        path = f"//dcc:result[dcc:name/dcc:content='Self-noise of {name}']"
        (real,) = tree.xpath(f"{path}//si:real[si:unit!='\\one']", namespaces=NAMESPACES)

        def of_dcc(key: str, real: etree._Element = real) -> float:
            return float(real.findtext(f".//si:{key}", namespaces=NAMESPACES) or "nan")

        assert of_dcc("value") == pytest.approx(own["noise_psd"], rel=1e-6)
        assert of_dcc("standardUnc") == pytest.approx(own["standard_uncertainty"], rel=1e-6)
        assert of_dcc("intervalMin") == pytest.approx(ends[0], rel=1e-6)
        assert of_dcc("intervalMax") == pytest.approx(ends[1], rel=1e-6)
        statistical = own["scatter_low"], own["scatter_high"]
        for sections, of in ((1, ends), (1, statistical)):
            low, high = (f"{10 * np.log10(end):.2f}".replace("-", "−") for end in of)
            assert text.replace("-", "−").count(f"{low} … {high}") >= sections, name
        # in the table of the uncertainty: u, k and U beside the same ends
        u, k, whole = (
            f"{100 * own['standard_uncertainty'] / own['noise_psd']:.2f} %",
            f"{own['k']:.2f}",
            f"{100 * expanded / own['noise_psd']:.2f} %",
        )
        assert f"{u}{k}{whole}".replace(" ", "") in text.replace(" ", ""), name
    for each in result["certificate"]["conformity"]:
        assert f"k = {each['k']:.2f} of a normal distribution" in text
        limit = next(
            e for e in result["limits"]
            if (e["sensor"], e["channel"]) == (each["sensor"], each["channel"])
        )  # fmt: skip
        assert limit["k"] == each["k"]
        assert each["is_traceable"]


def test_without_traceability_there_is_no_statement(tmp_path: Path) -> None:
    made = laboratory(tmp_path / "lab")
    text = made.bench.read_text(encoding="utf-8")
    made.bench.write_text(text.replace(CALIBRATED, "tolerance = 0.02"), encoding="utf-8")
    made.issue()
    reader = PdfReader(made.certificate())
    result = json.loads(reader.attachments[JSON_NAME][0])
    statements = {each["statement"] for each in result["certificate"]["conformity"]}
    assert statements == {"not-stated"}
    assert all(each["risk"] is not None for each in result["certificate"]["conformity"][:7])
    assert "Nostatementofconformityofanychannel" in text_of(made.certificate())


def test_recordings_are_compared_with_their_certificates(copied: Laboratory) -> None:
    """Results may be stored later; nothing else may change, whatever checksums are rewritten."""
    certificate, recording = copied.certificate(), copied.recording
    said = copied.verify(certificate)
    assert "not signed: who can write the folder can write certificate and ledger" in said
    assert f"recording {recording}: the one certified, unchanged" in said  # it is beside
    said = copied.verify(recording)
    assert said.endswith(f"certified by {Ledger(copied.certificates).entries()[0].name}")
    write_results(recording, {"three-sensor": ({"frequency": np.arange(3.0)}, {"unit": "m/s²"})})
    assert "certified by PIER-" in copied.verify(copied.folder)
    said = copied.verify(certificate, recording)
    assert "the one certified, its contents unchanged, its file not" in said
    rescale(recording)
    said = copied.verify(recording, code=3)
    assert "changed since certificate PIER-" in said
    assert "was changed since the certificate" in copied.verify(certificate, recording, code=3)
    recording.unlink()
    record(recording)  # another run, of the same name
    assert "exchanged: certificate PIER-" in copied.verify(recording, code=3)


def test_the_ledger_of_a_recording_is_found_wherever_it_is(tmp_path: Path) -> None:
    """In the folder that its bench names, behind a link; that of another bench is named."""
    made = laboratory(tmp_path / "lab")
    made.recording.unlink()
    record(made.recording, more='[certificate]\nfolder = "papers"\n')
    made.issue("--folder", str(made.folder / "papers"))
    link = tmp_path / "link.h5"
    link.symlink_to(made.recording)
    for path in (made.recording, link):
        said = made.verify(path)
        assert "certified by PIER-" in said, path
    elsewhere = tmp_path / "elsewhere"
    said = made.issue("--folder", str(elsewhere), "--reason", "another place")
    assert f"huddle verify --certificates {elsewhere}" in " ".join(said.split())
    said = made.verify(made.recording, "--certificates", elsewhere)
    assert said.count("PIER-") == 2


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
    ("change", "wrong"),
    [
        (changed_certificate, "changed since it was issued: its SHA-256"),
        (other_recording, "is another recording than the one certified"),
        (changed_recording, "was changed since the certificate"),
    ],
)
def test_what_is_wrong_is_found(
    copied: Laboratory, change: Callable[[Laboratory], list[Path]], wrong: str
) -> None:
    assert wrong in copied.verify(*change(copied), code=3)
