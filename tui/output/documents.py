"""JSON documents of results, calibrations and archives: every key with its type and a note.

The writers, `tui.output.json_document` and `tui.output.archive.document`, return these types;
``python -m docs.schema`` makes the JSON Schemas in ``tui/resources`` of them. Commands do not load
this module. Classes of results that JSON holds as they are declare their keys themselves (see
`estimator.records.json_key`); their notes are their docstrings.

Of the notes of a type, a pair adds to the schema, and a number says how many dimensions an array
has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NotRequired, TypeAlias, TypedDict

from daq.archive.changes import Interval
from daq.bench.channel import Certificate
from daq.clocks.clock_model import ClockState, RelativeTime
from daq.estimation.noise_estimates import ALL_METHODS
from daq.estimation.snapshot import Bridged, Octave, SensorTotals
from daq.estimation.snapshot_diagnostics import EdgeLeakage, FrequencyDiagnosis
from daq.results.decision.verdict import LimitResult
from daq.results.noise_parameters import SheetComparison
from daq.results.sources import LoggedEvent
from daq.results.uncertainty_budget import Budget
from estimator.checks.advice import Rank, Untested
from estimator.checks.band import BandDiagnosis
from estimator.checks.relative_response import RelativeResponse
from estimator.checks.sensitivities import Cause
from estimator.checks.stability import Stability
from estimator.decision.verdict import Obstacle, Prediction, Verdict
from estimator.levels.contributions import Source
from estimator.likelihood.dimension import BandDimension
from estimator.noise_parameters.allan import AllanDeviation
from estimator.noise_parameters.fit import NoiseParameters
from estimator.responses.calibration import SensorCalibration
from estimator.spectra.segment_rejection import Reason
from estimator.types import FloatArray, IntArray
from tui.wording.verdict_text import Decision

Finite: TypeAlias = Annotated[float, ("type", "number")]
Row: TypeAlias = Annotated[FloatArray, 1]
Table: TypeAlias = Annotated[FloatArray, 2]
Cube: TypeAlias = Annotated[FloatArray, 3]
Frequencies: TypeAlias = Annotated[FloatArray, 1, ("items", Finite)]
Signed: TypeAlias = Annotated[int, ("minimum", None)]
Method: TypeAlias = Annotated[str, ("type", None), ("enum", ALL_METHODS)]
Time: TypeAlias = Annotated[str, ("format", "date-time")]
Day: TypeAlias = Annotated[str, ("pattern", r"^\d{4,}-\d\d-\d\d$")]
FACTS = "What is known of the test beyond its numbers, the worst first."


class SoftwareDocument(TypedDict):
    """Program that wrote the document."""

    name: Annotated[str, "Name of the package."]
    version: Annotated[str, "Version of the package."]


class ConditionDocument(TypedDict):
    """One quantity that a sensor or the computer stated."""

    sensor: Annotated[str | None, "Sensor; null for the computer that recorded."]
    quantity: Annotated[str, "temperature, supply, or another."]
    unit: Annotated[str | None, "Unit; null if not known."]
    lowest: Annotated[Finite, "Lowest value of the recording."]
    highest: Annotated[Finite, "Highest value of the recording."]
    readings: Annotated[Signed, "Number of readings."]


class RecordedChannelDocument(TypedDict):
    """One channel."""

    name: Annotated[str, "Name."]
    unit: Annotated[str, "Unit of the motion that the sensitivity is for."]
    counts_per_unit: Annotated[Finite, "Sensitivity."]
    direction: Annotated[str | None, "Direction, for display."]
    auxiliary: Annotated[bool, "Whether it is recorded but not estimated."]


class SensorDocument(TypedDict):
    """One sensor of a recording."""

    name: Annotated[str, "Name."]
    model: Annotated[str | None, "Model."]
    serial_number: Annotated[str | None, "Serial number."]
    driver: Annotated[str | None, "Driver that read it."]
    sampling_rate_hz: Annotated[Finite, "Nominal sampling rate."]
    temperature_c: Annotated[
        float | None, "Temperature at the start in °C; null if the device states none."
    ]
    channels: Annotated[list[RecordedChannelDocument], "Channels."]


class CaveatsDocument(TypedDict):
    """`daq.caveats.Caveats` of a recording."""

    simulated: Annotated[bool, "Whether a sensor was simulated."]


class RecordingDocument(CaveatsDocument):
    """One recording."""

    file: Annotated[str, "Name of the file, without its folder."]
    run_id: Annotated[str, "Unique identifier of the run."]
    sha256: Annotated[
        str | None,
        ("pattern", "^[0-9a-f]{64}$"),
        "SHA-256 of the whole file when the document was written; null while the file is being "
        "written.",
    ]
    signed_by: Annotated[
        str | None,
        ("pattern", "^[0-9a-f]{16}$"),
        "Id of the key of the signature beside the recording; null if there is none.",
    ]
    bytes: Annotated[int, "Size of the file when the document was written."]
    state: Annotated[
        Literal["closed", "growing", "continued", "left-open"],
        "continued: in the file that follows, because the disk refused this one. left-open: the "
        "recorder was killed, and the file not repaired.",
    ]
    software: Annotated[str, "Program that recorded."]
    operator: Annotated[str | None, "Operator."]
    location: Annotated[str | None, "Location."]
    bench: Annotated[str | None, "Name of the bench; null for imported files without one."]
    conditions: Annotated[
        list[ConditionDocument], "What devices and computer stated, read once a minute."
    ]
    started: Annotated[Time, "Start of the recording, UTC."]
    last_block: Annotated[Time, "When the last block was received, UTC."]
    sensors: Annotated[list[SensorDocument], "Sensors of the recording."]


class SettingsDocument(TypedDict):
    """Options of the estimate."""

    method: Annotated[list[str], "Methods of the results."]
    segment: Annotated[Finite, "Length of a segment in seconds."]
    overlap: Annotated[Finite, "Overlap of segments as a fraction of their length."]
    window: Annotated[str, "Window of each segment."]
    detrend: Annotated[str, "Trend removed from each segment."]
    unit: Annotated[str, "Unit of the motion."]
    start: Annotated[str | None, "Only data from here on; ISO 8601."]
    end: Annotated[str | None, "Only data before; ISO 8601."]
    sampling_rate_hz: Annotated[Finite, "Rate of the common grid."]
    band: Annotated[tuple[Finite, Finite] | None, "Band of interest in Hz."]
    target_cov: Annotated[float | None, "Wanted coefficient of variation."]


class LabelDocument(TypedDict):
    """`daq.estimation.snapshot.ChannelLabel`."""

    sensor: Annotated[str, "Name of the sensor."]
    channel: Annotated[str, "Name of the channel."]
    unit: Annotated[str, "Unit of the motion. PSDs are in its square per Hz."]


class ChannelDocument(LabelDocument):
    """Spectra of one channel, a value for each frequency."""

    data_psd: Annotated[Row, "PSD of what the channel recorded, one-sided, in unit²/Hz."]
    noise_psd: Annotated[
        Row,
        "PSD of its self-noise, one-sided, in unit²/Hz. Estimates can be negative; null where "
        "there is none.",
    ]
    noise_psd_low: Annotated[Row, "Lower end of the 95 % interval."]
    noise_psd_high: Annotated[Row, "Upper end of the 95 % interval."]
    cov: Annotated[Row, "Coefficient of variation of noise_psd."]
    flags: Annotated[IntArray, 1, ("items", Signed), "Sum of the numbers in diagnostics.flags."]


class SynchronisationDocument(TypedDict):
    """What is left between the clocks."""

    residual_s: Annotated[Mapping[str, float], "By sensor, rms."]
    reference: Annotated[str | None, "Sensor against which the motion measures the clocks."]
    noise_bias_share: NotRequired[
        Annotated[Table, "What errors add to the noise PSD, as a fraction: frequencies × channels."]
    ]
    removed_psd: NotRequired[Annotated[Table | None, "What they take away at most, in unit²/Hz."]]


class StabilityKeys(TypedDict):
    """What JSON says of stability beside its fields."""

    inflation: Annotated[float, "Variance over that of steady noise."]


class ClockKeys(TypedDict):
    """What JSON says of a clock in other words."""

    shared_clock: Annotated[
        str | None,
        "Name of a shared clock, or of the sensor whose clock it is; null where it has its own.",
    ]
    restarts: Annotated[int, "Number of restarts."]


class DiagnosticsBesides(TypedDict, total=False):
    """Keys that are absent where the data are insufficient or no channel is affected."""

    edge_leakage: Annotated[EdgeLeakage, "Leakage at the edges of segments."]
    dimensions: Annotated[tuple[BandDimension, ...], "Dimensions of the motion, by band."]
    tested_dimensions: Annotated[int, "Dimensions of the motion in the model that was tested."]
    bands: Annotated[tuple[BandDiagnosis, ...], "The diagnosis by band."]
    responses: Annotated[tuple[RelativeResponse, ...], "Response of sensors relative to others."]
    shared_noise_searched: Annotated[bool, "False with too many channels."]
    stability: Annotated[Annotated[Stability, StabilityKeys] | None, "Whether the noise changes."]
    pairs: Annotated[list[tuple[str, str]], "Names of each pair of sensors."]
    per_frequency: Annotated[FrequencyDiagnosis, "The diagnosis by frequency."]
    clipped_share: Annotated[Mapping[str, float], "Share of clipped samples, by affected channel."]
    repeated_share: Annotated[
        Mapping[str, float], "Share of repeated samples, by affected channel."
    ]
    wraps_at_bits: Annotated[Mapping[str, int], "Bits at which counts wrap, by affected channel."]
    stood_still_s: Annotated[
        Mapping[str, float],
        "Seconds with a constant count, a line or a cubic, by affected channel.",
    ]


class DiagnosticsDocument(DiagnosticsBesides):
    """What the samples show of the test; see docs/json.md."""

    start_utc_ns: Annotated[Signed, "UTC of the first sample, in ns since 1970."]
    elapsed_s: Annotated[float, "Length of the recording."]
    is_closed: Annotated[bool, "Whether the recording has ended."]
    excluded_segments: Annotated[int, "Number of excluded segments."]
    excluded_by_reason: Annotated[
        Mapping[Reason, int], "Their number by reason: gap, clipped, transient."
    ]
    bridged: Annotated[Bridged | None, "Segments with gaps that are used."]
    octaves: Annotated[tuple[Octave, ...], "With --octaves, the segments of each octave."]
    flags: Annotated[Mapping[str, int], "Value of each flag."]
    refused: Annotated[Mapping[str, str], "Why a method has no estimate."]
    sensors: Annotated[tuple[SensorTotals, ...], "Samples, gaps and state of each sensor."]
    clocks: Annotated[list[Annotated[ClockState, ClockKeys]], "Clock of each sensor."]
    events: Annotated[
        tuple[LoggedEvent, ...],
        "Samples that the result shows to be lost, or repeated, without being counted.",
    ]
    drift_s: Annotated[
        Table, "For each segment: its time since the start, and the lag of each sensor's clock."
    ]
    synchronisation: Annotated[SynchronisationDocument, "What is left between the clocks."]
    untested: Annotated[Untested | None, "Why the model of one common motion was not tested."]


class EstimateDocument(TypedDict):
    """Estimate by one method."""

    method: Annotated[Method, "Method of the estimate."]
    segments: Annotated[int, "Number of segments used."]
    effective_averages: Annotated[Finite, "Independent averages that the segments are worth."]
    frequency_hz: Annotated[Frequencies, "Frequencies of all spectra in Hz."]
    channels: Annotated[list[ChannelDocument], "Every channel."]
    diagnostics: Annotated[DiagnosticsDocument, "What the samples show of the test."]


class WrongSensitivityDocument(TypedDict):
    """A channel that reads more or less of the common motion than the other sensors."""

    sensor: Annotated[str, "Name of the sensor."]
    channel: Annotated[str, "Name of the channel."]
    gain: Annotated[Finite, "Motion that the channel reads over that which the other sensors read."]
    error: Annotated[Finite, "Standard error of the gain."]
    against: Annotated[Sequence[str], "Sensors that agree; empty where no majority does."]
    cause: Annotated[Cause | None, "What is likely to be wrong."]


class SlowestDocument(TypedDict):
    """The channel, beside its limit, that takes longest to pass, or fails first."""

    channel: Annotated[str, "Its name, as in A.X."]
    frequency_hz: Annotated[float, "Centre of the band where it does."]


class PredictionKeys(TypedDict):
    """What JSON says of a prediction beside its fields."""

    slowest: Annotated[SlowestDocument, "What takes longest."]


class LimitMargins(TypedDict):
    """Margins of a channel beside a limit."""

    k: Annotated[
        float,
        "Coverage factor of the interval, in standard deviations of a normal distribution: it "
        "holds for all channels, limits and bands together.",
    ]
    margin_db: Annotated[float, "How far the noise is below the limit."]
    margin_low_db: Annotated[float, "The margin at the upper end of the interval."]
    margin_high_db: Annotated[float, "The margin at the lower end; null where that is not above 0."]


class VerdictDocument(TypedDict):
    """Verdict on the limits of the bench file."""

    decision: Annotated[Decision | None, "First line of other output; null without limits."]
    verdict: Annotated[
        Verdict | None, "Verdict on the limits of the bench file; null without limits."
    ]
    obstacles: Annotated[list[Obstacle], "What keeps the test from a decision."]
    sensitivities: Annotated[
        list[WrongSensitivityDocument],
        "Channels whose sensitivity the common motion contradicts.",
    ]
    record_for: Annotated[
        Annotated[Prediction, PredictionKeys] | None,
        "Length of a recording that would decide, where a longer recording would.",
    ]
    limits: Annotated[
        list[Annotated[LimitResult, LimitMargins]],
        "Every channel beside every limit that is for it.",
    ]


class FindingDocument(TypedDict):
    """One finding of the estimator."""

    kind: Annotated[str, "The finding; docs/json.md lists them."]
    level: Annotated[Literal["problem", "warning", "note"], "What it does to the result."]
    sensors: Annotated[list[int], "Affected sensors, from 0; empty for all."]
    band_hz: Annotated[tuple[Finite, Finite] | None, "Affected band; null for all."]
    numbers: Annotated[dict[str, Any], "The evidence, by kind."]


class FindingsDocument(TypedDict):
    """The evidence, by kind; of findings, their list."""

    findings: NotRequired[Annotated[list[FindingDocument], "The findings, worst first."]]


class FactDocument(TypedDict):
    """One fact about the test beyond its numbers."""

    kind: Annotated[str, "The kind of the fact; docs/json.md lists them."]
    rank: Annotated[Rank, "What it does to the result."]
    sensors: Annotated[list[str], "Sensors concerned; empty for all."]
    channels: Annotated[list[str], "Channels concerned, as in A.X; empty for all."]
    band_hz: Annotated[tuple[Finite, Finite] | None, "Band concerned; null for all."]
    time_utc_ns: Annotated[
        tuple[Signed, Signed] | None,
        "From when to when, in ns since 1970; null for the whole test.",
    ]
    method: Annotated[str | None, "Method concerned; null for all."]
    numbers: Annotated[
        dict[str, Any], FindingsDocument, "The evidence, by kind; of findings, their list."
    ]
    line: Annotated[str, "The fact in a line; it can change between versions."]
    explanation: Annotated[str, "The fact and its effect in sentences; likewise."]
    action: Annotated[str | None, "What to do; likewise."]


class ContributionDocument(TypedDict):
    """What widens an interval beyond the scatter."""

    source: Annotated[Source, "The cause."]
    below: Annotated[float, "How far the lower end is lowered, in unit²/Hz; null: without limit."]
    above: Annotated[float, "How far the upper end is raised, in unit²/Hz; null: without limit."]


class BandMeanDocument(LabelDocument):
    """Mean of one channel in the band of interest."""

    method: Annotated[str, "Method."]
    low_hz: Annotated[Finite, "Lower end of the band."]
    high_hz: Annotated[Finite, "Upper end of the band."]
    data_psd: Annotated[float, "Mean PSD of what the channel recorded, one-sided, in unit²/Hz."]
    noise_psd: Annotated[float, "Mean PSD of its self-noise, one-sided, in unit²/Hz."]
    noise_psd_low: Annotated[float, "Lower end of the 95 % interval of the mean."]
    noise_psd_high: Annotated[float, "Upper end."]
    standard_uncertainty: Annotated[
        float, "Combined standard uncertainty of the mean, in unit²/Hz."
    ]
    k: Annotated[float, "Coverage factor: expanded over combined standard uncertainty."]
    expanded_uncertainty: Annotated[float, "Half the width of the 95 % interval, in unit²/Hz."]
    scatter_low: Annotated[float | None, "Lower end of the 95 % interval by scatter alone."]
    scatter_high: Annotated[float | None, "Upper end of the 95 % interval by scatter alone."]
    contributions: Annotated[
        list[ContributionDocument], "What widens the interval beyond the scatter."
    ]


class TermDocument(TypedDict):
    """One noise term; one that is absent is around zero, possibly negative."""

    value: Annotated[float, "One-sided PSD at 1 Hz."]
    error: Annotated[float, "Its standard error."]


class ChannelNoiseDocument(LabelDocument):
    """Noise terms of one channel, by the first method."""

    terms: Annotated[
        Mapping[str, TermDocument] | None,
        "By name: random-walk (f⁻²), flicker (f⁻¹), white, f-squared (f²).",
    ]
    covariance: Annotated[Table | None, "Of the four values, in this order."]
    fit: Annotated[NoiseParameters | None, "How the terms describe the noise."]
    refused: Annotated[str | None, "Why there are no terms."]
    allan_deviation: Annotated[AllanDeviation | None, "Allan deviation against averaging time."]
    quantisation_psd: Annotated[
        float,
        "Mean quantisation noise, LSB²/(6 × sampling rate); null where samples are not whole "
        "numbers.",
    ]
    quantisation_share: Annotated[float, "Its share of the noise."]
    data_sheet: Annotated[tuple[SheetComparison, ...], "Values of the data sheet."]


class WholeDocument(VerdictDocument):
    """What a document has beside estimates."""

    schema_version: Annotated[
        Literal[2],
        "Rises when a key is removed or changes its meaning. New keys do not change it.",
    ]
    software: Annotated[SoftwareDocument, "Program that wrote the document."]
    run_id: Annotated[
        str | None,
        "Identifier of the run, of the last recording if there are several; null for arrays.",
    ]
    recordings: Annotated[
        list[RecordingDocument], "Recordings of the estimate, in order; empty for arrays."
    ]
    settings: Annotated[
        SettingsDocument,
        "Options of the estimate under their names in the bench file; times in seconds, "
        "frequencies in Hz. It can hold further options.",
    ]
    facts: Annotated[list[FactDocument], FACTS]
    band_means: Annotated[
        list[BandMeanDocument],
        "Mean noise of every channel in the band of interest, by every method.",
    ]
    noise_parameters: NotRequired[
        Annotated[
            list[ChannelNoiseDocument],
            "With --noise-parameters: noise terms of every channel.",
        ]
    ]


class OneEstimateDocument(WholeDocument, EstimateDocument):
    """What huddle estimate --json and huddle run --json write.

    Numbers that are not finite are null. Documents can hold keys that this schema does not list.
    """


class SeveralEstimatesDocument(WholeDocument):
    """Results of several methods."""

    results: Annotated[
        list[EstimateDocument],
        "With several methods, the estimate of each. With one method the document itself holds "
        "its keys.",
    ]


ResultDocument: TypeAlias = OneEstimateDocument | SeveralEstimatesDocument


class ResponseDocument(TypedDict):
    """Response of a sensor relative to the reference, in thirds of an octave."""

    frequency_hz: Annotated[Frequencies, "Mean frequency of each band."]
    real: Annotated[Cube, "Bands × channels × channels of the reference; null if not known."]
    imag: Annotated[Cube, "Likewise."]
    standard_error: Annotated[Cube, "Of the real, and of the imaginary part."]


class CalibratedKeys(TypedDict):
    """What JSON says of a calibrated sensor beside its fields."""

    sensor: Annotated[str, "Name of the sensor."]
    channels: Annotated[list[str], "Names of its channels."]
    band_hz: Annotated[tuple[Finite, Finite], "Band."]
    relative_time: Annotated[RelativeTime, "How its times are known against the reference."]
    curve: ResponseDocument


class CalibrationDocument(TypedDict):
    """What huddle calibrate --json writes."""

    reference: Annotated[str, "Sensor that all others are compared with."]
    is_absolute: Annotated[bool, "Whether results rest on certificates in the bench file."]
    certificates: Annotated[tuple[Certificate, ...], "Of each channel of the reference."]
    confidence: Annotated[Finite, "Level of the expanded uncertainties."]
    refused: Annotated[Mapping[str, str], "Why a sensor is not calibrated, by sensor."]
    without_noise: Annotated[list[str], "Channels without a budget of the noise."]
    untested: Annotated[list[str], "Sensors of whose linearity too few segments tell."]
    sensors: Annotated[
        list[Annotated[SensorCalibration, CalibratedKeys]], "Each other sensor, over the band."
    ]
    budgets: Annotated[tuple[Budget, ...], "Of each channel, quantity and band."]


class DoubtedDocument(TypedDict):
    """A recording that is left out."""

    source: Annotated[str, "Recording."]
    clocks: Annotated[list[str], "Sensors."]


class StoreDocument(TypedDict):
    """The archive."""

    stretch_s: Annotated[Literal[3600, 86400], "Length of a stretch in seconds."]
    recordings: Annotated[int, "Recordings in the archive."]
    problems: Annotated[list[str], "What could not be read, as sentences."]
    doubted: Annotated[
        list[DoubtedDocument],
        "Recordings left out because the clock of a sensor is not understood.",
    ]


class DaysDocument(TypedDict):
    """Noise of every day."""

    date: Annotated[list[Day], "Days of UTC that have segments."]
    segments: Annotated[Annotated[IntArray, 1], "Segments of each day."]
    noise_psd: Annotated[Cube, "Mean noise PSD, in unit²/Hz: days × bands × channels."]
    noise_psd_low: Annotated[
        Cube, "Lower end of its 95 % interval, in unit²/Hz: days × bands × channels."
    ]
    noise_psd_high: Annotated[Cube, "Upper end, in unit²/Hz: days × bands × channels."]


class ChangesDocument(TypedDict):
    """The test for changes of level."""

    false_alarm: Annotated[
        Finite,
        ("exclusiveMinimum", 0),
        ("maximum", 0.5),
        "Probability of a change in any series, if none has one.",
    ]
    decided: Annotated[
        list[list[bool]], "Whether the series has enough days and a level: bands × channels."
    ]


class SegmentDocument(TypedDict):
    """Days between two changes."""

    first_day: Annotated[str, "First day of UTC."]
    last_day: Annotated[str, "Last day."]
    change_db: Annotated[
        Interval | None,
        "Change at the beginning of the first day, between the lines of both segments; null for "
        "the first segment.",
    ]
    noise_psd: Annotated[
        float,
        "Noise PSD of the segment's line in the middle of its days, in unit²/Hz: the mean of "
        "decibels where every day is known to a tenth, else of power.",
    ]
    drift_db_per_year: Annotated[Interval, "Slope within the segment."]
    work_minus_night_db: Annotated[
        Interval, "Mean difference of working hours and nights of the same days."
    ]
    work_minus_night_days: Annotated[
        int, "Days, Monday to Friday, with working hours and both nights."
    ]


_BELOW = "Level below which {} % of the stretches are: frequencies × channels."
PercentileDocument = TypedDict(
    "PercentileDocument",
    {
        "10": Annotated[Table, _BELOW.format(10)],
        "50": Annotated[Table, _BELOW.format(50)],
        "90": Annotated[Table, _BELOW.format(90)],
    },
)


class DensityDocument(TypedDict):
    """How often a stretch has a PSD."""

    stretches: Annotated[int, "Stretches counted."]
    short_stretches: Annotated[int, "Stretches left out: less than half of their segments."]
    frequency_hz: Annotated[Frequencies, "Centres of octaves."]
    lowest_db: Annotated[
        Signed, "Lower edge of the first bin of levels in dB re 1 unit²/Hz; a bin has 1 dB."
    ]
    counts: Annotated[Annotated[IntArray, 3], "Stretches: frequencies × bins of level × channels."]
    not_positive: Annotated[
        Annotated[IntArray, 2],
        "Stretches whose estimate is zero or below, and has no level: frequencies × channels.",
    ]
    percentile_db: Annotated[PercentileDocument, "Levels in dB; null where there is none."]


class ArchiveDocument(TypedDict):
    """What huddle archive --json writes. Numbers that are not finite are null.

    Documents can hold keys that this schema does not list. The order of arrays is that of channels,
    bands_hz, days.date and density.frequency_hz.
    """

    schema_version: Annotated[
        Literal[2],
        "Rises when a key is removed or changes its meaning. New keys do not change it.",
    ]
    archive: Annotated[StoreDocument, "The archive."]
    facts: Annotated[
        list[FactDocument],
        "What is known of the archive beyond its numbers, the worst first. Facts of the pooled "
        "estimate are in pooled.",
    ]
    pooled: Annotated[ResultDocument, "Estimate from all recordings together."]
    method: Annotated[str, "Method of everything but pooled."]
    unit: Annotated[str, "Unit of the motion; PSDs are in its square per Hz."]
    channels: Annotated[list[str], "Names of the channels: sensor, dot, channel."]
    bands_hz: Annotated[
        list[tuple[Finite, Finite]],
        "Lowest and highest frequency of each band: the whole band of the estimate, then octaves; "
        "or the one band that was asked for.",
    ]
    days: Annotated[DaysDocument, "Noise of every day."]
    changes: Annotated[ChangesDocument, "The test for changes of level."]
    segments: Annotated[
        list[list[Annotated[list[SegmentDocument], ("minItems", 1)]]],
        "Segments between changes: bands × channels, each in order of time. No interval spans a "
        "change.",
    ]
    density: Annotated[DensityDocument, "How often a stretch has a self-noise."]
    recorded_density: Annotated[
        DensityDocument, "Probability density of the recorded PSD, as that of the noise."
    ]


class StationDocument(TypedDict):
    """Answer of one station."""

    station: Annotated[str, "Name of the station, or of the group: the folder of its archive."]
    answer: Annotated[ArchiveDocument, "What huddle archive --json writes of this station alone."]


class StationsDocument(TypedDict):
    """What huddle archive --json writes of several stations.

    Documents can hold keys that this schema does not list.
    """

    schema_version: Annotated[
        Literal[1],
        "Rises when a key is removed or changes its meaning. New keys do not change it.",
    ]
    stations: Annotated[list[StationDocument], "Stations that could be summed up, by name."]
    problems: Annotated[list[str], "What could not be taken or read of all stations, as sentences."]
