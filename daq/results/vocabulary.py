"""Words for enumerated values in screens, tables and reports."""

from __future__ import annotations

from collections.abc import Mapping

from daq.clocks.clock_model import ClockSource, ClockState
from daq.recording.sensor_state import SensorState
from daq.results.band_summary import WithoutPartner
from estimator.levels.contributions import Source
from estimator.records import dataclass
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason

STATE_MEANINGS: Mapping[SensorState, str] = {
    SensorState.LIVE: "samples arrive",
    SensorState.WAITING: "connected, but no sample yet",
    SensorState.LATE: "no block for two block periods",
    SensorState.STALLED: "connected, but sends nothing; reconnected automatically",
    SensorState.DISCONNECTED: "connection lost; retried until the recording ends",
    SensorState.REFUSED: "not the device in the bench file, or not the one recorded before",
    SensorState.SILENT: "no samples, while other sensors continue",
    SensorState.ENDED: "the recording is closed",
}
"""Meaning of each state."""
STATE_ALERTS: Mapping[SensorState, str] = {
    SensorState.LATE: "{sensor} is late: no block for {time}",
    SensorState.STALLED: "{sensor} has been stalled for {time}: check power and cable;"
    " reconnects automatically",
    SensorState.DISCONNECTED: "{sensor} has been disconnected for {time}: check cable and power;"
    " reconnects automatically",
    SensorState.REFUSED: "{sensor} is refused: {reason}",
    SensorState.SILENT: "{sensor} has been silent for {time}: check power and cable",
}
"""Fault and remedy for each state in which a sensor is overdue."""
REASONS: Mapping[Reason, str] = {
    Reason.GAP: "where a sensor has a gap",
    Reason.CLIPPED: "where a sensor is at the end of its range",
    Reason.TRANSIENT: "with a transient",
    Reason.CHOSEN: "by choice of the time (--exclude)",
    Reason.REPEATED: "of times that another recording covers",
}
"""Why segments were excluded; the text follows their number."""


@dataclass(frozen=True, slots=True)
class FlagWords:
    """Names of a flag.

    Attributes
    ----------
    short : str
        For a cell of a table.
    long : str
        For a line of text, after the name of a channel.
    """

    short: str
    long: str


FLAG_WORDS: Mapping[Flag, FlagWords] = {
    Flag.DEAD_CHANNEL: FlagWords("no signal", "no signal"),
    Flag.DUPLICATE: FlagWords("a copy", "a copy of another channel"),
    Flag.NOT_FINITE: FlagWords("not finite", "the cross-spectral matrix is not finite"),
    Flag.INVALID: FlagWords(
        "invalid",
        "no cross-spectral matrix (not Hermitian, a negative PSD or a coherence above 1)",
    ),
    Flag.SINGULAR: FlagWords(
        "singular",
        "no estimate: the other channels are missing or move too little (a matrix is singular)",
    ),
    Flag.NO_COUNTERPART: FlagWords(
        "unmatched", "no estimate: the other sensors have no channel that measures the same motion"
    ),
    Flag.NOT_CONVERGED: FlagWords("not converged", "the iteration did not reach the maximum"),
    Flag.NEGATIVE: FlagWords("below 0", "the estimate is at or below zero"),
    Flag.BOUNDARY: FlagWords("at zero", "the likelihood is largest at zero noise"),
    Flag.POOLED: FlagWords(
        "pooled", "the directions of the motion are those of neighbouring frequencies"
    ),
    Flag.CHANGING: FlagWords(
        "by changes", "motion that changes gives the noise with the least scatter"
    ),
    Flag.UNIDENTIFIED: FlagWords(
        "not identified", "the motion does not change enough, and the value is an upper bound"
    ),
    Flag.UNRESOLVED: FlagWords(
        "unresolved", "too few averages for the weak motion, which the noise may include"
    ),
}
"""In the order in which tables name them."""

PARTNER_WORDS: Mapping[WithoutPartner, str] = {
    WithoutPartner.ALONE: "no shared motion",
    WithoutPartner.ONE_PARTNER: "no third sensor",
}
"""In place of a noise level that cannot be told from motion."""

SOURCE_WORDS: Mapping[Source, str] = {
    Source.CLOCKS: "clocks",
    Source.EDGES: "edges of segments",
    Source.GAPS: "gaps",
    Source.MISFIT: "motion that sensors do not share",
    Source.UNTESTED: "a model that is not tested",
    Source.SHARED_NOISE: "shared noise",
    Source.AXES: "axes that may be off",
    Source.DIMENSIONS: "the number of dimensions",
    Source.ROUNDING: "matrices in single precision",
    Source.CHANGES: "a response that changed",
    Source.PARTS: "what parts of the recording contradict",
    Source.GAINS: "gains or noise that may follow the loudness",
    Source.STEADY_MOTION: "motion that does not tell noise from motion",
    Source.LINEARITY: "squares and cubes of the motion",
    Source.OF_MOTION: "noise that depends on the motion",
    Source.COUNTS: "rounding that channels share",
    Source.GUSTS: "noise in gusts",
    Source.FAULTY: "a channel that is faulty or was disturbed",
    Source.SENSITIVITY: "sensitivity",
    Source.TEMPERATURE: "temperature",
}
"""What widens an interval beyond its scatter."""


def clock_source(clock: ClockState, *, short: bool = False) -> str:
    """Return the source of the times of a sensor's samples."""
    words = clock.source.value
    if clock.source is ClockSource.SHARED_CLOCK:
        words = f"clock of {clock.shared_clock}"
    elif short and clock.source is ClockSource.ARRIVAL_TIMES:
        words = "arrivals"
    if clock.offset_source is not None:
        words += f", whole samples from {clock.offset_source}"
    return words
