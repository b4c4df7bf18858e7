"""The calibration report: complete, the same each time, whole or not there, and safe to open."""

from __future__ import annotations

import hashlib
import io
import re
import resource
import shutil
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from pypdf import PdfReader
from pypdf.generic import Destination
from typer.testing import CliRunner

from daq.bench.masks.mask_file import masks_named
from daq.drivers.bench_file import load
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.results.sources import sources
from tests.tui.night_recording import HOSTILE, N_SAMPLES, RATE, record
from tui.cli.main import app
from tui.commands.tui_controls import BenchControls
from tui.report.contents import report_of
from tui.report.figures.drift import without_line
from tui.report.paper import write_paper
from tui.report.parts import Facts, Items, Paragraph, Plot, Report, Section, Table
from tui.report.writing import ReportError, write

if TYPE_CHECKING:
    from pypdf import PageObject

    from daq.estimation.snapshot import Snapshot
    from tui.report.parts import Part

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True, slots=True)
class Reported:
    """A recording, its estimate, and what was written of it."""

    recording: Path
    snapshot: Snapshot
    settings: Settings
    page: str
    report: Report


class Words(HTMLParser):
    """The text of a page, and the tags it is made of."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag."""
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        """Note text."""
        self.words.append(data)

    @property
    def text(self) -> str:
        """All of it, white space made even."""
        return " ".join("".join(self.words).split())


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    folder = tmp_path_factory.mktemp("report")
    recording = record(folder / "night.h5")
    settings = Settings(segment=1.0, methods=("three-sensor",), band=(2.0, 20.0), target_cov=0.1)
    snapshot = estimate([recording], settings)
    out = folder / "night.html"
    report = write(snapshot, out, recordings=[recording], settings=settings)
    return Reported(recording, snapshot, settings, out.read_text(encoding="utf-8"), report)


@pytest.mark.long
def test_the_demo_s_reports_outlive_its_folder_and_have_its_noise_models(
    reported: Reported, tmp_path: Path
) -> None:
    settings, path = reported.settings, ROOT / "tui" / "resources" / "demo.toml"
    models = masks_named("nhnm")
    controls = BenchControls(path, load(path), settings, reports=tmp_path, models=models)
    out = controls.report(reported.recording, reported.snapshot, settings)
    assert out == tmp_path / "night.html"
    page = out.read_text(encoding="utf-8")
    assert "NHNM" in page
    assert "NHNM" not in reported.page


def words_of(part: Part) -> list[str]:
    """Every text in a part of a report."""
    match part:
        case Paragraph():
            return [part.text]
        case Items():
            return [entry.text for entry in part.entries]
        case Facts():
            return [word for row in part.rows for word in row]
        case Table():
            return [part.title, *part.header, *(word for row in part.rows for word in row)]
        case Plot():
            return [part.title]
        case _:
            return list(part.labels)


def said(report: Report) -> list[str]:
    """Every text in a report."""
    words = [report.title, report.subtitle, report.verdict.text]
    for section in report.sections:
        words += [section.title, *(word for part in section.parts for word in words_of(part))]
    return [" ".join(word.split()) for word in words if word]


def tables(report: Report, section: str) -> list[Table]:
    """Return the tables of a section."""
    (found,) = [each for each in report.sections if each.title.startswith(section)]
    return [part for part in found.parts if isinstance(part, Table)]


# ---------------------------------------------------------------------------- contents


def test_it_says_what_was_tested_on_what_by_whom_and_when(reported: Reported) -> None:
    text = Words(reported.page).text
    digest = hashlib.sha256(reported.recording.read_bytes()).hexdigest()
    for word in (
        "pier & <floor>", "Ada <ada@lab>", "cellar", "night.h5", digest, "SN-0", "SN-2", "M-1",
        "X (east), Y", "1000000", "2016-07-14 01:00:00 UTC", "2016-07-14 03:00:00 UTC+0200",
        "Duration1m", "three-sensor", "1 s (100 samples)", "hann", "50 %", "Signature",
        "Small-sample biasremoved",
    ):  # fmt: skip
        assert word in text


def test_noise_is_that_of_the_estimate(reported: Reported) -> None:
    # 100 counts of white noise at 100 Hz, 1e6 counts per m/s²: 2e-10 (m/s²)²/Hz, −97 dB
    table, *_ = tables(reported.report, "Self-noise")
    rows = {row[0]: row for row in table.rows}
    assert float(rows["A.X"][2].replace("−", "-")) == pytest.approx(-96.99, abs=0.5)
    low, high = (float(end.replace("−", "-")) for end in rows["A.X"][3].split(" … "))
    assert low < -96.99 < high
    assert float(rows["B.X"][7]) == pytest.approx(10 * np.log10(4000**2 / 100**2), abs=0.6)
    assert rows[f"{HOSTILE}.Y"][1:3] == ("no signal", "?")


def test_limits_are_judged_with_their_margin(reported: Reported, tmp_path: Path) -> None:
    text = reported.report.verdict.text
    assert text.startswith("NOT DECIDED: whether 1 of 8 channels are below data sheet")
    assert f"There is no noise estimate for {HOSTILE}.Y" in text
    assert "Record for" not in text  # time does not bring the dead channel back
    (table,) = tables(reported.report, "Verdict")
    rows = {row[0]: row for row in table.rows}
    assert rows["A.X"][-1] == "PASS"
    margin, low, high = re.findall(r"[+−-][\d.]+", rows["A.X"][5])
    assert float(margin) == pytest.approx(10, abs=2)
    assert 0 < float(low) < float(margin) < float(high)
    assert rows[f"{HOSTILE}.Y"][-1] == "no estimate"

    failing = record(tmp_path / "noisy.h5", psd=5e-11)
    result = CliRunner().invoke(app, ["report", str(failing), "--out", str(tmp_path / "n.html")])
    assert result.exit_code == 1
    assert "FAIL: 7 of 8 channels above data sheet" in " ".join(result.stdout.split())
    assert "FAIL" in (tmp_path / "n.html").read_text(encoding="utf-8")


def test_by_all_methods_it_is_the_one_that_needs_no_alignment_that_judges(
    reported: Reported,
) -> None:
    settings = replace(reported.settings, methods=("all",))
    report = report_of(
        estimate([reported.recording], settings), settings, sources([reported.recording])
    )
    table, _, methods = tables(report, "Self-noise")
    assert "by the three-sensor method" in table.title
    assert set(methods.header) >= {"three-sensor", "three-channel", "maximum-likelihood"}
    assert report.verdict.text == reported.report.verdict.text


def test_what_happened_is_in_order_and_in_short(reported: Reported) -> None:
    (table,) = tables(reported.report, "What happened")
    assert [row[0] for row in table.rows] == sorted(row[0] for row in table.rows)
    assert len(table.rows) == 5  # 240 events of four sensors and two gaps
    words = [row[3] for row in table.rows]
    assert sum("a frame was damaged (60 of this kind, until 01:00:59)" in w for w in words) == 4
    (gaps,) = [row for row in table.rows if row[2] == "gap"]
    assert gaps[3].startswith("about 130 samples missing (1.3 s): cable pulled (2 of this kind")
    assert gaps[0] == "2016-07-14 01:00:09"  # the block before sample 1000 was received
    assert "segments excluded where a sensor has a gap" in " ".join(said(reported.report))


def test_alignment_clocks_and_model_test_are_there(reported: Reported) -> None:
    text = Words(reported.page).text
    assert "Alignment of the sensors" in text
    assert "Model test" in text
    (clocks,) = tables(reported.report, "Clocks")
    assert [row[0] for row in clocks.rows] == ["A", "B", "C", HOSTILE]


def test_a_test_that_is_still_running_is_preliminary(tmp_path: Path) -> None:
    recording, out = tmp_path / "live.h5", tmp_path / "live.html"

    def report() -> None:
        result = CliRunner().invoke(app, ["report", str(recording)])
        assert result.exit_code == 4, result.output  # a channel is dead

    record(recording, before_end=report)
    text = Words(out.read_text(encoding="utf-8")).text
    assert "Still running, preliminary. NOT DECIDED" in text
    assert "none: the file is still being written" in text


def test_a_recording_left_open_is_not_called_running(reported: Reported, tmp_path: Path) -> None:
    recording, copy = tmp_path / "live.h5", tmp_path / "killed.h5"
    record(recording, before_end=lambda: shutil.copyfile(recording, copy))
    snapshot = estimate([copy], reported.settings)
    report = report_of(snapshot, reported.settings, sources([copy]))
    assert report.verdict.text.startswith("Of a recording whose recorder was killed (huddle repair")
    assert hashlib.sha256(copy.read_bytes()).hexdigest() in said(report)


def test_where_the_motion_is_not_shared_the_report_says_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    motion, other = 4000 * rng.standard_normal((2, N_SAMPLES, 1))
    source = tmp_path / "a.npz"
    sensors = {
        name: (motion + share * other + 100 * rng.standard_normal((N_SAMPLES, 1)))
        for name, share in (("A", 0.0), ("B", 0.2), ("C", 0.0), ("D", 0.2))
    }
    np.savez(source, sampling_rate=RATE, **sensors)
    runner = CliRunner()
    recording = str(tmp_path / "a.h5")
    assert runner.invoke(app, ["import", str(source), "--out", recording]).exit_code == 0
    result = runner.invoke(app, ["report", recording, "--segment", "1s"])
    assert result.exit_code == 0, result.output
    text = Words((tmp_path / "a.html").read_text(encoding="utf-8")).text
    assert re.search(r"The test fails at [\d.]+–50 Hz \(statistic \d+", text)
    assert "No verdict: the bench file has no limits." in text


def test_drift_is_without_its_line_and_the_steps_of_restarts() -> None:
    seconds = np.arange(0.0, 100.0)
    delay = 3e-3 - 20e-6 * seconds
    wander = 2e-6 * np.sin(seconds / 10)
    delay[60:] += 0.4
    left = without_line(seconds, delay + wander)
    assert np.flatnonzero(np.isnan(left)).tolist() == [60]
    line = np.polyfit(seconds, wander, 1)
    assert np.nanmax(np.abs(left)) < 4e-6
    whole = without_line(seconds, 3e-3 - 20e-6 * seconds + wander)
    np.testing.assert_allclose(whole, wander - np.polyval(line, seconds), atol=1e-12)


# ------------------------------------------------------------------------------- files


@pytest.mark.long
def test_the_same_recording_gives_the_same_files(
    reported: Reported, paper: PdfReader, tmp_path: Path
) -> None:
    """As PDF; that pages are the same, the test of the demo's reports shows."""
    write(
        reported.snapshot, tmp_path / "a.pdf", recordings=[reported.recording],
        settings=reported.settings,
    )  # fmt: skip
    assert paper.stream is not None
    paper.stream.seek(0)
    assert (tmp_path / "a.pdf").read_bytes() == paper.stream.read()
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF-")


def test_the_same_report_gives_the_same_paper(reported: Reported) -> None:
    """With one plot; the long test above writes all of them."""
    section = next(s for s in reported.report.sections if any(isinstance(p, Plot) for p in s.parts))
    plot = next(part for part in section.parts if isinstance(part, Plot))
    report = replace(reported.report, sections=(replace(section, parts=(plot,)),))
    one, other = paper_of(report), paper_of(report)
    assert one.getvalue() == other.getvalue()


def test_the_page_needs_nothing_else_and_runs_nothing(reported: Reported) -> None:
    words = Words(reported.page)
    assert not words.tags & {"script", "link", "img", "iframe", "object", "embed", "base", "form"}
    assert not {name for name in words.attributes if name.startswith("on")}
    assert not words.attributes & {"src", "srcset", "href", "action"}
    assert set(re.findall(r"https?://[^\s\"<]+", reported.page)) <= {
        "http://www.w3.org/1999/xlink", "http://www.w3.org/2000/svg",
    }  # fmt: skip
    references = set(re.findall(r'xlink:href="([^"]*)"|url\(([^)]*)\)', reported.page))
    assert all((one or other).startswith("#") for one, other in references)


class Landmarks(HTMLParser):
    """What a screen reader tells apart in a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.path: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None], tuple[str, ...]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag, and those that it is in."""
        self.tags.append((tag, dict(attrs), tuple(self.path)))
        if tag not in {"meta", "br"}:
            self.path.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag without contents."""
        self.tags.append((tag, dict(attrs), tuple(self.path)))

    def handle_endtag(self, tag: str) -> None:
        """Leave a tag."""
        assert self.path.pop() == tag

    def having(self, tag: str) -> list[tuple[dict[str, str | None], tuple[str, ...]]]:
        """Return attributes and place of each tag of a name."""
        return [(attributes, path) for name, attributes, path in self.tags if name == tag]


def test_a_screen_reader_finds_its_way(reported: Reported) -> None:
    page = Landmarks(reported.page)
    assert page.path == []
    for landmark, holds in (("header", "h1"), ("main", "section")):
        assert len(page.having(landmark)) == 1
        assert all(landmark in path for _, path in page.having(holds))
    titles = {attributes["id"] for attributes, _ in page.having("h2")}
    sections = [attributes["aria-labelledby"] for attributes, _ in page.having("section")]
    assert len(sections) == len(reported.report.sections)
    assert set(sections) == titles
    ids = [attributes["id"] for _, attributes, _ in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    heads = page.having("th")
    assert {attributes["scope"] for attributes, path in heads if "thead" in path} == {"col"}
    rows = [attributes["scope"] for attributes, path in heads if "tbody" in path]
    n_rows = sum(
        len(part.rows)
        for s in reported.report.sections
        for part in s.parts
        if isinstance(part, Table)
    )
    assert rows == ["row"] * n_rows
    pictures = [attributes for attributes, _ in page.having("svg")]
    assert all(each["role"] == "img" and each["aria-label"] for each in pictures)
    scrolling = [a for a, _ in page.having("div") if a.get("class") == "wide"]
    assert len(scrolling) == len(pictures) + len(page.having("table"))
    assert all(each["tabindex"] == "0" and each["aria-label"] for each in scrolling)


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours by WCAG 2.2."""

    def luminance(colour: str) -> float:
        parts = [int(colour[n : n + 2], 16) / 255 for n in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_colours_have_contrast_in_light_and_in_dark(reported: Reported) -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    light, dark = (
        dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", block))
        for block in re.findall(r":root \{(.*?)\}", reported.page, re.DOTALL)
    )
    assert set(light) == set(dark)
    for colours in (light, dark):
        for name in ("ink", "quiet", "good", "bad", "doubtful"):  # letters
            for ground in ("paper", "raised"):
                assert contrast(colours[name], colours[ground]) >= 4.5, name
        for name in colours.keys() - {"paper", "raised", "rule", "grid", "nothing"}:  # lines
            assert contrast(colours[name], colours["paper"]) >= 3, name


def test_foreign_names_are_text_and_nothing_else(reported: Reported) -> None:
    assert HOSTILE in Words(reported.page).text
    assert "<script" not in reported.page.lower()
    assert "&lt;script&gt;" in reported.page


@pytest.fixture(scope="module")
def paper(reported: Reported) -> PdfReader:
    return PdfReader(paper_of(reported.report))


def paper_of(report: Report) -> io.BytesIO:
    """Write a report as PDF."""
    file = io.BytesIO()
    write_paper(report, file)
    return file


def places_of(page: PageObject) -> list[tuple[float, float]]:
    """Return where the texts of a page begin, in points."""
    places: list[tuple[float, float]] = []

    def note(text: str, _matrix: object, place: list[float], _font: object, _size: float) -> None:
        if text.strip():
            places.append((place[4], place[5]))

    page.extract_text(visitor_text=note)
    return places


@pytest.mark.long
def test_paper_says_all_that_the_page_says(reported: Reported, paper: PdfReader) -> None:
    whole = "".join(page.extract_text() for page in paper.pages)
    letters = "".join(whole.split())
    page = "".join(Words(reported.page).text.split())
    for word in said(reported.report):
        assert "".join(word.split()) in page
        for piece in word.split():  # lines are broken between words, cells stand side by side
            assert piece in letters
    assert f"{len(paper.pages)} / {len(paper.pages)}" in whole


def test_paper_has_a_title_an_outline_and_tags(reported: Reported, paper: PdfReader) -> None:
    report = reported.report
    assert paper.metadata is not None
    assert paper.metadata.title == f"{report.title}: {report.subtitle}"
    titles = [section.title for section in report.sections]
    outline = [str(entry.title) for entry in paper.outline if isinstance(entry, Destination)]
    assert outline == [f"{number}   {title}" for number, title in enumerate(titles, start=1)]
    root: Any = paper.root_object
    assert root["/Lang"] == "en"
    assert root["/MarkInfo"]["/Marked"]
    (document,) = root["/StructTreeRoot"]["/K"]
    tags = [entry.get_object() for entry in document.get_object()["/K"]]
    assert [str(tag["/T"]) for tag in tags if tag["/S"] == "/H1"] == [report.title]
    assert [str(tag["/T"]) for tag in tags if tag["/S"] == "/H2"] == outline
    plots = [part for each in report.sections for part in each.parts if isinstance(part, Plot)]
    assert [str(tag["/Alt"]) for tag in tags if tag["/S"] == "/Figure"] == [p.alt for p in plots]


def test_signatures_are_not_alone_on_their_page(reported: Reported) -> None:
    """However much of the last page but one is filled."""
    test, *_, settings, signed = reported.report.sections
    for n_lines in range(4, 40, 9):
        filling = Section("Filling", tuple(Paragraph(f"line {n}") for n in range(n_lines)))
        report = replace(reported.report, sections=(test, filling, settings, signed))
        *_, last = PdfReader(paper_of(report)).pages
        text = last.extract_text()
        assert "Signature" in text
        assert "Settings of the estimate" in text


def test_a_text_of_any_length_fits_on_pages(reported: Reported) -> None:
    long = Table(("what", "text"), (("a", "x" * 9000), ("b", "word " * 3000)), left=frozenset({1}))
    section = Section("Long", (long, Paragraph("y" * 9000), Facts((("name", "z " * 9000),))))
    report = replace(reported.report, sections=(section, *reported.report.sections[-2:]))
    text = "".join(page.extract_text() for page in PdfReader(paper_of(report)).pages)
    assert text.count("…") == 4  # each is cut, and says so


def test_a_report_is_whole_or_not_there(reported: Reported, tmp_path: Path) -> None:
    out = tmp_path / "old.html"
    out.write_text("the old one", encoding="utf-8")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))  # as a disk that is full
    try:
        with pytest.raises(ReportError, match=r"old.html: the report cannot be written \(File too"):
            write(
                reported.snapshot, out, recordings=[reported.recording], settings=reported.settings
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert out.read_text(encoding="utf-8") == "the old one"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    ("out", "said"), [("report.doc", r"\.html or \.pdf"), ("none/report.pdf", "no folder")]
)
def test_a_wrong_name_is_refused_before_anything_is_done(
    reported: Reported, out: str, said: str, tmp_path: Path
) -> None:
    arguments = ["report", str(reported.recording), "--out", str(tmp_path / out)]
    result = CliRunner().invoke(app, arguments, terminal_width=300)
    assert result.exit_code == 2
    assert re.search(said, result.stderr)


def test_two_recordings_make_one_report(reported: Reported, tmp_path: Path) -> None:
    other = record(tmp_path / "second.h5")
    files = [reported.recording, other]
    snapshot = estimate(files, reported.settings)
    report = report_of(snapshot, reported.settings, sources(files))
    text = " ".join(said(report))
    assert "night.h5" in text
    assert "second.h5" in text
    assert f"{2 * reported.snapshot.n_segments} segments used" in text


@pytest.mark.long
def test_one_channel_a_sensor_and_fifteen_sensors_fit(reported: Reported, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    motion = 4000 * rng.standard_normal((2000, 1))
    source, recording = tmp_path / "a.npz", tmp_path / "a.h5"
    sensors = {f"S{i:02}": motion + 100 * rng.standard_normal((2000, 1)) for i in range(15)}
    np.savez(source, sampling_rate=RATE, **sensors)  # type: ignore[arg-type]  # names of arrays
    runner = CliRunner()
    assert runner.invoke(app, ["import", str(source), "--out", str(recording)]).exit_code == 0
    snapshot = estimate([recording], reported.settings)
    report = report_of(snapshot, reported.settings, sources([recording]))
    plots = [part for s in report.sections for part in s.parts if isinstance(part, Plot)]
    assert (
        sum(len(plot.panels) for plot in plots) == 15 + 15 + 1
    )  # spectra, Allan deviations, the model test
    for page in PdfReader(paper_of(report)).pages:
        places = places_of(page)
        assert places
        right, top = float(page.mediabox.right), float(page.mediabox.top)
        assert all(0 < x < right and 0 < y < top for x, y in places)
