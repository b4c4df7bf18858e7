"""What recordings are of, and what they lack; sensors that fail while they run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from daq.caveats import Caveat
from daq.estimation.settings import Settings
from daq.estimation.snapshot import SensorTotals, Snapshot
from daq.recording.interface import FIRST_DATE_NS
from daq.recording.monitor import RecordingStatus
from daq.recording.sensor_state import SensorState
from daq.results.facts.fact import Fact
from daq.results.vocabulary import STATE_ALERTS
from estimator.checks.advice import Rank
from estimator.records import Seconds
from estimator.wording import Words, clock_time, listed, several, time_of_day

LEAST_SHARE = 0.01
"""Share of the noise from which a contribution to an interval is a fact; of the time, too."""


DELAYING_SHARE = 0.1
"""Share of the time of the estimate from which a sensor that shortens it delays the result."""


class SensorsSimulated(Fact):
    """A sensor was simulated: the noise is that of a model, not of instruments."""

    def _words(self) -> Words:
        sentence = Caveat.SIMULATED.words.sentence
        return Words(sentence.rstrip("."), sentence)


_OF_CAVEATS: Mapping[Caveat, type[Fact]] = {Caveat.SIMULATED: SensorsSimulated}


class RecordingLeftOpen(Fact):
    """The recorder of a recording was killed; what it had saved is estimated."""

    file: str

    def _words(self) -> Words:
        text, do = f"The recorder of {self.file} was killed", "huddle repair closes the file."
        return Words(f"{text}: huddle repair closes it", f"{text}. All saved samples count.", do)


class RecordingsOverlap(Fact):
    """Two recordings cover the same time; of `repeated` no segment in it counts.

    Attributes
    ----------
    duration : float
        Of the time in both.
    """

    counted: str
    repeated: str
    duration: Seconds

    def _words(self) -> Words:
        text = f"{self.counted} and {self.repeated} cover the same {clock_time(self.duration)}"
        at = f", from {time_of_day(self.time_utc_ns[0])} UTC on" if self.time_utc_ns else ""
        return Words(
            f"{text}, which counts once",
            f"{text}{at}: segments of {self.repeated} in it are excluded.",
            "If the times of one are wrong, correct them and import it again.",
        )


class SensorLost(Fact):
    """A sensor sent nothing from `time_utc_ns` on.

    Attributes
    ----------
    missing : float
        Seconds to the end of the test.
    never_seen : bool
        Whether it sent nothing at all.
    """

    missing: Seconds
    never_seen: bool

    def _words(self) -> Words:
        sensor, do = listed(self.sensors), "Check its power and its cable, and record again."
        if self.never_seen:
            return Words(
                f"{sensor} sent nothing: check power and cable", f"{sensor} sent nothing.", do
            )
        since = 0 if self.time_utc_ns is None else self.time_utc_ns[0]
        text = f"{sensor} was lost {clock_time(self.missing)} before the end"
        return Words(
            f"{text}: check power and cable",
            f"{text}, at {time_of_day(since)} UTC. No segment after that counts for it.",
            do,
        )


class BlocksDamaged(Fact):
    """Blocks of a sensor in the file have wrong checksums, and are excluded as gaps."""

    n_blocks: int

    def _words(self) -> Words:
        text = (
            f"{listed(self.sensors)}: {several(self.n_blocks, 'block')} of the file damaged and"
            " excluded"
        )
        do = "huddle repair --check counts all of them."
        return Words(f"{text}: huddle repair --check counts all", f"{text} (wrong checksum).", do)


class SamplesMissing(Fact):
    """A sensor has gaps."""

    n_gaps: int
    n_samples: int

    def _words(self) -> Words:
        text = (
            f"{listed(self.sensors)}: {several(self.n_gaps, 'gap')}, "
            f"{several(self.n_samples, 'sample')} missing"
        )
        return Words(text, f"{text}.")


class SpanShortened(Fact):
    """`sensors` begin late, or end early, and only the time of all sensors is estimated.

    Attributes
    ----------
    unused : float
        Of the other sensors, that are not used.
    at_end : bool
    """

    unused: Seconds
    at_end: bool

    def _words(self) -> Words:
        who = f"{listed(self.sensors)} end" if self.at_end else f"{listed(self.sensors)} begin"
        who += "s" * (len(self.sensors) == 1) + (" early" if self.at_end else " late")
        return Words(
            f"{who}: {clock_time(self.unused)} of the others are not used; import those alone",
            f"{who}. Only the time of all sensors is estimated: {clock_time(self.unused)} of the"
            " others are not used.",
            "If the others are enough, import them alone: they are estimated over all of their "
            "time.",
        )


class NotInLiveEstimate(Fact):
    """A live estimate leaves out `sensors` to limit its memory; `n_all` are recorded."""

    n_all: int

    def _words(self) -> Words:
        n = self.n_all - len(self.sensors)
        text = f"Live estimate of the first {n} of {self.n_all} sensors, to limit its memory."
        return Words(text.rstrip("."), text, "The result has all; so has huddle estimate.")


class SensorOverdue(Fact):
    """A sensor of a running test is late or lost; of a closed one, it was lost before the end.

    Attributes
    ----------
    state : SensorState
    overdue : float
        Seconds since its last block.
    reason : str
        The recorder's reason for the state; empty if it gave none.
    is_closed : bool
        Whether the recording has ended.
    """

    state: SensorState
    overdue: Seconds
    reason: str
    is_closed: bool

    def _words(self) -> Words:
        time, sensor = clock_time(self.overdue), listed(self.sensors)
        if self.is_closed:
            text = f"{sensor} was lost {time} before the end: {self.reason}"
        else:
            text = STATE_ALERTS[self.state].format(sensor=sensor, time=time, reason=self.reason)
        return Words(text, f"{text}.")


class ChannelsStuck(Fact):
    """Channels of a running test have a constant count, now or for some time earlier."""

    is_now: bool

    def _words(self) -> Words:
        who = ", ".join(self.channels)
        if self.is_now:
            return Words(
                f"{who} is stuck: no signal; check the cable",
                f"{who}: the count is constant: no signal.",
                "Check the cable.",
            )
        text = f"{who} was stuck for a while: do not trust its noise"
        return Words(text, f"{text}.")


class SensorClipping(Fact):
    """A sensor of a running test reaches the end of its range; `are_kept`: segments with that."""

    are_kept: bool

    def _words(self) -> Words:
        effect = "are kept: do not trust its noise" if self.are_kept else "are excluded"
        text = f"{listed(self.sensors)} is clipping: segments with clipped samples {effect}"
        return Words(text, f"{text}.", "Choose a larger range, or reduce the motion.")


def facts_of_recordings(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield what the recordings are of, and what they lack."""
    for caveat in snapshot.caveats:
        yield _OF_CAVEATS[caveat](rank=Rank.TO_KNOW)
    for file in snapshot.left_open:
        yield RecordingLeftOpen(rank=Rank.DELAYS, file=file)
    for counted, repeated, begin, end in snapshot.overlaps:
        seconds = (end - begin) * 1e-9
        yield RecordingsOverlap(
            rank=Rank.DELAYS if seconds > DELAYING_SHARE * snapshot.elapsed else Rank.TO_KNOW,
            counted=counted,
            repeated=repeated,
            time_utc_ns=(begin, end) if begin >= FIRST_DATE_NS else None,
            duration=seconds,
        )
    for sensor in snapshot.sensors:
        if sensor.is_lost:
            yield _lost(snapshot, sensor)
        if sensor.n_damaged:
            yield BlocksDamaged(rank=Rank.DELAYS, sensors=(sensor.name,), n_blocks=sensor.n_damaged)
        if sensor.n_gaps:
            yield SamplesMissing(
                rank=Rank.TO_KNOW,
                sensors=(sensor.name,),
                n_gaps=sensor.n_gaps,
                n_samples=sensor.n_missing,
            )
    yield from _shortened(snapshot)
    if left_out := snapshot.not_in_memory:
        yield NotInLiveEstimate(rank=Rank.TO_KNOW, sensors=left_out, n_all=len(snapshot.sensors))


def _shortened(snapshot: Snapshot) -> Iterator[SpanShortened]:
    """Yield which sensors shorten the time of the estimate, at its begin and at its end."""
    for at_end in (False, True):
        if at_end and any(each.is_lost for each in snapshot.sensors):  # a fact of its own
            continue
        seconds = {sensor: both[at_end] for sensor, both in snapshot.shortened.items()}
        sensors = tuple(sensor for sensor, own in seconds.items() if own)
        longest = max(seconds.values(), default=0.0)
        if sensors and longest > LEAST_SHARE * snapshot.elapsed:
            yield SpanShortened(
                rank=Rank.DELAYS if longest > DELAYING_SHARE * snapshot.elapsed else Rank.TO_KNOW,
                sensors=sensors,
                unused=longest,
                at_end=at_end,
            )


def _lost(snapshot: Snapshot, sensor: SensorTotals) -> SensorLost:
    start = snapshot.start_utc_ns
    end = start + round(snapshot.elapsed * 1e9)
    last_seen = [each.last_seen for each in snapshot.sensors if math.isfinite(each.last_seen)]
    end = max([end, *(round(seconds * 1e9) for seconds in last_seen)])
    never = not math.isfinite(sensor.last_seen)
    since = start if never else round(sensor.last_seen * 1e9)
    return SensorLost(
        rank=Rank.DELAYS,
        sensors=(sensor.name,),
        time_utc_ns=(since, end),
        missing=max(0.0, (end - since) * 1e-9),
        never_seen=never,
    )


def facts_of_sensors(now: RecordingStatus, settings: Settings | None) -> list[Fact]:
    """Return the faults of the sensors of a running or closed recording, the worst first."""
    found: list[Fact] = []
    for sensor in now.sensors:
        mine = (sensor.name,)
        if sensor.state.is_overdue:
            found.append(
                SensorOverdue(
                    rank=Rank.INVALIDATES if sensor.state.is_lost else Rank.DELAYS,
                    sensors=mine,
                    state=sensor.state,
                    overdue=sensor.overdue_for,
                    reason=sensor.reason,
                    is_closed=now.closed,
                )
            )
        elif sensor.stuck:
            names = tuple(f"{sensor.name}.{name}" for name in sensor.stuck)
            found.append(ChannelsStuck(rank=Rank.INVALIDATES, channels=names, is_now=True))
        elif sensor.is_clipping:
            kept = settings is not None and settings.reject is False
            found.append(SensorClipping(rank=Rank.DELAYS, sensors=mine, are_kept=kept))
        if sensor.was_stuck:
            names = tuple(f"{sensor.name}.{name}" for name in sensor.was_stuck)
            found.append(ChannelsStuck(rank=Rank.DELAYS, channels=names, is_now=False))
    ranks, kinds = list(Rank), (SensorOverdue, ChannelsStuck, SensorClipping)
    return sorted(found, key=lambda fact: (ranks.index(fact.rank), kinds.index(type(fact))))
