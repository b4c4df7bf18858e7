"""Tables of the bench file for unattended use: schedule, storage, hooks, metrics, pages."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from typing import Annotated, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from cronsim import CronSim, CronSimError
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from daq.bench.end_condition import EndCondition
from daq.bench.tables.fields import BenchTable, Duration, Name, PositiveNumber

_BYTES = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
_SIZE = re.compile(r"(\d+(?:\.\d*)?)\s*([a-z]*)", re.ASCII)


def _cron_line(value: str) -> str:
    try:
        CronSim(value, datetime(2026, 1, 1, tzinfo=UTC))
    except CronSimError as error:
        raise ValueError(
            'expected a cron line "minute hour day month weekday", such as "0 22 * * 1-5"'
            f" ({error})"
        ) from None
    return value


def _time_zone(value: str) -> str:
    try:
        ZoneInfo(value)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError('expected a time zone such as "UTC" or "Europe/Berlin"') from None
    return value


def parse_size(value: str | float) -> int:
    """Return a size in bytes: ``500 MB``, ``2.5GB``; a bare number is bytes.

    Raises
    ------
    ValueError
        If it is none; the message says what was expected.
    """
    numeric = isinstance(value, (int, float)) and not isinstance(value, bool)
    found = _SIZE.fullmatch(str(value).strip().lower()) if not numeric else None
    if numeric and 0 <= float(value) < 1e18:
        return int(value)
    if found is None or found[2] not in _BYTES or float(found[1]) * _BYTES[found[2]] > 1e18:
        raise ValueError('expected a size such as "500 MB" or "2 GB"')
    return round(float(found[1]) * _BYTES[found[2]])


def _address(value: str) -> str:
    try:
        ipaddress.ip_address(value)
    except ValueError:
        raise ValueError('expected an IP address such as "127.0.0.1"') from None
    return value


CronLine = Annotated[str, AfterValidator(_cron_line)]
TimeZone = Annotated[str, AfterValidator(_time_zone)]
Size = Annotated[int, BeforeValidator(parse_size)]
Command = Annotated[tuple[str, ...], Field(min_length=1, description="a program and its arguments")]


class ScheduledRun(BenchTable):
    """One ``[[schedule]]`` table: when runs are due, and how long they record."""

    name: Name = "runs"
    """In lists of runs; its times, such as ``daily 22:00``, if not given."""
    cron: CronLine | None = None
    """When runs are due, such as ``0 22 * * *``; or ``at``."""
    at: datetime | None = None
    """One run at this time."""
    time_zone: TimeZone | None = None
    """Of the times, such as ``UTC`` or ``Europe/Berlin``."""
    duration: Duration | None = None
    """In seconds; that of ``[recording]`` where neither this nor `longest` is given."""
    target_cov: Annotated[float, Field(strict=True, gt=0, lt=1)] | None = None
    """Coefficient of variation at which the run ends."""
    until: Literal["decided"] | None = None
    """The run ends once all limits are met, or one is not."""
    longest: Duration | None = None
    """Seconds after which a run with `target_cov` or `until` ends at the latest."""
    when_busy: Literal["skip", "queue"] = "skip"
    """What becomes of a run that is due while another one records."""

    @model_validator(mode="after")
    def _is_complete(self) -> ScheduledRun:
        if (self.cron is None) == (self.at is None):
            raise ValueError('expected either cron = "0 22 * * *" or at = 2026-12-01T22:00:00')
        is_local = self.at is None or self.at.tzinfo is None
        if is_local and self.time_zone is None:
            raise ValueError('time_zone is missing; expected one such as "UTC" or "Europe/Berlin"')
        if self.duration is not None and self.end.is_estimated:
            raise ValueError("expected duration, or target_cov or until with longest; not both")
        if self.end.is_estimated != (self.longest is not None):
            raise ValueError('expected target_cov or until = "decided" together with longest')
        return self

    @property
    def end(self) -> EndCondition:
        """What ends the run by its live estimate."""
        return EndCondition(cov=self.target_cov, decided=self.until == "decided")

    @property
    def zone(self) -> ZoneInfo:
        """The time zone of the entry; UTC where `at` has an offset of its own."""
        return ZoneInfo(self.time_zone or "UTC")


_DAILY = re.compile(r"(\d{1,2}) (\d{1,2}) \* \* (\S+)")
_LONGEST_NAME = 40
_DAYS = ("Sun", "Mon", "Tue", "Wed", "Thu", "Fri", "Sat")


def _name_of(run: Mapping[str, object], taken: Collection[str]) -> str:
    """Return a name that says when a run is due: ``daily 22:00``, or its cron line; a free one."""
    at, cron = run.get("at"), " ".join(str(run.get("cron", "")).split())
    name = f"cron {cron}".replace("/", "÷")[:_LONGEST_NAME]
    if found := _DAILY.fullmatch(cron):
        minute, hour, days = found.groups()
        time = f"{int(hour):02}:{int(minute):02}"
        name = f"daily {time}" if days == "*" else f"{time} on {_in_words(days)}"
    elif at is not None:
        name = f"at {at:%Y-%m-%d %H:%M}" if isinstance(at, datetime) else f"at {at}"
        name = name.replace("/", "÷")[:_LONGEST_NAME]
    free = (name, *(f"{name} ({number})" for number in range(2, 1000)))
    return next(each for each in free if each not in taken)


def _in_words(days: str) -> str:
    """Return days of the week of a cron line by their names: ``Mon-Fri``."""
    named = re.sub(r"\d", lambda found: _DAYS[int(found[0]) % 7], days)
    return named.replace("/", "÷")[:_LONGEST_NAME]


class Schedule(BenchTable):
    """When ``huddle serve`` starts a run: ``[[schedule]]`` tables, or cron lines in one table."""

    cron: tuple[CronLine, ...] = ()
    time_zone: TimeZone = "UTC"
    runs: tuple[ScheduledRun, ...] = ()
    """The ``[[schedule]]`` tables."""

    @model_validator(mode="before")
    @classmethod
    def _name_all(cls, table: object) -> object:
        """Take a list as `runs`, and name those that have no name by their times."""
        table = {"runs": table} if isinstance(table, (list, tuple)) else table
        if not isinstance(table, dict) or not isinstance(table.get("runs"), (list, tuple)):
            return table
        named: list[object] = []
        taken: set[str] = set()
        for run in table["runs"]:
            given = {"name": _name_of(run, taken), **run} if isinstance(run, dict) else run
            taken |= {str(given["name"])} if isinstance(given, dict) else set()
            named.append(given)
        return table | {"runs": named}

    @model_validator(mode="after")
    def _names_differ(self) -> Schedule:
        names = [run.name for run in self.runs]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two entries have the name {twice!r}; expected names that differ")
        return self

    @property
    def entries(self) -> tuple[ScheduledRun, ...]:
        """All entries, the cron lines of the one table included."""
        taken = {run.name for run in self.runs}
        lines = []
        for line in self.cron:
            name = _name_of({"cron": line}, taken)
            taken.add(name)
            lines.append(ScheduledRun(name=name, cron=line, time_zone=self.time_zone))
        return (*lines, *self.runs)

    @property
    def named_zone(self) -> str:
        """The time zone of the bench: the first that is not UTC, or UTC."""
        zones = [self.time_zone, *(run.time_zone for run in self.runs if run.time_zone)]
        return next((zone for zone in zones if zone != "UTC"), "UTC")


class Storage(BenchTable):
    """What ``huddle serve`` keeps; without limits, every run for ever."""

    keep_for: Duration | None = None
    """Seconds after which a run is removed."""
    keep_runs: Annotated[int, Field(strict=True, ge=1)] | None = None
    """Number of the newest runs that are kept."""
    keep_free: Size | None = None
    """Bytes of free space for which the oldest runs are removed."""
    min_free: Size = 500 * 10**6
    """Bytes of free space below which no run starts and a running one is closed."""


class Hooks(BenchTable):
    """Commands of ``huddle serve``, given a JSON document on standard input."""

    on_finished: Command | None = None
    """A run has its result, whatever the verdict."""
    on_limit: Command | None = None
    """A limit is not met."""
    on_failed: Command | None = None
    """A run has no result."""
    on_missed: Command | None = None
    """A run was due and not started."""
    timeout: Duration = 30.0
    """After which a command is ended, and has failed."""
    retries: Annotated[int, Field(strict=True, ge=0, le=20)] = 3
    """Further attempts after one that failed."""
    retry_after: Duration = 60.0
    """Seconds between attempts, doubled after each."""


class Metrics(BenchTable):
    """Prometheus metrics of ``huddle serve``."""

    port: Annotated[int, Field(strict=True, ge=0, le=65535)]
    """TCP port of the metrics."""
    address: Annotated[str, AfterValidator(_address)] = "127.0.0.1"
    """Address on which it is served."""


def _secret(value: str) -> str:
    if _SECRET.fullmatch(value) is None:
        raise ValueError(
            "expected a line that huddle web --password or huddle web --token prints, or the name"
            ' of a variable of the environment with a token, such as "${HUDDLE_WEB_TOKEN}"'
        )
    return value


_SECRET = re.compile(r"scrypt:[0-9a-f]{32}:[0-9a-f]{64}|sha256:[0-9a-f]{64}|\$\{[A-Za-z_]\w*\}")
Secret = Annotated[str, AfterValidator(_secret)]
"""Hash of a password or of a token, or the variable of the environment that holds a token."""


class Web(BenchTable):
    """The pages of the bench in a browser: ``huddle web``, and beside ``huddle serve``."""

    port: Annotated[int, Field(strict=True, ge=0, le=65535)] = 8040
    """TCP port of the pages."""
    address: Annotated[str, AfterValidator(_address)] = "127.0.0.1"
    """Address on which they are served."""
    read: Secret | None = None
    """Who may look; anybody on this computer where it is not given."""
    steer: Secret | None = None
    """Who may also start, stop, mark and confirm; nobody where it is not given."""
    hosts: tuple[str, ...] = ()
    """Further names of this computer in addresses of the pages, as behind a reverse proxy."""
    proxies: tuple[Annotated[str, AfterValidator(_address)], ...] = ()
    """Addresses of reverse proxies, which state visitors in X-Forwarded-For; nobody else may."""
    insecure: bool = False
    """Whether passwords and pages may cross the network in clear text."""
    certificate: Annotated[str, Field(min_length=1)] | None = None
    """Absolute path of a TLS certificate (PEM)."""
    key: Annotated[str, Field(min_length=1)] | None = None
    """Absolute path of its private key."""
    archive: Annotated[str, Field(min_length=1)] | None = None
    """Folder of an archive that the pages show; relative to the bench file."""

    @model_validator(mode="after")
    def _is_safe(self) -> Web:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("expected certificate and key, or neither")
        self.check_address(self.address)
        return self

    def check_address(self, address: str) -> None:
        """Refuse an address that other computers reach, if anybody could look there.

        Raises
        ------
        ValueError
            Saying what is missing.
        """
        if self.read is None and not ipaddress.ip_address(address).is_loopback:
            raise ValueError(
                f"address {address}: other computers reach it; expected read = a line that huddle"
                " web --password or huddle web --token prints"
            )
        is_far = not ipaddress.ip_address(address).is_loopback
        if is_far and self.certificate is None and not self.insecure:
            raise ValueError(
                f"address {address}: passwords would cross the network in clear text; expected"
                " certificate and key, or insecure = true (--insecure) where nobody can listen"
            )


class Signing(BenchTable):
    """How recordings are signed when they are closed."""

    key: Annotated[str, Field(min_length=1)]
    """Absolute path of a private key; ``${NAME}`` is a variable of the environment."""


class History(BenchTable):
    """What ``huddle serve`` keeps of each run for ``huddle history``."""

    bands: tuple[tuple[PositiveNumber, PositiveNumber], ...] = ()
    """Bands in Hz whose noise is kept, beside the band of the estimate."""
