"""Faults of simulated devices, from a fault script.

The script is a list of tables: ``[[faults]]`` in a TOML file, or under ``[simulation]`` of a bench
file::

    [[faults]]
    kind = "corrupt"        # see below
    sensors = ["A"]         # devices of these sensors (default: all)
    at = 12.0               # world time of the first occurrence, s
    every = 30.0            # period of repetition, s (default: once)
    spread = 20.0           # each occurrence is later by up to this, at random (default: 0 s)
    count = 3               # bytes, frames or samples

Kinds that affect the next unit (frame, packet, reply) of a device, in every family:

========== ==========================================================================
drop       ``count`` units are not sent
cut        ``count`` bytes are removed from the middle of a unit
corrupt    ``count`` bytes of a unit are changed
checksum   one bit of a unit's last byte but one is changed, usually in its checksum
garbage    ``count`` random bytes are sent before a unit
duplicate  a unit is sent ``1 + count`` times
merge      the first half of a unit is followed by the second half of the next
late       a unit, and all later ones, are delayed by ``duration`` s
========== ==========================================================================

Kinds that last ``duration`` s:

========== ==========================================================================
jitter     each unit is delayed by up to ``level`` s
latency    each unit is delayed by an exponential time with mean ``level`` s
batching   units are sent only every ``level`` s, as through a polled USB adapter
stall      the device sends nothing; its samples are lost
pause      the device sends nothing; afterwards it sends its buffer of ``level`` s (all samples,
           without ``level``)
disconnect the cable is unplugged, and plugged in again
silent     one unit of a bus is off, and restarts afterwards
clip       samples end at ± ``level`` counts (of ``channel``, or of all)
dead       samples are 0 (of ``channel``, or of all)
moved      the sensor is on another floor, with a motion of its own; so are all that are moved
========== ==========================================================================

Kinds that the device's counter does not show:

========== ==========================================================================
skip       ``count`` samples are neither sent nor counted
repeat     the last ``count`` samples are sent and counted again, as new ones
coarse     stated UTC is rounded down to steps of ``level`` s, for the whole run
========== ==========================================================================

Others: ``spike`` adds ``level`` counts to one sample; ``reset`` restarts the device; ``wrap`` makes
its counter wrap ``at`` seconds after the start of sampling (of SeedLink: its sequence numbers);
``overflow`` overflows the buffer of the device for ``duration``. The last three apply only to
devices with this function.

Random numbers depend only on ``seed``: a script has the same effect in every run. A wandering or
wrong clock is not a fault but a property of the sensor: ``clock`` in the scenario.
"""

from __future__ import annotations

import heapq
import itertools
import math
import zlib
from collections import deque
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from sim_devices.errors import ScenarioError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray
    from pydantic_core import ErrorDetails

    from sim_devices.arrays import FloatArray

Kind: TypeAlias = Literal[
    "drop", "cut", "corrupt", "checksum", "garbage", "duplicate", "merge", "late",
    "jitter", "latency", "batching", "stall", "pause", "disconnect", "silent",
    "clip", "dead", "spike", "moved", "skip", "repeat", "coarse",
    "reset", "wrap", "overflow",
]  # fmt: skip
DELAYS = ("jitter", "latency", "batching")
LASTING = (*DELAYS, "stall", "pause", "disconnect")
UNIT_KINDS = ("drop", "cut", "corrupt", "checksum", "garbage", "duplicate", "merge", "late")
SAMPLE_KINDS = ("clip", "dead", "spike")
SLIPS = ("skip", "repeat")
"""Kinds after which the device's counter is wrong."""
PATIENCE = 1.0
"""Seconds after which a fault expires if no unit is sent."""


class Fault(BaseModel):
    """One entry of a fault script."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Kind
    at: NonNegativeFloat
    every: PositiveFloat | None = None
    spread: NonNegativeFloat = 0.0
    sensors: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    count: PositiveInt = 1
    duration: NonNegativeFloat = 1.0
    level: float = 0.0
    channel: NonNegativeInt | None = None
    seed: int = 0

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if self.kind in (*DELAYS, "coarse") and self.level <= 0:
            raise ValueError(f"{self.kind} has level {self.level:g}; expected seconds above 0")
        if self.spread and (self.kind in (*SAMPLE_KINDS, "silent", "moved", "coarse")):
            raise ValueError(f"{self.kind} has spread {self.spread:g}; expected none")
        if self.every is not None and self.spread > self.every:
            raise ValueError(f"spread {self.spread:g}; expected at most every, {self.every:g}")
        return self

    def times(self, begin: float = 0.0, *, name: str = "") -> Iterator[float]:
        """Yield the world times of the fault in s, from ``begin`` on.

        Random delays (``spread``) differ from device to device, by their ``name``.
        """
        repetitions: Iterable[int] = range(1)
        if self.every is not None:
            first = max(0, math.ceil((begin - self.spread - self.at) / self.every))
            repetitions = itertools.count(first)
        for k in repetitions:
            at = self.at + k * (self.every or 0.0)
            if self.spread:
                rng = np.random.default_rng([self.seed, k, zlib.crc32(name.encode())])
                at += float(rng.uniform(0, self.spread))
            if at >= begin:
                yield at

    def is_on(self, times: FloatArray) -> NDArray[np.bool_]:
        """Return whether a lasting fault is on at world ``times`` (n,)."""
        since = times - self.at
        return (since >= 0) & (np.mod(since, self.every or math.inf) < self.duration)

    def is_of(self, sensor: str) -> bool:
        """Return whether the fault affects a sensor."""
        return self.sensors is None or sensor in self.sensors


_SCRIPT = TypeAdapter(list[Fault])


def parse(script: Any, sensors: Sequence[str] | None = None) -> tuple[Fault, ...]:  # noqa: ANN401 -- what a file says
    """Read a fault script.

    Parameters
    ----------
    script
        A list of tables, as in a TOML file's ``[[faults]]``.
    sensors
        Return only faults of these sensors.

    Raises
    ------
    ScenarioError
        With every wrong key, its value and the expectation.
    """
    try:
        faults = _SCRIPT.validate_python(script)
    except ValidationError as error:
        raise ScenarioError(*map(_problem, error.errors(include_url=False))) from error
    if sensors is None:
        return tuple(faults)
    return tuple(f for f in faults if f.sensors is None or set(f.sensors) & set(sensors))


def _problem(fault: ErrorDetails) -> str:
    place = "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key}" for key in fault["loc"])
    expected = fault["msg"]
    if fault["type"] == "list_type":
        expected = "expected a list of tables, [[faults]]"
    elif fault["type"] == "extra_forbidden":
        expected = f"unknown key; expected {', '.join(Fault.model_fields)}"
    return f"faults{place} = {fault['input']!r}: {expected}"


def check(faults: Sequence[Fault], n_channels: Mapping[str, int]) -> None:
    """Check sensors and channels of a script, given the number of channels of each sensor.

    Raises
    ------
    ScenarioError
        With every unknown sensor and channel, and the known ones.
    """
    wrong = []  # numbered from 1, as in other errors of bench files
    for number, fault in enumerate(faults, 1):
        place, named = f"faults[{number}]", fault.sensors or ()
        wrong += [
            f"{place}.sensors = {name!r}: unknown sensor; expected {', '.join(n_channels)}"
            for name in named
            if name not in n_channels
        ]
        counts = [n_channels[name] for name in named if name in n_channels]
        least = min(counts, default=math.inf) if named else max(n_channels.values())
        if fault.channel is not None and fault.channel >= least:
            wrong.append(f"{place}.channel = {fault.channel}: expected 0 to {least - 1}")
    if wrong:
        raise ScenarioError(*wrong)


def _slips_of(fault: Fault, sensor: str) -> Iterator[tuple[float, int]]:
    n_skipped = fault.count if fault.kind == "skip" else -fault.count
    return ((at, n_skipped) for at in fault.times(name=sensor))


class SampleFaults:
    """Faults that change samples before the device sends them."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self._faults = [fault for fault in faults if fault.kind in SAMPLE_KINDS]
        self._silences = [fault for fault in faults if fault.kind == "silent"]
        self._moves = [fault for fault in faults if fault.kind == "moved"]
        self._slips = [fault for fault in faults if fault.kind in SLIPS]
        self._coarse = [fault for fault in faults if fault.kind == "coarse"]

    def slips(self, sensor: str) -> Iterator[tuple[float, int]]:
        """Yield the world time of each slip of a sensor's counter, and the samples it skips.

        Negative numbers are samples that are counted again.
        """
        return heapq.merge(*(_slips_of(one, sensor) for one in self._slips if one.is_of(sensor)))

    def stated_ns(self, sensor: str, utc_ns: int) -> int:
        """Return the UTC in ns that a device states."""
        for fault in self._coarse:
            if fault.is_of(sensor):
                step = round(fault.level * 1e9)
                utc_ns = utc_ns // step * step
        return utc_ns

    def is_moved(self, sensor: str, times: FloatArray) -> NDArray[np.bool_]:
        """Return where a sensor is on another floor at world ``times`` (n,)."""
        moved = np.zeros(times.shape, dtype=bool)
        for fault in self._moves:
            if fault.is_of(sensor):
                moved |= fault.is_on(times)
        return moved

    def is_silent(self, sensor: str, now: float) -> bool:
        """Return whether the device of a sensor is off at world time ``now``."""
        at = np.array([now])
        return any(fault.is_of(sensor) and bool(fault.is_on(at)) for fault in self._silences)

    def apply(
        self, sensor: str, counts: NDArray[np.float64], times: FloatArray
    ) -> NDArray[np.float64]:
        """Return counts (n, n_channels), sampled at world ``times`` (n,), with the faults."""
        for fault in self._faults:
            if not fault.is_of(sensor):
                continue
            columns = slice(None)
            if fault.channel is not None:
                columns = slice(fault.channel, fault.channel + 1)
            struck = fault.is_on(times)
            if fault.kind == "spike":  # the first sample at or after each time
                since, period = times - fault.at, fault.every or math.inf
                step = times[1] - times[0] if times.size > 1 else 0.0
                around = np.append(since[0] - step, since)
                strikes = np.where(around < 0, -1.0, np.floor(around / period))
                struck = np.diff(strikes) > 0
                counts[struck, columns] += fault.level
            elif fault.kind == "dead":
                counts[struck, columns] = 0.0
            else:
                counts[struck, columns] = np.clip(
                    counts[struck, columns], -fault.level, fault.level
                )
        return counts


class LineFaults:
    """Faults of one line: of its units, and of the line itself.

    :meth:`next_due` is the time of the next action, :meth:`act` performs due actions, and all sent
    units pass through :meth:`send`.
    """

    def __init__(self, faults: Sequence[Fault], name: str, *, begin: float = 0.0) -> None:
        self._rng = np.random.default_rng(
            [zlib.crc32(name.encode()), *(fault.seed for fault in faults)]
        )
        self._schedule: list[tuple[float, int, Fault, Iterator[float]]] = []
        for index, fault in enumerate(faults):
            if fault.kind not in (*SAMPLE_KINDS, *SLIPS, "moved", "silent", "wrap", "coarse"):
                # lasting faults may have begun before the device started
                times = fault.times(begin - fault.duration * (fault.kind in LASTING), name=name)
                first = next(times, None)
                if first is not None:
                    self._schedule.append((first, index, fault, times))
        heapq.heapify(self._schedule)
        self._armed: deque[tuple[float, Fault]] = deque()
        self._half = b""  # the first half of a unit to be merged with the next
        self._held: deque[tuple[float, bytes]] = deque()
        self._silent_until = self._delayed_until = -math.inf
        self._paused_until = self._full_at = -math.inf
        self._delay: Fault | None = None
        self._phase = self._rng.uniform()  # of an adapter's polls, in poll intervals
        self.down_until = -math.inf
        """World time until which the cable is unplugged."""
        self.struck: list[tuple[float, Fault]] = []
        """Times and faults that occurred since this list was last cleared."""

    def next_due(self) -> float:
        """Return the world time of the next action: a fault, or a delayed unit."""
        return min(
            self._schedule[0][0] if self._schedule else math.inf,
            self._held[0][0] if self._held else math.inf,
        )

    def act(self, now: float) -> tuple[list[Fault], list[bytes]]:
        """Perform due faults; return actions of line and device, and units to send now."""
        outside = []
        while self._schedule and self._schedule[0][0] <= now:
            at, index, fault, times = heapq.heappop(self._schedule)
            following = next(times, None)
            if following is not None:
                heapq.heappush(self._schedule, (following, index, fault, times))
            if fault.kind in UNIT_KINDS:
                units = fault.count if fault.kind == "drop" else 1
                self._armed.extend([(at + PATIENCE, fault)] * units)
                continue
            self.struck.append((at, fault))
            if fault.kind == "stall":
                self._silent_until = at + fault.duration
            elif fault.kind == "pause":
                self._paused_until = at + fault.duration
                self._full_at = at + (fault.level or math.inf)
            elif fault.kind in DELAYS:
                self._delayed_until, self._delay = at + fault.duration, fault
            else:
                if fault.kind == "disconnect":
                    self.down_until = at + fault.duration
                outside.append(fault)
        return outside, self._released(now)

    def send(self, units: Sequence[bytes], now: float) -> list[bytes]:
        """Apply faults to units; return the units to send now, including delayed ones."""
        if now < self._silent_until:
            return []
        while self._armed and self._armed[0][0] < now:
            self._armed.popleft()
        sent: list[bytes] = []
        for unit in units:
            struck = [unit]
            if self._half:
                struck = [self._half + unit[len(unit) // 2 :]]
                self._half = b""
            elif self._armed and unit:
                struck = self._strike(self._armed.popleft()[1], unit, now)
            sent += struck
        if self._full_at <= now < self._paused_until:
            sent = []
        for unit in sent:
            self._hold(unit, self._leaves(now))
        return self._released(now)

    def _leaves(self, now: float) -> float:
        """Return when a unit of now is sent, at the earliest."""
        fault = self._delay
        if now < self._paused_until:
            return self._paused_until
        if fault is None or now >= self._delayed_until:
            return now
        if fault.kind == "jitter":
            return now + self._rng.uniform(0, fault.level)
        if fault.kind == "latency":
            return now + self._rng.exponential(fault.level)
        return (math.ceil(now / fault.level - self._phase) + self._phase) * fault.level

    def _hold(self, unit: bytes, until: float) -> None:
        last = self._held[-1][0] if self._held else until
        self._held.append((max(last, until), unit))

    def _released(self, now: float) -> list[bytes]:
        released = []
        while self._held and self._held[0][0] <= now:
            released.append(self._held.popleft()[1])
        return released

    def _strike(self, fault: Fault, unit: bytes, now: float) -> list[bytes]:
        self.struck.append((now, fault))
        octets = np.frombuffer(unit, np.uint8).copy()
        n = min(fault.count, octets.size)
        sent: list[bytes] = []
        match fault.kind:
            case "duplicate":
                sent = [unit] * (1 + fault.count)
            case "garbage":
                sent = [self._rng.bytes(fault.count), unit]
            case "merge":
                self._half = unit[: (len(unit) + 1) // 2]
            case "late":
                self._hold(unit, now + fault.duration)
            case "cut":
                start = (octets.size - n) // 2
                sent = [np.delete(octets, slice(start, start + n)).tobytes()]
            case "checksum":
                octets[max(0, octets.size - 2)] ^= 1
                sent = [octets.tobytes()]
            case "corrupt":
                places = self._rng.choice(octets.size, n, replace=False)
                octets[places] ^= self._rng.integers(1, 256, n, dtype=np.uint8)
                sent = [octets.tobytes()]
        return sent  # empty for "drop"
