"""One fact of each kind."""

from __future__ import annotations

import math
import sys
from typing import Any

from daq.archive.facts import (
    AbsencesNotUsed,
    ChangesNotTested,
    ChangesUndecided,
    NightsNotCompared,
    RecordingsLeftOut,
    ResponsesVary,
    SpectraUnreadable,
    StretchesLeftOut,
)
from daq.clocks.clock_model import ClockSetting
from daq.protocols.block import Uncounted
from daq.recording.sensor_state import SensorState
from daq.results.decision.facts import LimitNotJudged, LimitUndecided, WrongSensitivity
from daq.results.facts.changes import (
    MethodsDiffer,
    NoiseNotIdentified,
    NoisePartShared,
    SteadyGainsAssumed,
)
from daq.results.facts.channels import (
    CertificateDiffers,
    ChannelsClipped,
    ChannelsStoodStill,
    ChannelsWrap,
    CodesMissing,
    NoiseDependsOnMotion,
    NotLinear,
    ReadingsRepeat,
    RoundedAlike,
    SensitivitiesDiffer,
)
from daq.results.facts.clocks import (
    ClockNotUnderstood,
    ClockSet,
    ClocksFitted,
    ClocksMayExplain,
    Polled,
    RatesNominal,
    SamplesUncounted,
    StatedTimesDrift,
    StatedTimesUnchecked,
)
from daq.results.facts.fact import Fact, Finding
from daq.results.facts.methods import (
    DirectionsPooled,
    FewerFrequencies,
    LikeChannelsAssumed,
    MethodRefused,
    NoEstimateAbove,
    SharedNoiseNotSearched,
    SteadinessNotTested,
    ValuesBelowZero,
    WithoutEstimate,
)
from daq.results.facts.model import (
    DimensionsChosen,
    DimensionsUndetermined,
    DimensionsUnexplained,
    FewSensors,
    ModelPasses,
    ModelUntested,
    SharedByTwo,
)
from daq.results.facts.precision import IntervalsWidened, NoiseInGusts, PairCompared, TargetMissed
from daq.results.facts.recordings import (
    BlocksDamaged,
    ChannelsStuck,
    NotInLiveEstimate,
    RecordingLeftOpen,
    RecordingsOverlap,
    SamplesMissing,
    SensorClipping,
    SensorLost,
    SensorOverdue,
    SensorsSimulated,
    SpanShortened,
)
from daq.results.facts.segments import (
    ChannelsAbsent,
    GapsBridged,
    NoSegmentUsable,
    OctaveSegments,
    SegmentsExcluded,
)
from estimator.checks.advice import Rank, Untested
from estimator.checks.sensitivities import Cause
from estimator.decision.verdict import Obstacle
from estimator.levels.contributions import Source
from estimator.self_noise.result import Flag, Refusal
from estimator.spectra.segment_rejection import Reason
from tests.tui.wording.advice_examples import EXAMPLES as ADVICE
from tests.tui.wording.advice_examples import MISFIT, SEVERAL, names

FINDINGS = tuple(
    Finding(rank=found[0].rank, findings=found, names=names("a", "b", "c"))
    for found in (*((each,) for each in ADVICE), *SEVERAL)
)
"""All words of the estimator, alone and together."""
A, NOON = ("A",), 1_700_000_000_000_000_000

EXAMPLES: tuple[Fact, ...] = (
    Finding(rank=Rank.INVALIDATES, findings=(MISFIT,), names=names("A", "B", "C")),
    SensorsSimulated(rank=Rank.TO_KNOW),
    FewSensors(rank=Rank.DELAYS, n_sensors=1),
    PairCompared(
        rank=Rank.TO_KNOW,
        sensors=("A", "B"),
        band=(0.5, 40.0),
        coherence=0.98,
        coherence_error=0.001,
        rotation=2.5,
        rotation_error=0.01,
        gains=(1.02, 0.99),
        gain_errors=(0.001, 0.002),
        delay=math.nan,
        delay_error=math.nan,
    ),
    SteadyGainsAssumed(rank=Rank.TO_KNOW, method="multi-part", share=0.001),
    NoiseNotIdentified(
        rank=Rank.DELAYS,
        method="multi-part",
        channels=("A.X",),
        band=(0.1, 1.0),
        refusal=Refusal.STEADY,
        change=0.4,
        axis="A.Z",
    ),
    NoisePartShared(
        rank=Rank.DELAYS,
        sensors=("A", "B"),
        band=(1.0, 3.0),
        share=0.4,
        share_error=0.02,
        is_known=False,
    ),
    MethodsDiffer(
        rank=Rank.DELAYS,
        method="three-sensor",
        channels=("A.X",),
        band=(1.0, 3.0),
        difference=1.2,
    ),
    MethodRefused(rank=Rank.DELAYS, method="two-channel", reason="channels differ"),
    WithoutEstimate(
        rank=Rank.DELAYS,
        method="three-sensor",
        channels=("A.X",),
        flag=Flag.SINGULAR,
        most=3,
        n_frequencies=9,
    ),
    NoSegmentUsable(rank=Rank.INVALIDATES, sensors=A, segment=10.0, reason=Reason.GAP, longest=4.0),
    RecordingLeftOpen(rank=Rank.DELAYS, file="night.h5"),
    RecordingsOverlap(
        rank=Rank.DELAYS,
        time_utc_ns=(NOON, NOON + 397 * 10**9),
        counted="night.h5",
        repeated="copy.h5",
        duration=397.0,
    ),
    NotInLiveEstimate(rank=Rank.TO_KNOW, sensors=A, n_all=3),
    SensorLost(
        rank=Rank.DELAYS,
        sensors=A,
        time_utc_ns=(NOON, NOON + 397 * 10**9),
        missing=397.0,
        never_seen=False,
    ),
    BlocksDamaged(rank=Rank.DELAYS, sensors=A, n_blocks=2),
    SpanShortened(rank=Rank.DELAYS, sensors=A, unused=300.0, at_end=False),
    SamplesMissing(rank=Rank.TO_KNOW, sensors=A, n_gaps=2, n_samples=40),
    SegmentsExcluded(rank=Rank.TO_KNOW, n_segments=3, reasons={Reason.CLIPPED: 3}),
    GapsBridged(rank=Rank.TO_KNOW, n_segments=4, lost=0.02, leakage=0.01),
    ChannelsAbsent(
        rank=Rank.TO_KNOW,
        channels=("A.X",),
        n_segments=(40,),
        most=60,
        complete_only=("two-channel", "three-channel"),
    ),
    OctaveSegments(rank=Rank.TO_KNOW, longest=80.0, n_effective=12.0, below=1.0, only_one=False),
    ChannelsClipped(rank=Rank.INVALIDATES, channels=("A.X",), shares=(0.046,)),
    ChannelsWrap(rank=Rank.INVALIDATES, channels=("A.X",), bits=(16,)),
    CodesMissing(
        rank=Rank.DELAYS,
        channels=("A.X", "A.Y"),
        steps=(256, 1),
        n_missing=(0, 0),
        stuck_bits=((), (3,)),
        bits=(11.3, 9.0),
    ),
    ReadingsRepeat(rank=Rank.INVALIDATES, sensors=A, share=0.6, refresh=20.0, polled=50.0),
    ChannelsStoodStill(rank=Rank.INVALIDATES, channels=("A.X",), constant=(30.0,)),
    SensitivitiesDiffer(rank=Rank.DELAYS, channels=("A.X",), share=0.2),
    CertificateDiffers(
        rank=Rank.DELAYS, sensors=("A",), channels=("A.X",), factors=(9.80665,), is_refuted=True
    ),
    ClocksFitted(rank=Rank.TO_KNOW, sensors=A, ppm=(4.5,), error=2e-6),
    StatedTimesDrift(
        rank=Rank.INVALIDATES,
        sensors=("A", "B"),
        corrected={"A": 1e-4},
        uncorrected={"B": 2e-4},
        left=3e-6,
        reference="C",
    ),
    NotLinear(
        rank=Rank.DELAYS,
        sensors=A,
        channels=("A.X",),
        shares=(0.6,),
        evidence=22.0,
        is_subtracted=False,
    ),
    NoiseDependsOnMotion(
        rank=Rank.DELAYS,
        sensors=A,
        channels=("A.X",),
        band=(12.0, 45.0),
        form="instants",
        evidence=8.0,
        instants=3e-5,
    ),
    RoundedAlike(rank=Rank.DELAYS, channels=("A.X", "B.X"), share=0.24),
    StatedTimesUnchecked(rank=Rank.DELAYS, sensors=A),
    ClockSet(
        rank=Rank.TO_KNOW,
        sensors=A,
        settings=(ClockSetting(NOON, -0.5),),
        time_utc_ns=(NOON, NOON),
    ),
    SamplesUncounted(
        rank=Rank.DELAYS,
        sensors=A,
        slips=(Uncounted(NOON, 1.0, 1),),
        time_utc_ns=(NOON, NOON),
    ),
    ClockNotUnderstood(rank=Rank.INVALIDATES, sensors=A, ppm=-985.0, error=1e-3),
    RatesNominal(rank=Rank.DELAYS, sensors=A),
    Polled(rank=Rank.DELAYS, sensors=A, uneven=2e-3, share=0.4, above=25.0, is_loud=True),
    ClocksMayExplain(rank=Rank.DELAYS, sensors=A, error=7e-3),
    NoEstimateAbove(rank=Rank.TO_KNOW, band=(90.0, 100.0)),
    ModelUntested(
        rank=Rank.DELAYS,
        why=Untested.TOO_FEW_AVERAGES,
        n_effective=7.0,
        n_channels=9,
        n_factors=3,
        dims=(3, 3, 3),
    ),
    ModelPasses(rank=Rank.TO_KNOW, n_factors=3, dims=(3, 3, 3)),
    DimensionsChosen(rank=Rank.TO_KNOW, choices=(), usual=3, elsewhere=True),
    DimensionsUnexplained(rank=Rank.INVALIDATES, bands=((1.0, 2.0), (2.0, 4.0))),
    DimensionsUndetermined(rank=Rank.INVALIDATES, bands=((1.0, 2.0),), usual=3, n_sensors=5),
    SharedByTwo(
        rank=Rank.DELAYS,
        sensors=("A", "B"),
        bands=((1.0, 2.0), (2.0, 4.0)),
        alternatives=(("C", "D"),),
        part=0.94,
    ),
    SharedNoiseNotSearched(rank=Rank.TO_KNOW, n_channels=120, most=96),
    SteadinessNotTested(rank=Rank.TO_KNOW, causes=("archives",), is_open=False),
    FewerFrequencies(rank=Rank.TO_KNOW, n=303, n_frequencies=499),
    LikeChannelsAssumed(rank=Rank.TO_KNOW, method="two-channel"),
    DirectionsPooled(
        rank=Rank.TO_KNOW, method="three-sensor", band=(10.0, 20.0), n=21, n_frequencies=199
    ),
    ValuesBelowZero(rank=Rank.TO_KNOW, method="three-sensor", n=5, n_values=900),
    IntervalsWidened(rank=Rank.TO_KNOW, method="three-sensor", shares={Source.CLOCKS: 0.05}),
    NoiseInGusts(rank=Rank.TO_KNOW, channels=("A.X",), size=0.45, lasts=9.5, wider=1.1),
    TargetMissed(rank=Rank.DELAYS, cov=0.2, target=0.1, total=7200.0),
    WrongSensitivity(
        rank=Rank.INVALIDATES,
        sensors=("C",),
        channels=("C.X", "C.Y"),
        gains=(0.101, 0.103),
        standard_errors=(0.001, 0.001),
        against=("A", "B"),
        cause=Cause.GRAVITY,
    ),
    LimitUndecided(rank=Rank.DELAYS, channels=("A.X",), obstacle=Obstacle.CLOCKS, limits=("NLNM",)),
    LimitNotJudged(rank=Rank.TO_KNOW, limit="NLNM", covers=(0.1, 100.0), judged=(0.2, 90.0)),
    SensorOverdue(
        rank=Rank.INVALIDATES,
        sensors=A,
        state=SensorState.SILENT,
        overdue=34.0,
        reason="",
        is_closed=False,
    ),
    ChannelsStuck(rank=Rank.INVALIDATES, channels=("A.X",), is_now=True),
    SensorClipping(rank=Rank.DELAYS, sensors=A, are_kept=False),
    RecordingsLeftOut(rank=Rank.DELAYS, sensors=A, recordings=("/archive/night.h5",)),
    SpectraUnreadable(rank=Rank.DELAYS, files=("Damaged.",)),
    ResponsesVary(rank=Rank.DELAYS, channels=("A.X", "A.Y"), share=0.86),
    ChangesUndecided(rank=Rank.DELAYS, n_days=2, needed=8),
    ChangesNotTested(rank=Rank.TO_KNOW, n_segments=120),
    AbsencesNotUsed(rank=Rank.TO_KNOW, channels=("A.X", "B.Y"), n_segments=(120, 40)),
    StretchesLeftOut(rank=Rank.TO_KNOW, n_stretches=6),
    NightsNotCompared(rank=Rank.TO_KNOW, needed=3),
)


def kinds(base: type[Any] = Fact) -> set[type[Any]]:
    """Return all kinds; of a class with slots, not the one that it was made from."""
    children: set[type[Any]] = {
        each
        for each in base.__subclasses__()
        if getattr(sys.modules[each.__module__], each.__name__, None) is each
    }
    return children | {each for child in children for each in kinds(child)}
