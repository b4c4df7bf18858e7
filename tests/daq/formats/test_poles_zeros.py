"""Poles and zeros: SACPZ files, dictionaries and Responses of ObsPy, and what a Stream carries."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import huddle
from daq.errors import ImportFormatError
from daq.formats.response import ChannelResponse, Responses

ZEROS, POLES = (0j, 0j, 0j), (-4 + 4j, -4 - 4j, -900 + 0j)
CONSTANT = 5e9
PLACE = "* NETWORK   (KNETWK): XX\n* STATION    (KSTNM): ABC\n* LOCATION   (KHOLE): 00\n"
HEAD = PLACE + "* CHANNEL   (KCMPNM): HHZ\n* INPUT UNIT        : M\n* A0                : 1.0\n"
LISTS = "ZEROS 3\nPOLES 3\n-4.0 4.0\n-4.0 -4.0\n-900 0.0\nCONSTANT 5.0E+09\n"
SPANS = [
    ("2020-01-01T00:00:00", "2025-06-01T00:00:00"),
    ("2025-06-01T00:00:00", "2599-12-31T23:59:59"),
]
FREQUENCY = np.array([0.1, 1.0, 10.0])
NS = 10**9
DAY_2026 = 1_767_225_600 * NS
PAZ = {"zeros": ZEROS[1:], "poles": POLES, "gain": 2.0, "sensitivity": CONSTANT / 2}


def counts_per_unit(found: ChannelResponse | None) -> np.ndarray[Any, Any]:
    assert found is not None
    return np.asarray(found.sensitivity * found.shape.at(FREQUENCY))


def expected(n_zeros: int) -> np.ndarray[Any, Any]:
    """Return counts per unit by the definition: constant, zeros over poles."""
    s = 2j * np.pi * FREQUENCY
    return np.asarray(CONSTANT * s**n_zeros / np.prod([s - pole for pole in POLES], axis=0))


def test_sacpz_is_read_without_obspy_by_code_and_date(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "obspy", None)
    blocks = [f"{HEAD}* START : {a}\n* END : {b}\n{LISTS}" for a, b in SPANS]
    blocks[0] = blocks[0].replace("5.0E+09", "1.0")
    path = tmp_path / "SACPZ.XX.ABC.00.HHZ"
    path.write_text("".join(blocks), encoding="utf-8")
    found = Responses([path]).of("XX.ABC.00", "HHZ", [(DAY_2026, DAY_2026 + 60 * NS)])
    assert found is not None
    assert found.unit == "m"
    np.testing.assert_allclose(counts_per_unit(found), expected(3), rtol=1e-12)
    with pytest.raises(ImportFormatError, match=r"no response for XX\.ABC\.00\.HHN"):
        Responses([path]).of("XX.ABC.00", "HHN")
    (tmp_path / "plain").write_text(LISTS, encoding="utf-8")  # of any channel
    assert Responses([tmp_path / "plain"]).of("A", "X") is not None


@pytest.mark.parametrize(
    ("line", "said"),
    [("-4.0 4.0\n", "line 9, '-4.0 x'"), ("CONSTANT 5.0E+09", "at least one channel")],
)
def test_a_damaged_sacpz_file_is_refused(tmp_path: Path, line: str, said: str) -> None:
    other = "-4.0 x\n" if "x" in said else ""
    (tmp_path / "a").write_text((HEAD + LISTS).replace(line, other), encoding="utf-8")
    with pytest.raises(ImportFormatError, match=said):
        Responses([tmp_path / "a"])


def test_a_dictionary_is_of_velocity_unless_it_says_so() -> None:
    found = Responses([PAZ]).of("A", "X")
    assert found is not None
    assert found.unit == "m/s"
    np.testing.assert_allclose(counts_per_unit(found), expected(2), rtol=1e-12)
    other = Responses([PAZ | {"input_units": "M/S**2"}]).of("A", "X")
    assert other is not None
    assert other.unit == "m/s²"
    with pytest.raises(ImportFormatError, match=r"'gain'; expected the keys poles, zeros, gain"):
        Responses([{"poles": [], "zeros": []}])


def test_a_dictionary_is_what_obspy_takes_it_for() -> None:
    invsim: Any = pytest.importorskip("obspy.signal.invsim", reason="ObsPy is an extra")
    theirs, at = invsim.paz_to_freq_resp(POLES, ZEROS[1:], PAZ["gain"], 1 / 200, 4096, freq=True)
    found = Responses([PAZ]).of("A", "X")
    assert found is not None
    ours = found.sensitivity * found.shape.at(at[1:])
    np.testing.assert_allclose(ours, PAZ["sensitivity"] * theirs[1:], rtol=1e-9)


def stream(**attached: object) -> Any:  # noqa: ANN401 - ObsPy has no types
    """Return a Stream of three stations, 30 s at 100 Hz, with what its traces carry."""
    obspy = pytest.importorskip("obspy", reason="ObsPy is an extra")
    rng = np.random.default_rng(4)
    motion = rng.standard_normal(3000)
    header = {"network": "XX", "channel": "HHZ", "sampling_rate": 100.0, **attached}
    return obspy.Stream(
        [
            obspy.Trace(
                1e4 * (motion + 0.1 * rng.standard_normal(3000)), header | {"station": name}
            )
            for name in ("A", "B", "C")
        ]
    )


def test_responses_of_a_stream_count_once() -> None:
    inventory: Any = pytest.importorskip("obspy.core.inventory", reason="ObsPy is an extra")
    response = inventory.Response.from_paz(
        [], [], stage_gain=2e4, input_units="M/S**2", output_units="COUNTS"
    )
    given = stream(response=response)
    attached = huddle.self_noise(given, segment="1s")
    assert attached.unit == "m/s²"
    for same in (
        response,
        {"poles": [], "zeros": [], "gain": 1, "sensitivity": 2e4, "input_units": "M/S**2"},
    ):
        said = huddle.self_noise(stream(), segment="1s", response=same)
        np.testing.assert_allclose(said.noise_psd, attached.noise_psd, rtol=1e-12)
    by_name = {trace.stats.station: trace for trace in given}
    named = huddle.self_noise(by_name, segment="1s")
    np.testing.assert_array_equal(named.noise_psd, attached.noise_psd)
    removed = given.copy().remove_response(output="VEL", water_level=None)
    result = huddle.self_noise(removed, segment="1s")
    assert result.unit == "m/s"
    assert huddle.self_noise(removed.differentiate(), segment="1s").unit == "m/s²"
    low, high = np.searchsorted(result.frequency, (10, 40))
    omega = 2 * np.pi * result.frequency[low:high, None]
    np.testing.assert_allclose(
        result.data_psd[low:high] * omega**2, attached.data_psd[low:high], rtol=0.05
    )


def test_samples_that_have_a_unit_take_no_response(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "time,A.X [m/s²]\n" + "".join(f"{k / 100},{k % 7}\n" for k in range(300))
    )
    (tmp_path / "pz").write_text(LISTS, encoding="utf-8")
    with pytest.raises(ImportFormatError, match=r"A\.X is in m/s² already; expected no response"):
        huddle.read(tmp_path / "a.csv", response=tmp_path / "pz")
