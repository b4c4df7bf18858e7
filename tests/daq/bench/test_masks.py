"""Noise models against another implementation, units of masks, and masks from CSV files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.bench.loading import load, parse
from daq.bench.masks.mask import NOISE_MODELS, Mask
from daq.bench.masks.mask_file import MaskFileError, masks_named, read_mask
from daq.bench.units import DensityUnit
from daq.devices import bench_file
from daq.errors import BenchFileError, WrongSettingError

DEMO = Path(__file__).parents[3] / "tui" / "resources" / "demo.toml"


@pytest.mark.peer
@pytest.mark.parametrize("name", ["nlnm", "nhnm"])
def test_peterson_s_models_are_those_of_obspy(name: str) -> None:
    estimation = pytest.importorskip("obspy.signal.spectral_estimation")
    period, level = getattr(estimation, f"get_{name}")()
    model = NOISE_MODELS[name]
    found = 10 * np.log10(model.at(1 / period, "m/s²"))
    # its table has four decimals of the levels, and six digits of the periods
    np.testing.assert_allclose(found, level, atol=1e-3)
    assert 1 / np.array(model.frequency)[[0, -1]] == pytest.approx(period[[0, -1]])


def test_peterson_s_models_where_their_lines_are_flat_or_end() -> None:
    at = np.array([1 / 4.5, 1 / 0.3, 1 / 5.0])
    low = 10 * np.log10(NOISE_MODELS["nlnm"].at(at, "m/s²"))
    assert low == pytest.approx([-141.1, -166.7, -141.1], abs=0.01)
    high = 10 * np.log10(NOISE_MODELS["nhnm"].at(np.array([10.0, 1 / 0.8]), "m/s²"))
    assert high == pytest.approx([-91.5, -120.0], abs=0.01)


@pytest.mark.parametrize(
    ("name", "period", "level"),
    [
        # points of Cauzzi and Clinton (2013), in which two independent public programs agree, and
        # middles between them on an axis of log period
        ("alnm", 0.01, -135.0), ("alnm", 0.5, -135.0), ("alnm", 10.0, -130.0),
        ("alnm", 10**0.5, -132.5), ("alnm", 150.0, -118.25), ("ahnm", 0.05, -91.5),
        ("ahnm", 0.22, -97.41), ("ahnm", 0.8, -120.0), ("ahnm", (0.8 * 3.8) ** 0.5, -109.0),
        ("ahnm", 7.1, -105.0), ("ahnm", 150.0, -91.25),
    ],
)  # fmt: skip
def test_accelerometer_models(name: str, period: float, level: float) -> None:
    found = 10 * np.log10(NOISE_MODELS[name].at(np.array([1 / period]), "m/s²"))
    assert found == pytest.approx([level], abs=1e-6)


def test_a_mask_is_undefined_outside_and_converts_to_other_units() -> None:
    mask = Mask("m", "m/s²", (1.0, 10.0), (1e-6, 1e-8))
    at = np.array([0.0, 0.99, 1.0, 10**0.5, 10.0, 10.1])
    psd = mask.at(at, "m/s²")
    assert np.isnan(psd[[0, 1, 5]]).all()
    assert psd[2:5] == pytest.approx([1e-6, 1e-7, 1e-8])
    in_g = mask.at(at, "mg")
    assert in_g[2] == pytest.approx(1e-6 / 9.80665e-3**2)
    velocity = mask.at(at, "m/s")
    assert velocity[2:5] == pytest.approx(psd[2:5] / (2 * np.pi * at[2:5]) ** 2)
    with pytest.raises(WrongSettingError, match="cannot be turned into 'counts'"):
        mask.at(at, "counts")
    assert mask.points(np.array([0.5, 1.0, 3.0, 20.0])).tolist() == [1.0, 3.0, 10.0]


@pytest.mark.parametrize(
    ("text", "unit", "value", "psd"),
    [
        ("(m/s²)²/Hz", "m/s²", 4e-12, 4e-12), ("m²/s⁴/Hz", "m/s²", 4e-12, 4e-12),
        ("m^2/s^4/Hz", "m/s²", 2.0, 2.0), ("g²/Hz", "g", 3e-12, 3e-12),
        ("(m/s^2)**2/Hz", "m/s²", 2.0, 2.0), ("µg/√Hz", "µg", 0.5, 0.25),
        ("ug/sqrt(Hz)", "µg", 0.5, 0.25), ("ng/rtHz", "ng", 3.0, 9.0),
        ("m/s²/√Hz", "m/s²", 1e-6, 1e-12), ("(m/s)/Hz^0.5", "m/s", 1e-6, 1e-12),
        ("dB re 1 (m/s²)²/Hz", "m/s²", -120.0, 1e-12), ("dB re 1 µg/√Hz", "µg", 20.0, 100.0),
        ("dB rel. 1 m²/s⁴/Hz", "m/s²", -130.0, 1e-13),
    ],
)  # fmt: skip
def test_units_of_noise_density(text: str, unit: str, value: float, psd: float) -> None:
    found = DensityUnit.parse(text)
    assert found.unit == unit
    assert found.psd(value) == pytest.approx(psd)


@pytest.mark.parametrize("text", ["", "dB", "V", "m/s²", "g/Hz", "µg/√s"])
def test_units_that_are_no_density_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"such as µg/√Hz, \(m/s²\)²/Hz"):
        DensityUnit.parse(text)


@pytest.mark.parametrize(
    "text",
    [
        "frequency (Hz),noise (µg/√Hz)\n1,2\n100,1\n",
        "# a data sheet\r\n\r\nf [Hz];noise [µg/√Hz]\r\n1,0;2,0\r\n100;1\r\n",
        "Period (s)\tdensity (ug/sqrt(Hz))\n0.01\t1\n1\t2\n",
        '"frequency (Hz)", "noise (dB re 1 µg/√Hz)", remark\n1, 6.0205999, a\n100, 0, b\n',
    ],
    ids=["commas", "semicolons", "periods", "decibels"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_masks_of_data_sheets(text: str, encoding: str, tmp_path: Path) -> None:
    if encoding == "cp1252":
        text = text.replace("/√Hz", "/rtHz")
    path = tmp_path / "sheet.csv"
    path.write_bytes(text.encode(encoding))
    mask = read_mask(path)
    assert (mask.name, mask.unit) == ("sheet", "µg")
    assert mask.frequency == pytest.approx((1.0, 100.0))
    assert mask.psd == pytest.approx((4.0, 1.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no lines; expected a header with units"),
        ("frequency (Hz)\n1\n", "one column"),
        ("frequency,noise\n1,2\n", "first column 'frequency'; expected a header with units"),
        ("frequency (Hz),noise (V)\n1,2\n", "'V': expected a unit of noise density"),
        ("frequency (Hz),noise (µg/√Hz)\n1,2\nx,1\n", "line 3: expected two numbers"),
        ("frequency (Hz),noise (µg/√Hz)\n1,2\n2\n", "line 3: expected two numbers"),
        ("frequency (Hz),noise (µg/√Hz)\n1,2\n2,-1\n", "line 3: 2, -1; expected a finite"),
        ("frequency (Hz),noise (µg/√Hz)\n0,2\n2,1\n", "line 2: 0, 2; expected a finite"),
        ("frequency (Hz),noise (µg/√Hz)\n1,nan\n2,1\n", "line 2: 1, nan; expected a finite"),
        ("frequency (Hz),noise (µg/√Hz)\n1,2\n1,3\n", "1 Hz after 1 Hz; expected increasing"),
        ("frequency (Hz),noise (µg/√Hz)\n1,2\n", "expected at least two points"),
    ],
)
def test_files_that_are_no_masks_are_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "sheet.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MaskFileError) as error:
        read_mask(path)
    assert str(error.value).startswith(f"{path}: {said}")


@settings(max_examples=40)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_mask_or_refused(content: bytes) -> None:
    from tempfile import TemporaryDirectory  # noqa: PLC0415 - a fixture lasts over all examples

    with TemporaryDirectory() as folder:
        path = Path(folder, "sheet.csv")
        path.write_bytes(b"frequency (Hz),noise (g/rtHz)\n" + content)
        try:
            mask = read_mask(path)
        except MaskFileError:
            return
    assert len(mask.frequency) == len(mask.psd) >= 2


def test_masks_are_given_by_model_or_file(tmp_path: Path) -> None:
    path = tmp_path / "sheet.csv"
    path.write_text("frequency (Hz),noise (g²/Hz)\n1,2\n3,4\n", encoding="utf-8")
    assert [mask.name for mask in masks_named(f"nlnm, AHNM,{path}")] == ["NLNM", "AHNM", "sheet"]
    with pytest.raises(WrongSettingError, match=r"did you mean 'nlnm'.*or a CSV file"):
        masks_named("nlmn")
    with pytest.raises(MaskFileError, match=r"absent.csv: No such file"):
        masks_named("absent.csv")


def bench_with(limit: str, folder: Path) -> Path:
    """Write the demo's bench with a limit."""
    path = folder / "bench.toml"
    demo = DEMO.read_text(encoding="utf-8")
    path.write_text(f'{demo}\n[[limits]]\nname = "n" # ours\n{limit}\n', encoding="utf-8")
    return path


def test_a_bench_has_models_as_limits(tmp_path: Path) -> None:
    bench = bench_file.load(bench_with('model = "AHNM"\nchannels = ["Z"]', tmp_path))
    (limit,) = bench.limits
    assert limit.mask.name == "n"
    assert limit.mask.psd == NOISE_MODELS["ahnm"].psd
    assert parse(bench.dump()).limits == bench.limits


def test_a_recording_holds_the_points_of_a_file(tmp_path: Path) -> None:
    sheet = tmp_path / "sheets" / "a.csv"
    sheet.parent.mkdir()
    sheet.write_text("frequency (Hz),noise (µg/√Hz)\n1,2\n100,1\n", encoding="utf-8")
    bench = load(bench_with('file = "sheets/a.csv"', tmp_path))
    sheet.unlink()
    again = parse(bench.text)  # what the recording has
    assert again.limits[0].mask == Mask("n", "µg", (1.0, 100.0), (4.0, 1.0))
    assert 'name = "n" # ours' in bench.text
    assert bench.text.startswith(DEMO.read_text(encoding="utf-8")[:200])


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ('file = "none.csv"', r'limits\["n"\].file = "none.csv": .*No such file'),
        ('file = "a.csv"\nmodel = "nlnm"', "expected without frequency, psd, unit and model"),
        ('model = "nlm"', r'limits\["n"\]: model: expected one of nlnm, nhnm, alnm, ahnm'),
        ('model = "nlnm"\nunit = "g²/Hz"', "model: expected without frequency, psd and unit"),
        ("", r'limits\["n"\]: expected frequency and psd, or model, or file'),
        ("frequency = [1, 2]\npsd = [1]", "2 frequencies and 1 values; expected as many"),
        ("frequency = [1, 2]\npsd = [1, -1]", "psd: expected numbers above 0"),
        ('frequency = [1, 2]\npsd = [1, 1]\nunit = "V"', "'V': expected a unit of noise density"),
        ('frequency = [1, 2]\npsd = [1, 1]\nunit = "V/√Hz"', r'\.unit = "V/√Hz": unit .*\(A\.X\)'),
    ],
)
def test_invalid_limits_are_errors_of_the_bench_file(limit: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(BenchFileError, match=said):
        bench_file.load(bench_with(limit, tmp_path))


def test_a_file_is_not_read_from_the_text_of_a_recording() -> None:
    text = DEMO.read_text(encoding="utf-8") + '\n[[limits]]\nname = "n"\nfile = "/etc/passwd"\n'
    with pytest.raises(BenchFileError, match="file: expected frequency and psd, or model"):
        parse(text)
