"""Figures of the noise: curves, limits, noise models, and the files that ``huddle plot`` writes."""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import huddle
from daq.bench.loading import parse
from daq.bench.masks.mask import NOISE_MODELS, Mask
from daq.bench.masks.mask_file import masks_named
from daq.bench.model import Bench
from daq.errors import WrongSettingError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.results.result import Result
from daq.results.signal import Signal
from estimator.self_noise.result import Flag
from tests import command
from tests.tui.example_snapshot import SETTINGS, made_snapshot
from tests.tui.night_recording import record
from tui.page import drawing
from tui.page.blocks import Plot
from tui.report.figures.curves import MODEL_RANGE_DB, noise_plots, write_figure
from tui.report.figures.signal import signal_plots

SNAPSHOT = made_snapshot()
LIMIT = """
name = "b"
sampling_rate = 200.0
[[sensors]]
name = "A"
driver = "text"
port = "p"
channels = [{name = "X", sensitivity = 1.0}]
[[limits]]
name = "data sheet"
frequency = [0.1, 1000.0]
psd = [0.4, 0.4]
unit = "µg/√Hz"
channels = ["X"]
"""


def drawn(plots: Iterable[Plot]) -> list[Axes]:
    """Return the axes of all panels."""
    with drawing.look():
        return [
            axes
            for plot in plots
            for axes in drawing.alone(plot, 7.1).axes
            if axes.get_title(loc="left")  # not the scale at the right
        ]


def line(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Return frequency and dB of a line of a panel."""
    (found,) = [each for each in axes.get_lines() if each.get_label() == label]
    x, y = np.asarray(found.get_xdata()), np.asarray(found.get_ydata())
    return x, y


def panels(
    methods: Sequence[str] = ("three-sensor",),
    models: Sequence[Mask] = (),
    bench: Bench | None = None,
) -> list[Axes]:
    """Draw the example's noise by some methods."""
    results = {method: SNAPSHOT.results[method] for method in methods}
    snapshot = made_snapshot()
    snapshot.results.clear()
    snapshot.results.update(results)
    return drawn(noise_plots(Result(snapshot, SETTINGS, bench), models))


@functools.cache
def usual() -> list[Axes]:
    """Draw the example's noise by one method, once for all tests."""
    return panels()


def test_a_bound_is_a_dashed_line_and_no_curve_of_noise() -> None:
    (name, noise), *_ = SNAPSHOT.results.items()
    flags = noise.flags.copy()
    flags[: len(flags) // 2] |= Flag.UNIDENTIFIED
    snapshot = replace(SNAPSHOT, results={name: replace(noise, flags=flags)})
    for axes in drawn(noise_plots(Result(snapshot, SETTINGS))):
        lines = {str(line.get_label()): line for line in axes.lines}
        curve, bound = lines["self-noise"], lines["self-noise is below"]
        known, limited = (np.isfinite(np.asarray(line.get_ydata())) for line in (curve, bound))
        assert bound.is_dashed()
        assert known.any()
        assert limited.any()
        assert not (known & limited).any()


def test_curves_are_the_estimate() -> None:
    for number, axes in enumerate(usual()):
        x, y = line(axes, "self-noise")
        noise = SNAPSHOT.results["three-sensor"].noise_psd[:, number]
        single = np.isin(x, SNAPSHOT.frequency)  # points of one frequency
        expected = noise[np.searchsorted(SNAPSHOT.frequency, x[single])]
        assert single.sum() > 20
        np.testing.assert_allclose(y[single], 10 * np.log10(expected))
    labels = [axes.get_xlabel() for axes in usual()]  # those of the last row serve all
    assert labels == [*[""] * (len(labels) - 3), *["frequency (Hz)"] * 3]
    assert usual()[0].get_ylabel() == "dB re 1 (m/s²)²/Hz"


def test_all_methods_are_overlaid() -> None:
    axes = panels(("three-sensor", "three-channel"))[0]
    x, y = line(axes, "three-channel")
    single = np.isin(x, SNAPSHOT.frequency)
    noise = SNAPSHOT.results["three-channel"].noise_psd[:, 0]
    expected = noise[np.searchsorted(SNAPSHOT.frequency, x[single])]
    positive = expected > 0
    np.testing.assert_allclose(y[single][positive], 10 * np.log10(expected[positive]))
    line(axes, "self-noise, three-sensor")
    assert {each.get_label() for each in axes.collections} >= {"95 % interval"}


def test_limits_and_models_are_lines_in_the_unit_of_the_result() -> None:
    first, second, _ = panels(models=masks_named("ahnm,nhnm"), bench=parse(LIMIT))[:3]
    x, y = line(first, "limit")
    assert x[0] < SNAPSHOT.frequency[1]
    assert x[-1] > 99
    np.testing.assert_allclose(y, 20 * np.log10(0.4 * 9.80665e-6))
    assert "limit" not in {each.get_label() for each in second.get_lines()}
    for name in ("AHNM", "NHNM"):
        x, y = line(second, name)
        expected = 10 * np.log10(NOISE_MODELS[name.lower()].at(x, "m/s²"))
        np.testing.assert_allclose(y, expected)
    assert x[-1] == pytest.approx(10.0)  # the NHNM ends there


def test_a_model_far_off_widens_the_scale_so_far_and_no_farther() -> None:
    low, high = usual()[0].get_ylim()
    near = panels(models=[Mask("near", "m/s²", (1.0, 10.0), (1e-14, 1e-14))])[0].get_ylim()
    far = panels(models=[Mask("far", "m/s²", (1.0, 10.0), (1e-40, 1e-40))])[0].get_ylim()
    assert near[0] < -140 < low
    assert low - MODEL_RANGE_DB - 20 <= far[0] <= low - MODEL_RANGE_DB + 20
    assert near[1] == far[1] == high


def test_a_model_of_another_quantity_is_refused() -> None:
    with pytest.raises(WrongSettingError, match="'V' cannot be turned into 'm/s²'"):
        panels(models=[Mask("volts", "V", (1.0, 10.0), (1.0, 1.0))])


def test_the_key_fits_into_a_narrow_figure() -> None:
    snapshot = made_snapshot(n_channels=1)
    for width in (3.3, 7.1):
        plots = noise_plots(Result(snapshot, SETTINGS), masks_named("nlnm,nhnm,alnm"), width=width)
        with drawing.look():
            figure = Figure(figsize=(width, drawing.stack_height(plots)))
            drawing.stack(plots, figure)
            figure.draw_without_rendering()
            (key,) = figure.legends
            box, whole = key.get_window_extent(), figure.bbox
            assert whole.x0 <= box.x0
            assert box.x1 <= whole.x1
            highest = max(axes.get_window_extent().y1 for axes in figure.axes)
            assert box.y0 > highest


def test_the_same_estimate_gives_the_same_file(tmp_path: Path) -> None:
    snapshot = made_snapshot(n_channels=1)
    contents = {}
    for name in ("a.svg", "b.svg", "a.pdf", "b.pdf"):
        write_figure(Result(snapshot, SETTINGS), tmp_path / name, width=7.1)
        contents[name] = (tmp_path / name).read_bytes()
    for kind in ("svg", "pdf"):
        assert contents[f"a.{kind}"] == contents[f"b.{kind}"]
    assert contents["a.pdf"].startswith(b"%PDF-")
    root = ET.fromstring(contents["a.svg"])  # noqa: S314 - our own
    assert root.attrib["width"] == "511.2pt"
    assert not root.findall(".//{*}text")  # letters are shapes: no font is needed


def test_the_command_writes_what_the_suffix_says(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    recording = record(tmp_path / "night.h5")
    arguments = ["plot", str(recording), "--segment", "1s", "--models", "nlnm"]
    command.huddle(*arguments)
    assert (tmp_path / "night.svg").read_text(encoding="utf-8").startswith("<?xml")
    request.getfixturevalue("empty_figures")
    out = tmp_path / "n.png"
    out.write_bytes(b"old")
    command.huddle(*arguments, "-o", out, "--width", "90")
    assert out.read_bytes().startswith(b"\x89PNG")
    width = int.from_bytes(out.read_bytes()[16:20], "big")
    assert width == pytest.approx(90 / 25.4 * 300, abs=1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-o", "n.jpg"], r"ends in \.svg, \.png or \.pdf"),
        (["-o", "none/n.svg"], "no folder"),
        (["--models", "nlm"], "did you mean 'nlnm'"),
        (["--models", "none.csv"], "none.csv: No such file"),
        (["--width", "10"], "equal to 80"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_the_estimate(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = command.huddle("plot", "absent.h5", *options, terminal_width=300, code=2)
    assert re.search(said, result.stderr)


def test_minor_ticks_as_one_line_look_as_those_of_matplotlib(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def panel(axes: Any) -> None:  # noqa: ANN401 - those of matplotlib
        axes.loglog([0.03, 70.0], [2.2, 5.0])  # less than a decade has labels at minor ticks

    plot = Plot("", (panel, panel), n_columns=2, height=1.5, alt="two lines")

    def picture() -> tuple[bytes, list[int]]:
        content = io.BytesIO()
        with drawing.look():
            figure = drawing.alone(plot, 7.1)
            figure.savefig(content, format="raw")
        counts = [
            len(each.get_minor_ticks()) for each in (figure.axes[0].xaxis, figure.axes[0].yaxis)
        ]
        return content.getvalue(), counts

    joined, (n_along, n_up) = picture()
    monkeypatch.setattr(drawing, "_join_minor_ticks", lambda _: None)
    apart, (n_apart, n_up_apart) = picture()
    assert (n_along, n_up) == (0, n_up_apart)
    assert min(n_apart, n_up_apart) > 0
    assert joined == apart


def test_of_one_sensor_the_psd_is_drawn() -> None:
    alone = huddle.self_noise(
        {"A": np.random.default_rng(1).standard_normal((3000, 2))}, fs=100.0, segment="1s"
    )
    axes = drawn(noise_plots(Result(alone.snapshot, alone.settings)))
    assert len(axes) >= 2
    labels = {str(line.get_label()) for each in axes for line in each.lines if each.lines}
    assert "recorded" in labels
    assert not [label for label in labels if "noise" in label]
    shared = Figure().subplots()
    alone.plot(ax=shared)
    assert [line.get_label() for line in shared.lines] == ["A.1", "A.2"]


def test_a_recording_against_time(tmp_path: Path) -> None:
    """The same file each time, with every channel and times of UTC; spectra if they are known."""
    path = record(tmp_path / "night.h5")
    files = []
    for name in ("a.svg", "b.svg"):
        arguments = ["plot", str(path), "--signal", "--segment", "10", "-o", str(tmp_path / name)]
        command.huddle(*arguments)
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]
    with Recording.open(path) as recording, drawing.look():
        signal = Signal(recording)
        snapshot = estimate([path], Settings(segment=1.0))
        waveforms, *spectra = signal_plots(signal, snapshot)
        (axes,) = drawing.alone(waveforms, 7.1).axes
        titles = [each.get_title(loc="left") for each in drawing.alone(spectra[0], 7.1).axes]
    assert [label.get_text() for label in axes.get_yticklabels()][:2] == ["A.X", "A.Y"]
    assert axes.get_xlabel() == "UTC, from 2016-07-14"
    assert [each.partition(", ")[2][:5] for each in titles] == ["recor", "noise"]
