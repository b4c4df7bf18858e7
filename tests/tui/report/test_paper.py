"""The report as PDF: the same each time, tagged, nothing outside its pages; where files go."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pypdf import PageObject, PdfReader
from pypdf.generic import Destination
from typer.testing import CliRunner

from daq.bench.masks.mask_file import masks_named
from daq.devices.bench_file import load
from tests.command import huddle, words_of
from tests.full_disk import files_limited_to
from tests.tui.night_recording import RATE, record
from tests.tui.report.written_report import ROOT, Reported, Words, paper_of, result_of, texts_of
from tui.commands.main import app
from tui.commands.tui_controls import BenchControls
from tui.page import drawing
from tui.page.axes import Axes
from tui.page.blocks import KeyValues, Paragraph, Plot, Report, Section
from tui.page.drawing import WIDTH
from tui.page.table import Table
from tui.page.ticks import even_ticks, set_log_ticks
from tui.report.contents import report_of
from tui.report.writing import ReportError, write


@pytest.mark.long
def test_the_same_recording_gives_the_same_files(
    reported: Reported, paper: PdfReader, tmp_path: Path
) -> None:
    """As PDF; that pages are the same, the test of the demo's reports shows."""
    write(reported.result, tmp_path / "a.pdf")
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
    for word in texts_of(reported.report):
        assert "".join(word.split()) in page
        for piece in word.split():  # lines are broken between words, cells stand side by side
            assert piece in letters
    assert f"page {len(paper.pages)} of {len(paper.pages)}" in whole


@pytest.mark.usefixtures("empty_figures")
def test_paper_has_a_title_an_outline_and_tags(reported: Reported) -> None:
    report = reported.report
    paper = PdfReader(paper_of(report))
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
    *_, settings, signed = reported.report.sections
    for n_lines in range(4, 40, 9):
        filling = Section("Filling", tuple(Paragraph(f"line {n}") for n in range(n_lines)))
        report = replace(reported.report, sections=(filling, settings, signed))
        *_, last = PdfReader(paper_of(report)).pages
        text = last.extract_text()
        assert "Signature" in text
        assert "Settings of the estimate" in text


def test_a_text_of_any_length_fits_on_pages(reported: Reported) -> None:
    long = Table(("what", "text"), (("a", "x" * 9000), ("b", "word " * 3000)), left=frozenset({1}))
    section = Section("Long", (long, Paragraph("y" * 9000), KeyValues((("name", "z " * 9000),))))
    report = replace(reported.report, sections=(section, *reported.report.sections[-2:]))
    text = "".join(page.extract_text() for page in PdfReader(paper_of(report)).pages)
    assert text.count("…") == 4  # each is cut, and says so


def test_a_row_of_many_lines_ends_on_its_page() -> None:
    many = Table(("what", "text"), (("a", "b\n" * 400), ("last", "row")), left=frozenset({0, 1}))
    report = Report("Rows", "", Paragraph("set"), (Section("One", (many,)),))
    below: list[float] = []

    def note(text: str, _m: object, place: list[float], _f: object, _s: float) -> None:
        below.extend([place[5]] * bool(text.strip()))

    text = ""
    for page in PdfReader(paper_of(report)).pages:
        text += page.extract_text(visitor_text=note)
    assert min(below) > 0
    assert "…" in text
    assert "row" in text


@pytest.mark.long
def test_one_channel_a_sensor_and_fifteen_sensors_fit(reported: Reported, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    motion = 4000 * rng.standard_normal((2000, 1))
    source, recording = tmp_path / "a.npz", tmp_path / "a.h5"
    sensors = {f"S{i:02}": motion + 100 * rng.standard_normal((2000, 1)) for i in range(15)}
    np.savez(source, sampling_rate=RATE, **sensors)  # type: ignore[arg-type]  # names of arrays
    huddle("import", source, "--out", recording)
    report = report_of(result_of(reported.settings, recording))
    plots = [part for s in report.sections for part in s.parts if isinstance(part, Plot)]
    assert (
        sum(len(plot.panels) for plot in plots) == 15 + 15 + 1 + 15 + 2 + 3
    )  # spectra, Allan deviations, the model test, sketches, coherence of pairs, against time
    for page in PdfReader(paper_of(report)).pages:
        places = places_of(page)
        assert places
        right, top = float(page.mediabox.right), float(page.mediabox.top)
        assert all(0 < x < right and 0 < y < top for x, y in places)


@pytest.mark.usefixtures("empty_figures")
def test_a_pass_of_two_minutes_has_its_result_on_page_one_and_four_pages(tmp_path: Path) -> None:
    """Nine channels of three sensors. There were 6 pages, and two tables of results."""
    limit = '[[limits]]\nname = "sheet"\nfrequency = [1, 50]\npsd = [1.6e-11, 1.6e-11]\n'
    written = files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    bench, recording, out = (tmp_path / name for name in ("b.toml", "b.h5", "b.pdf"))
    bench.write_text(written.replace("[recording]", f"{limit}[recording]"), encoding="utf-8")
    huddle("simulate", bench, "-d", "2min", "--out", recording)
    huddle("report", recording, "--out", out)
    first, second, *others = (page.extract_text() for page in PdfReader(out).pages)
    assert len(others) <= 2
    assert "PASS: all 9 channels are below sheet." in first
    assert first.count("< 0.01 %") == 9
    assert "nothing can be said." in first  # the last words of the section
    assert "\n2   Facts\n" in second


def test_axes_above_others_have_labels_if_a_page_ends_between_them() -> None:
    def panel(axes: Axes) -> None:
        axes.set(xlabel="time (s)")

    plots = [Plot("", (panel,), 1, 2.5, "a plot", is_continued=n < 5) for n in range(6)]
    section = Section("One", tuple(plots))
    report = Report("Plots", "", Paragraph("drawn"), (section,))
    pages = [page.extract_text() for page in PdfReader(paper_of(report)).pages]
    assert len(pages) == 2
    assert [text.count("time (s)") for text in pages] == [1, 1]


def test_curves_are_paths_where_the_axes_have_them() -> None:
    at, level = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.5, 2.5, np.nan, 1.0])

    def panel(axes: Axes) -> None:
        axes.fill_between(at, at - 4, at, color="#ff0000", alpha=0.25, lw=0)
        axes.plot(at, level, color="#0000ff", lw=1.5, dashes=(4, 2))
        axes.set(xlim=(1, 4), ylim=(0, 2), xlabel="time ($s$)", ylabel="height")

    plot = Plot("", (panel,), n_columns=1, height=1.0, alt="a curve")
    report = Report("Plots", "", Paragraph("drawn"), (Section("One", (plot,)),))
    (page,) = PdfReader(paper_of(report)).pages
    assert "time ($s$)" in page.extract_text()
    resources: Any = page["/Resources"]
    assert [each["/ca"] for each in resources["/ExtGState"].values() if "/ca" in each] == [0.25]
    content = page.get_contents()
    assert content is not None
    words = content.get_data().decode("latin-1").splitlines()
    (curve,) = (line for line in words if " 0 0 1 RG 1.5 w" in line)
    assert "[6 3] 0 d" in curve  # dashes are in widths of the line
    assert (curve.count(" m"), curve.count(" l")) == (2, 1)  # a gap, and a point alone after it
    found = re.search(r"([\d.]+) ([\d.]+) m ([\d.]+) ([\d.]+) l", curve)
    clip = re.search(r"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re W n", curve)
    assert found is not None
    assert clip is not None
    x, y, width, height = map(float, clip.groups())
    inner = WIDTH - drawing.LEFT - plot.right
    assert (width, height) == pytest.approx((72 * inner, 72 * 0.8 * plot.height), abs=0.01)
    points = np.array(found.groups(), float).reshape(2, 2)
    shown = [(x, y + 0.25 * height), (x + width / 3, y + 1.25 * height)]
    np.testing.assert_allclose(points, shown, atol=0.01)
    assert any(" 1 0 0 rg" in line and line.endswith("f Q") for line in words)


def test_markers_stand_at_their_points_and_cells_have_the_colours_of_the_map() -> None:
    def panel(axes: Axes) -> None:
        draw = partial(axes.plot, [0.5, np.nan], [0.5, 0.5], ls="", color="#0000ff", ms=4.0)
        draw(marker="x")
        draw(marker="o", mfc="none")
        cells = np.array([[0.0, np.nan], [1.0, 2.0]])
        edges = np.array([1.0, 10.0, 100.0])
        axes.pcolormesh(edges, np.arange(3.0), cells, cmap="viridis", vmin=0.0, vmax=2.0)
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 2.0))

    plot = Plot("", (panel,), n_columns=1, height=1.0, alt="a map")
    report = Report("Plots", "", Paragraph("drawn"), (Section("One", (plot,)),))
    content = PdfReader(paper_of(report)).pages[0].get_contents()
    assert content is not None
    lines = content.get_data().decode("latin-1").splitlines()
    x, y, width, height = next(
        map(float, found.groups())
        for line in lines
        if (found := re.search(r"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re W n", line))
    )
    cross, ring = (line for line in lines if " 0 0 1 RG 1 w" in line)
    for drawn, n_lines in ((cross, 2), (ring, 1)):
        numbers = re.findall(r"([\d.]+) ([\d.]+) [ml]", drawn)
        points = np.array(numbers, float)
        assert drawn.count(" m ") == n_lines
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        np.testing.assert_allclose(middle, [x + width / 2, y + height / 4], atol=0.01)
        np.testing.assert_allclose(np.ptp(points, axis=0), 4.0, atol=0.02)
    filled = [line.split(" rg")[0].split("n ")[-1] for line in lines if line.endswith(" f Q")]
    colours = [[round(255 * float(part)) for part in each.split()] for each in filled]
    assert colours == [[68, 1, 84], [33, 145, 140], [253, 231, 37]]


def test_ticks_are_round_numbers_between_both_ends() -> None:
    assert even_ticks(-70, -10, 6) == [-70, -60, -50, -40, -30, -20, -10]
    assert even_ticks(0.13, 0.94, 4) == pytest.approx([0.5])
    assert even_ticks(0.0, 3600.0, 8, (1, 1.5, 2, 3, 5, 6)) == list(range(0, 3601, 500))
    found: dict[bool, list[float]] = {}

    class Recorded:
        def set_ticks(self, ticks: list[float], labels: list[str], *, minor: bool = False) -> None:
            assert len(ticks) == len(labels)
            found[minor] = ticks

    set_log_ticks(Recorded(), 0.1, 100.0, str)
    assert found == {
        False: pytest.approx([0.1, 1, 10, 100]),
        True: pytest.approx([d * 10.0**e for e in (-1, 0, 1) for d in range(2, 10)]),
    }
    set_log_ticks(Recorded(), 12.0, 80.0, str)  # a decade holds no two powers of ten
    assert found[False] == pytest.approx([20, 50])
    set_log_ticks(Recorded(), 1e-6, 1.2, str, most=4, has_minor=False)
    assert found == {False: pytest.approx([1e-6, 1e-4, 1e-2, 1.0]), True: []}


def test_tables_of_the_annex_stand_side_by_side_where_they_fit() -> None:
    narrow = Table(("channel", "noise (dB)"), (("A.X", "-120.1"), ("A.Y", "-119.7")), title="Short")
    wide = Table(("what", "in words"), (("a", "word " * 30),), left=frozenset({0, 1}))
    facts = KeyValues(
        (("One", "first"), ("Two", "second"), ("Long", "word " * 60), ("Four", "last"))
    )
    parts = (narrow, narrow, wide, narrow, facts)

    def placed(*, is_annex: bool) -> dict[str, list[tuple[float, float]]]:
        section = Section("Numbers", parts, is_annex)
        report = Report("Tables", "", Paragraph("set"), (section,))
        (page,) = PdfReader(paper_of(report)).pages
        places: dict[str, list[tuple[float, float]]] = {}

        def note(text: str, _m: object, place: list[float], _f: object, _s: float) -> None:
            places.setdefault(text.strip(), []).append((place[4], round(place[5], 1)))

        page.extract_text(visitor_text=note)
        return places

    below, beside = placed(is_annex=False), placed(is_annex=True)
    assert len({y for _, y in below["Short"]}) == 3
    (left, top), (right, same), (again, lower) = beside["Short"]
    assert top == same > lower
    assert left == again < right
    (one,), (two,), (long,), (four,) = (beside[name] for name in ("One", "Two", "Long", "Four"))
    assert one[1] == two[1] > long[1] > four[1]
    assert one[0] == long[0] == four[0] < two[0]
    assert below["One"][0][0] == below["Two"][0][0]


# --- report files ----------------------------------------------------------------------------


@pytest.mark.long
def test_the_demo_s_reports_outlive_its_folder_and_have_its_noise_models(
    reported: Reported, tmp_path: Path
) -> None:
    settings, path = reported.settings, ROOT / "tui" / "resources" / "demo.toml"
    models = masks_named("nhnm")
    controls = BenchControls(path, load(path), settings, reports=tmp_path, models=models)
    out = controls.report(reported.recording, reported.result)
    assert out == tmp_path / "night.html"
    page = out.read_text(encoding="utf-8")
    assert "NHNM" in page
    assert "NHNM" not in reported.page


@pytest.mark.usefixtures("empty_figures")
def test_a_test_that_is_still_running_is_preliminary(tmp_path: Path) -> None:
    recording, out = tmp_path / "live.h5", tmp_path / "live.html"

    def report() -> None:
        result = CliRunner().invoke(app, ["report", str(recording)])
        assert result.exit_code == 4, result.output  # a channel is dead

    record(recording, before_end=report)
    text = Words(out.read_text(encoding="utf-8")).text
    assert "Still running, preliminary. NOT DECIDED" in text
    assert "none: the file is still being written" in text


@pytest.mark.usefixtures("empty_figures")
def test_a_report_is_whole_or_not_there(reported: Reported, tmp_path: Path) -> None:
    out = tmp_path / "old.html"
    out.write_text("the old one", encoding="utf-8")
    message = r"old.html: cannot be written \(File too"
    with files_limited_to(10_000), pytest.raises(ReportError, match=message):
        write(reported.result, out, taken="replace")
    assert out.read_text(encoding="utf-8") == "the old one"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    ("out", "said"), [("report.doc", r"\.html, \.pdf or \.xml"), ("none/report.pdf", "no folder")]
)
def test_a_wrong_name_is_refused_before_anything_is_done(
    reported: Reported, out: str, said: str, tmp_path: Path
) -> None:
    arguments = ["report", str(reported.recording), "--out", str(tmp_path / out)]
    result = huddle(*arguments, terminal_width=300, code=2)
    assert re.search(said, result.stderr)


@pytest.mark.usefixtures("empty_figures")
def test_a_draft_replaces_no_other_one_unless_forced(reported: Reported, tmp_path: Path) -> None:
    """Settings are not tried until they pass, without a trace."""
    out = tmp_path / "night.html"
    arguments = ["report", str(reported.recording), "--out", str(out), "--segment", "1s"]
    huddle(*arguments, code=4)
    first = out.read_bytes()
    huddle(*arguments, code=4)  # the same once more changes nothing
    assert "exists with other content" in words_of(*arguments[:-1], "2s", code=3)
    assert out.read_bytes() == first
    huddle(*arguments[:-1], "2s", "--force", code=4)
    page = Words(out.read_text(encoding="utf-8")).text
    assert "segment 1 s → 2 s" in page
    _, beside = write(reported.result, out, taken="beside")
    assert beside == tmp_path / "night-2.html"


def test_a_draft_is_marked_and_says_what_is_missing(reported: Reported) -> None:
    report = reported.report
    assert report.watermark == "DRAFT"
    assert report.number == ""
    text = Words(reported.page).text
    assert "DRAFT: not a certificate" in text
    assert "Sensor B recorded nothing for" in text
    assert "name and address of the laboratory ([laboratory] name, address)" in text
