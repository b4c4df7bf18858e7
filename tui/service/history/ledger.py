"""The ledger of sensors: what every test on any bench found of the sensors with a serial number.

An SQLite file of the user, not of a bench: in ``$XDG_DATA_HOME/huddle``, or where
``HUDDLE_SENSORS`` says (``off``: nowhere). `record_test` adds a test at its end; a test is there
once.
"""

from __future__ import annotations

import json
import logging
import math
import os
import sqlite3
from contextlib import closing
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.bench.units import decibels
from daq.caveats import Caveats
from daq.errors import HuddleError
from daq.recording.reader import Recording
from daq.results.band_summary import CONSTANT, known_range
from estimator.errors import BandError
from tui.service.records.run_state import RecordedNoise, utc_text
from tui.wording.formatting import drift_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from daq.recording.sensor_record import SensorRecord
    from daq.results.decision.verdict import TestVerdict
    from daq.results.result import Result
    from tui.service.history.series import Found

_LOGGER = logging.getLogger(__name__)
OCTAVES = tuple((2.0**k, 2.0 ** (k + 1)) for k in range(-4, 9))
"""Bands in Hz that tests of different benches have in common."""
OFF = "off"
_TABLES = """
CREATE TABLE IF NOT EXISTS tests (
    run_id TEXT PRIMARY KEY, recording TEXT, bench TEXT, started REAL, caveats TEXT);
CREATE TABLE IF NOT EXISTS sensors (
    run_id TEXT, serial_number TEXT, sensor TEXT, model TEXT, temperature REAL,
    sensitivities TEXT, limits TEXT, firmware TEXT, PRIMARY KEY (serial_number, run_id));
CREATE TABLE IF NOT EXISTS noise (
    run_id TEXT, started REAL, caveats TEXT, sensor TEXT, model TEXT, serial_number TEXT,
    channel TEXT, unit TEXT, method TEXT, low_hz REAL, high_hz REAL, psd REAL, low REAL, high REAL);
CREATE INDEX IF NOT EXISTS noise_of ON noise (serial_number, started);
"""
_NOISE = "sensor, model, serial_number, channel, unit, method, low_hz, high_hz, psd, low, high"
_ADD_NOISE = "INSERT INTO noise VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
_LIKE = (
    "serial_number = ? AND started <= ? AND caveats = ? AND 0 < low AND low <= psd AND psd <= high"
)
_GROUPS = (
    "SELECT unit, method, low_hz, high_hz, COUNT(DISTINCT run_id) AS n, MIN(started) AS since"  # noqa: S608 - our own words
    f" FROM noise WHERE {_LIKE} GROUP BY unit, method, low_hz, high_hz"
    " HAVING n > 1 AND MAX(started) = ? ORDER BY n DESC, high_hz / low_hz DESC LIMIT 1"
)
_ENDS = (
    f"SELECT channel, psd, low, high FROM noise WHERE {_LIKE} AND unit = ?"  # noqa: S608
    " AND method = ? AND low_hz = ? AND high_hz = ? AND started IN (?, ?) ORDER BY started"
)
_OF_SENSOR = (
    f"SELECT bench, noise.started, noise.caveats, {_NOISE} FROM noise JOIN tests"  # noqa: S608
    " USING (run_id) WHERE serial_number = ? ORDER BY noise.started"
)

_TESTS = (
    "SELECT started, bench, recording, sensor, model, firmware, temperature, sensitivities,"
    " limits, tests.caveats FROM sensors JOIN tests USING (run_id) WHERE serial_number = ?"
    " ORDER BY started"
)


@dataclass(frozen=True, slots=True)
class Drift:
    """By how much the noise of a sensor differs from that of its first test.

    Attributes
    ----------
    sensor, serial_number : str
    db, error : float
        Mean of its channels, and half of the 95 % interval.
    since : datetime
    n_tests : int
        With this one.
    low_hz, high_hz : float
    """

    sensor: str
    serial_number: str
    db: float
    error: float
    since: datetime
    n_tests: int
    low_hz: float
    high_hz: float


@dataclass(frozen=True, slots=True)
class SensorTest:
    """One test of a sensor, on any bench.

    Attributes
    ----------
    started : datetime
    bench, recording, sensor, model, firmware : str
    temperature : float or None
        In °C at the start.
    sensitivities : mapping of str to float
        Counts per unit, by channel.
    limits : sequence of (str, str, str, float or None)
        Channel, limit, verdict and margin in dB.
    caveats : Caveats
    """

    started: datetime
    bench: str
    recording: str
    sensor: str
    model: str
    firmware: str
    temperature: float | None
    sensitivities: Mapping[str, float]
    limits: Sequence[tuple[str, str, str, float | None]]
    caveats: Caveats

    def document(self) -> dict[str, Any]:
        """Return the test for JSON."""
        own = {each.name: getattr(self, each.name) for each in fields(self)} | self.caveats.keys
        del own["caveats"]
        keys = ("channel", "limit", "verdict", "margin_db")
        limits = [dict(zip(keys, each, strict=True)) for each in self.limits]
        return own | {"started": utc_text(self.started), "limits": limits}


def ledger_path() -> Path | None:
    """Return where the ledger is; None where there is to be none."""
    if named := os.environ.get("HUDDLE_SENSORS"):
        return None if named == OFF else Path(named)
    home = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(home) / "huddle" / "sensors.sqlite"


def band_noise(
    result: Result,
    bands: Iterable[tuple[float, float]],
    about: Mapping[str, tuple[str, str]],
    notes: list[str],
) -> tuple[RecordedNoise, ...]:
    """Return the noise of every channel in the band of a test, and in others.

    To be compared with other tests of the sensors: without what is known of their sensitivities.

    Parameters
    ----------
    about : mapping
        Model and serial number of each sensor.
    notes : list of str
        Takes why a band has none.
    """
    snapshot = result.snapshot
    method, found = result.method, []
    if method not in snapshot.results:
        return ()
    for band in dict.fromkeys([result.band, *bands]):
        try:
            means = result.means(method, band, without=CONSTANT)
        except BandError as error:
            notes.append(f"no noise for the history: {error}")
            continue
        for label, each in zip(snapshot.channels, means, strict=True):
            values = (float(each.estimate[0]), float(each.low[0]), float(each.high[0]))
            model, serial_number = about.get(label.sensor, ("", ""))
            own = (label.sensor, model, serial_number, label.channel, label.unit)
            found.append(RecordedNoise(*own, method, float(band[0]), float(band[1]), *values))
    return tuple(found)


def record_test(path: Path, result: Result) -> list[Drift]:
    """Add a test to the ledger; return how its sensors differ from their first tests.

    Raises
    ------
    HuddleError, OSError, sqlite3.Error
        If the recording cannot be read, or the ledger not be written.
    """
    snapshot = result.snapshot
    place = ledger_path()
    if place is None:
        return []
    with Recording.open(path) as recording:
        bench, run_id = recording.bench, recording.run_id
        started = recording.created_at.utc_ns * 1e-9
        known = {each.name: each for each in recording.sensors if each.serial_number}
        rows = [_sensor_row(run_id, each, result.verdict) for each in known.values()]
    if not known:
        return []
    about = {name: (each.model, each.serial_number) for name, each in known.items()}
    low, high = known_range(snapshot)[0], float(snapshot.frequency[-2])
    octaves = [each for each in OCTAVES if low <= each[0] and each[1] <= high]
    caveats = snapshot.caveats.after()
    noise = [
        (run_id, started, caveats, *_values(each))
        for each in band_noise(result, octaves, about, [])
        if each.serial_number
    ]
    test = run_id, path.name, "" if bench is None else bench.name, started, caveats
    place.parent.mkdir(parents=True, exist_ok=True)
    with closing(sqlite3.connect(place, timeout=10.0)) as ledger:
        ledger.executescript(_TABLES)
        with ledger:  # all of a test, or nothing
            ledger.execute("BEGIN IMMEDIATE")
            added = ledger.execute("INSERT OR IGNORE INTO tests VALUES (?, ?, ?, ?, ?)", test)
            if added.rowcount:
                ledger.executemany("INSERT INTO sensors VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
                ledger.executemany(_ADD_NOISE, noise)
        found = [
            _drift(ledger, name, (serial, started, caveats)) for name, (_, serial) in about.items()
        ]
    return [each for each in found if each is not None]


def _sensor_row(run_id: str, each: SensorRecord, verdict: TestVerdict | None) -> tuple[Any, ...]:
    limits = [
        (result.channel, result.limit, str(result.verdict), result.margin_db)
        for result in (() if verdict is None else verdict.limits)
        if result.sensor == each.name
    ]
    sensitivities = {c.name: c.sensitivity for c in each.channels if not c.auxiliary}
    own = run_id, each.serial_number, each.name, each.model, each.temperature
    return (*own, json.dumps(sensitivities), json.dumps(limits), each.firmware)


def _values(noise: RecordedNoise) -> tuple[Any, ...]:
    return tuple(getattr(noise, name) for name in _NOISE.split(", "))


def _drift(ledger: sqlite3.Connection, sensor: str, like: tuple[str, float, str]) -> Drift | None:
    """Return the drift of a sensor in the band with most tests, the widest of these.

    None at its first test. `like` are serial number, time and caveats of the test: tests are
    compared with their like only.
    """
    serial, started, _ = like
    groups = ledger.execute(_GROUPS, (*like, started)).fetchone()
    if groups is None:
        return None
    *group, n_tests, since = groups
    rows = ledger.execute(_ENDS, (*like, *group, since, started)).fetchall()
    tests: dict[str, list[tuple[float, float, float]]] = {}
    for channel, *levels in rows:
        tests.setdefault(channel, []).append((levels[0], levels[1], levels[2]))
    pairs = [each for each in tests.values() if len(each) == 2]
    if not pairs:
        return None
    shift = sum(decibels(last[0]) - decibels(first[0]) for first, last in pairs) / len(pairs)
    error = math.hypot(*(_error_db(*each) for pair in pairs for each in pair)) / len(pairs)
    begun = datetime.fromtimestamp(since, UTC)
    return Drift(sensor, serial, shift, error, begun, n_tests, group[2], group[3])


def _error_db(psd: float, low: float, high: float) -> float:
    """Return half of the 95 % interval in dB, of its wider side."""
    return max(decibels(high) - decibels(psd), decibels(psd) - decibels(low))


def _rows(question: str, serial_number: str) -> list[Any]:
    """Return what the ledger says of a sensor; nothing, if there is no ledger."""
    place = ledger_path()
    if place is None or not place.exists():
        return []
    with closing(sqlite3.connect(f"{place.resolve().as_uri()}?mode=ro", uri=True)) as ledger:
        return ledger.execute(question, (serial_number,)).fetchall()


def sensor_tests(serial_number: str) -> list[SensorTest]:
    """Return the tests of a sensor, oldest first; real ones, if there are any.

    Raises
    ------
    sqlite3.Error
        If the ledger cannot be read.
    """
    rows = _rows(_TESTS, serial_number)
    found = [
        SensorTest(
            datetime.fromtimestamp(row[0], UTC),
            *(row[1], row[2], row[3], row[4]),
            firmware=row[5] or "",
            temperature=row[6],
            sensitivities=json.loads(row[7]),
            limits=tuple(tuple(each) for each in json.loads(row[8])),
            caveats=_caveats(row[9]),
        )
        for row in rows
    ]
    all_have = all(each.caveats for each in found)
    return [each for each in found if bool(each.caveats) is all_have]


def _caveats(names: str) -> Caveats:
    """Return caveats by their names."""
    return Caveats.of(dict.fromkeys(names.split(", "), True))


def noise_of(serial_number: str) -> list[Found]:
    """Return bench, time and noise of the tests of a sensor; real ones, if there are any.

    Raises
    ------
    sqlite3.Error
        If the ledger cannot be read.
    """
    rows = _rows(_OF_SENSOR, serial_number)
    all_have = all(row[2] for row in rows)
    return [
        (bench, datetime.fromtimestamp(started, UTC), RecordedNoise.of(*values), _caveats(mark))
        for bench, started, mark, *values in rows
        if bool(mark) is all_have
    ]


def noted(path: Path, result: Result) -> list[str]:
    """Add a test to the ledger; return a sentence on each sensor that it has had before.

    A ledger that cannot be written spoils no test: it is logged.
    """
    try:
        found = record_test(path, result)
    except (HuddleError, OSError, sqlite3.Error) as error:
        _LOGGER.warning("the ledger of sensors has not got this test: %s", error)
        return []
    return [
        drift_line(
            f"{each.sensor} {each.serial_number}",
            (each.db, each.error),
            since=each.since,
            n_tests=each.n_tests,
            band=(each.low_hz, each.high_hz),
        )
        for each in found
    ]
