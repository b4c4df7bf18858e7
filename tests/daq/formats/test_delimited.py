"""CSV as loggers, spreadsheets and people write it: dialects, times, jitter, gaps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.errors import ImportFormatError
from daq.formats.readers.delimited import grid_of, nanoseconds, read_delimited

NOON = 1_795_262_400_000_000_000
"""2026-11-21T12:00:00Z."""

GERMAN = """Messung;Halle 3
Gerät;SIRIUS
Datum;21.11.2026

Zeitstempel;A.X;A.Y;B.X
;m/s²;m/s²;m/s²
21.11.2026 12:00:00,000;0,5;-1,25;1e-3
21.11.2026 12:00:00,010;0,75;;2
21.11.2026 12:00:00,020;1;2,5;3
"""
LABVIEW = """LabVIEW Measurement\t
Writer_Version\t2
Separator\tTab
Decimal_Separator\t.
***End_of_Header***\t
Channels\t2
Samples\t3\t3
X_Value\tA.X\tA.Y\tComment
0.000000\t0.5\t-1.25\t
0.010000\t0.75\t2.0\t
0.020000\t1.0\t2.5\t
"""
LABVIEW_DATED = """LabVIEW Measurement\t
Separator\tTab
X_Columns\tOne
Date\t2026/11/21
Time\t11:59:59.0000000000000000000
***End_of_Header***\t
\t
Channels\t2\t\t
Samples\t3\t3\t
Date\t2026/11/21\t2026/11/21\t
Time\t12:00:00.0000000000000000000\t12:00:00.0000000000000000000\t
Y_Unit_Label\tm/s^2\tm/s^2\t
X_Dimension\tTime\tTime\t
X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t
Delta_X\t1.000000E-2\t1.000000E-2\t
***End_of_Header***\t\t\t
X_Value\tA.X\tA.Y\tComment
0.000000\t0.5\t-1.25\t
0.010000\t0.75\t2.0\t
0.020000\t1.0\t2.5\t
"""
LABVIEW_TIMELESS = LABVIEW_DATED.replace("X_Columns\tOne", "X_Columns\tNo").replace(
    "0.000000\t0.5", "\t0.5"
)
for _time in ("0.010000", "0.020000"):
    LABVIEW_TIMELESS = LABVIEW_TIMELESS.replace(f"\n{_time}\t", "\n\t")
LABVIEW_COMMENTED = LABVIEW_DATED.replace("1.25\t\n", "1.25\tstart\n")
for _cell in ("2.0", "2.5"):  # rows without a comment lack its cell
    LABVIEW_COMMENTED = LABVIEW_COMMENTED.replace(f"{_cell}\t\n", f"{_cell}\n")
PREAMBLE = """Device,ADXL355
Serial,12345
Sample Rate (Hz),100
Start,"2026-11-21 12:00:00"

"t_s","A.X_g","A.Y_g"
0,0.5,-1.25
0.01,0.75,2
0.02,1,2.5
"""
GEOCSV = """# dataset: GeoCSV 2.0
# delimiter: ,
# SID: AM_R1A2B_00_E_N_Z
# sample_rate_hz: 100
# field_unit: UTC, M/S**2
Time, A.X [m/s**2], A.Y [m/s**2]
2026-11-21T12:00:00.000000Z, 0.5, -1.25
2026-11-21T12:00:00.010000Z, 0.75, 2
2026-11-21T12:00:00.020000Z, 1, 2.5
"""
CAMPBELL = """"TOA5","CR6","CR6","1234","CR6.Std.10","CPU:huddle.CR6","777","Fast"
"TIMESTAMP","RECORD","A.X","A.Y"
"TS","RN","mV","mV"
"","","Smp","Smp"
"2026-11-21 12:00:00",0,0.5,-1.25
"2026-11-21 12:00:00.01",1,0.75,2
"2026-11-21 12:00:00.02",2,1,nan
"""
AMERICAN = """Date,Time,A.X (g),A.Y (g)
11/21/2026,12:00:00.000 PM,0.5,-1.25
11/21/2026,12:00:00.010 PM,0.75,2
11/21/2026,12:00:00.020 PM,1,2.5
"""
QUOTED = """"time [ms]","A.X [m/s²]","A.Y [m/s²]"
"1795262400000,0","0,5","-1,25"
"1795262400010,0","0,75","2"
"1795262400020,0","1","2,5"
"""
BLANKS = """# a recorder of our own
# time A.X A.Y
1795262400.000   0.5  -1.25
1795262400.010   0.75  2
1795262400.020   1.0   2.5
"""


@pytest.mark.parametrize(
    ("text", "unit", "date"),
    [
        (GERMAN, "m/s²", NOON),
        (LABVIEW, "counts", 0),
        (LABVIEW_DATED, "m/s^2", NOON),
        (LABVIEW_TIMELESS, "m/s^2", NOON),
        (LABVIEW_COMMENTED, "m/s^2", NOON),
        (PREAMBLE, "g", 0),
        (GEOCSV, "m/s**2", NOON),
        (CAMPBELL, "mV", NOON),
        (AMERICAN, "g", NOON),
        (QUOTED, "m/s²", NOON),
        (BLANKS, "counts", NOON),
    ],
    ids=[
        *("german", "labview", "labview dated", "labview timeless", "labview commented"),
        *("preamble", "geocsv", "campbell", "american", "quoted", "blanks"),
    ],
)
def test_dialects_give_the_same_samples(tmp_path: Path, text: str, unit: str, date: int) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    sensor = read_delimited(path)[0]
    assert (sensor.name, sensor.channels, sensor.units) == ("A", ("X", "Y"), (unit, unit))
    assert sensor.sampling_rate == 100.0
    first = sensor.stretches[0]
    assert first.start_utc_ns == date
    np.testing.assert_array_equal(first.counts[:1], [[0.5, -1.25]])
    last = sensor.stretches[-1]
    if text == GERMAN:  # an empty cell
        np.testing.assert_array_equal(last.counts, [[0.5, -1.25], [0.75, np.nan], [1, 2.5]])
    elif text == CAMPBELL:
        np.testing.assert_array_equal(last.counts, [[0.5, -1.25], [0.75, 2], [1, np.nan]])
    else:
        np.testing.assert_array_equal(last.counts, [[0.5, -1.25], [0.75, 2], [1, 2.5]])


def rows(header: str, *clocks: Callable[[float], str], after: str = "") -> str:
    """Return 40 rows at 100 Hz: clocks, three axes, and what follows."""
    rng = np.random.default_rng(3)
    lines = []
    for k in range(40):
        axes = [f"{value:.6f}" for value in rng.standard_normal(3)]
        lines.append(",".join([*(each(k / 100) for each in clocks), *axes]) + after)
    return "\n".join([header, *lines, ""])


PHONE = rows(
    "time,seconds_elapsed,z,y,x",
    lambda t: f"{NOON + round(t * 1e9)}",
    lambda t: f"{t + 0.0231:.6f}",
)
PHYPHOX = rows(
    '"Time (s)","Linear Acceleration x (m/s^2)","Linear Acceleration y (m/s^2)",'
    '"Linear Acceleration z (m/s^2)","Absolute acceleration (m/s^2)"',
    lambda t: f"{t:.9E}",
    after=",1.5",
)
LOGGER = rows(
    "utc_timestamp,time_ms,ax,ay,az",
    lambda t: f"2026-11-21T12:00:{t:06.3f}Z",
    lambda t: f"{t * 1000:.0f}",
)
UNITS = rows("sampleTime_ms,acc_x_g,acc_y_mg,acc_z_ms2", lambda t: f"{1000 * t:.0f}")
COUNTED = rows("packet,t,T,R,Z", lambda t: f"{500 + 100 * t:.0f}", lambda t: f"{t:.3f}")


@pytest.mark.parametrize(
    ("text", "channels", "units", "start"),
    [
        (PHONE, "z y x", "counts counts counts", NOON),
        (
            PHYPHOX,
            "Linear Acceleration x,Linear Acceleration y,Linear Acceleration z",
            "m/s^2 m/s^2 m/s^2",
            0,
        ),
        (LOGGER, "ax ay az", "counts counts counts", NOON),
        (UNITS, "acc_x acc_y acc_z", "g mg m/s²", 0),
        (COUNTED, "T R Z", "counts counts counts", 0),
    ],
    ids=["Sensor Logger", "phyphox", "two clocks", "units in names", "a counter"],
)
def test_clocks_counters_and_magnitudes_are_no_accelerations(
    tmp_path: Path, text: str, channels: str, units: str, start: int
) -> None:
    path = tmp_path / "phone.csv"
    path.write_text(text, encoding="utf-8")
    (sensor,) = read_delimited(path)
    assert sensor.channels == tuple(channels.split("," if "," in channels else " "))
    assert sensor.units == tuple(units.split())
    assert (sensor.sampling_rate, sensor.stretches[0].start_utc_ns) == (100.0, start)
    samples = np.random.default_rng(3).standard_normal((40, 3)).round(6)
    np.testing.assert_allclose(np.asarray(sensor.stretches[0].counts[:]), samples, atol=1e-6)


def test_columns_are_named_where_a_file_names_none(tmp_path: Path) -> None:
    path = tmp_path / "bare.csv"
    path.write_text(rows("", lambda t: f"{t:.2f}").lstrip(), encoding="utf-8")
    said = r"name them, as in --columns 'time \[s\],X \[m/s²\],Y \[m/s²\],Z \[m/s²\]'"
    with pytest.raises(ImportFormatError, match=said):
        read_delimited(path)
    (sensor,) = read_delimited(path, columns="time [s],A.X [g],A.Y [g],-")
    assert (sensor.name, sensor.channels, sensor.units) == ("A", ("X", "Y"), ("g", "g"))
    with pytest.raises(ImportFormatError, match="--columns names 2 columns; expected 4, as in"):
        read_delimited(path, columns="time,X")


@pytest.mark.parametrize(
    ("cells", "unit", "expected"),
    [
        (["2026-11-21T12:00:00.000000001Z"], "", NOON + 1),
        (["2026-11-21 13:00:00+01:00"], "", NOON),
        (["2026/11/21 07:30:00.5 -0430"], "", NOON + 500_000_000),
        (["21.11.26 12:00"], "", NOON),
        (["11/21/2026 12:00:00 AM"], "", NOON - 43_200_000_000_000),
        (["12:00:01.5"], "", 43_201_500_000_000),
        (["1795262400"], "", NOON),
        (["1795262400.123456789"], "", NOON + 123_456_789),
        (["1795262400000"], "", NOON),
        (["1795262400000000"], "", NOON),
        (["1795262400000000000"], "", NOON),
        (["250"], "ms", 250_000_000),
        (["2.5"], "min", 150_000_000_000),
        (["-1.5e-3"], "s", -1_500_000),
    ],
)
def test_times_are_read_to_the_last_decimal(cells: list[str], unit: str, expected: int) -> None:
    assert nanoseconds(cells, unit, decimal_comma=False).tolist() == [expected]


def test_a_date_that_can_be_two_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,A.X\n05/06/2026 12:00:00,1\n05/06/2026 12:00:01,2\n")
    with pytest.raises(ImportFormatError, match=r"day and month cannot be told apart; expected"):
        read_delimited(path)
    path.write_text("time,A.X\n2026-13-40 12:00:00,1\n2026-13-40 12:00:01,2\n")
    with pytest.raises(ImportFormatError, match=r"a\.csv: "):
        read_delimited(path)


def stamps(
    n: int, rate: float, jitter: NDArray[np.float64], gaps: dict[int, int] | None = None
) -> NDArray[np.int64]:
    """Return stamps of samples at a rate, each late by its jitter in samples."""
    index = np.arange(n)
    for row, missing in (gaps or {}).items():
        index[row:] += missing
    late = np.maximum.accumulate((index + jitter) / rate * 1e9)
    return np.asarray(NOON + np.rint(late), dtype=np.int64)


def exponential(n: int, mean: float) -> NDArray[np.float64]:
    """Return delays of a busy computer, in samples."""
    return np.random.default_rng(5).exponential(mean, n)


def bursts(n: int, size: int) -> NDArray[np.float64]:
    """Return delays of samples that are read `size` at a time, a microsecond apart."""
    k = np.arange(n)
    return size - 1 - k % size + 1e-4 * (k % size)


@pytest.mark.parametrize(
    "jitter",
    [
        np.zeros(20_000),
        np.random.default_rng(1).uniform(-0.4, 0.4, 20_000),
        exponential(20_000, 0.5),
        bursts(20_000, 10),
        bursts(20_002, 7)[:20_000] + np.repeat(exponential(2858, 0.2), 7)[:20_000],
    ],
    ids=["none", "uniform", "late", "bursts", "late bursts"],
)
@pytest.mark.parametrize("gaps", [{}, {7003: 5, 7030: 1, 15_000: 40_000}], ids=["whole", "gaps"])
def test_jitter_gives_neither_a_false_rate_nor_false_gaps(
    jitter: NDArray[np.float64], gaps: dict[int, int]
) -> None:
    times = stamps(20_000, 100.0, jitter, gaps)
    grid = grid_of(times, None)
    assert grid.sampling_rate == 100.0
    begins = np.array([row for row, _ in grid.starts])
    index = np.array([start - grid.starts[0][1] for _, start in grid.starts]) / 1e7
    missing = np.diff(index - begins)
    if float(np.ptp(jitter)) < 1.0:
        assert begins.tolist() == [0, *gaps]
        np.testing.assert_allclose(missing, list(gaps.values()), atol=1e-3)
    else:  # late stamps hide the row of a gap, not how many samples are missing
        for row in begins[1:]:
            assert min(abs(row - gap) for gap in gaps) <= 10
        assert missing.sum() == pytest.approx(sum(gaps.values()), abs=1e-3)
    # All stamps together lie where the samples were, to their common delay.
    assert -0.1 <= (grid.starts[0][1] - NOON) / 1e7 <= np.median(jitter) + 0.1


def test_a_clock_off_its_rate_is_told_from_jitter() -> None:
    n, rate = 200_000, 100.0 * (1 + 30e-6)
    grid = grid_of(stamps(n, rate, exponential(n, 0.5)), None)
    # The error of a line through n stamps that scatter by σ samples: σ √12 / n^1.5.
    assert grid.sampling_rate == pytest.approx(rate, rel=5 * 0.5 * np.sqrt(12) / n**1.5)


def test_stamps_of_whole_seconds_give_the_rate_and_whole_seconds_of_gap() -> None:
    index = np.arange(50_000)
    index[20_050:] += 250
    times = NOON + index // 100 * 1_000_000_000
    grid = grid_of(times, None)
    assert grid.sampling_rate == 100.0
    (_, begin), (row, later) = grid.starts
    assert (later - begin) / 1e7 == pytest.approx(row + 250, abs=1.0)
    assert grid.left_out == [(20_000, 20_050)] or len(grid.left_out) == 1


def test_a_slow_logger_keeps_its_interval() -> None:
    grid = grid_of(NOON + np.arange(100) * 10_000_000_000, None)
    assert (grid.sampling_rate, len(grid.starts)) == (0.1, 1)
