"""One fact of each kind."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from daq.clocks.clock_model import ClockSetting
from daq.protocols.block import Uncounted
from daq.recording.sensor_state import SensorState
from daq.results import facts
from daq.results.facts import Fact, Rank
from estimator.checks.advice import Untested
from estimator.checks.sensitivities import Cause
from estimator.decision.verdict import Obstacle
from estimator.levels.contributions import Source
from estimator.self_noise.result import Flag, Refusal
from estimator.spectra.segment_rejection import Reason
from tests.tui.wording.advice_examples import MISFIT

if TYPE_CHECKING:
    from types import ModuleType

A, NOON = ("A",), 1_700_000_000_000_000_000

EXAMPLES: tuple[Fact, ...] = (
    facts.Finding(rank=Rank.INVALIDATES, findings=(MISFIT,)),
    facts.SensorsSimulated(rank=Rank.TO_KNOW),
    facts.FewSensors(rank=Rank.DELAYS, n_sensors=1),
    facts.PairCompared(
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
    facts.SteadyGainsAssumed(rank=Rank.TO_KNOW, method="multi-part", share=0.001),
    facts.NoiseNotIdentified(
        rank=Rank.DELAYS,
        method="multi-part",
        channels=("A.X",),
        band=(0.1, 1.0),
        refusal=Refusal.STEADY,
        change=0.4,
        axis="A.Z",
    ),
    facts.NoisePartShared(
        rank=Rank.DELAYS,
        sensors=("A", "B"),
        band=(1.0, 3.0),
        share=0.4,
        share_error=0.02,
        is_known=False,
    ),
    facts.MethodsDiffer(
        rank=Rank.DELAYS,
        method="three-sensor",
        channels=("A.X",),
        band=(1.0, 3.0),
        difference=1.2,
    ),
    facts.MethodRefused(rank=Rank.DELAYS, method="two-channel", reason="channels differ"),
    facts.WithoutEstimate(
        rank=Rank.DELAYS,
        method="three-sensor",
        channels=("A.X",),
        flag=Flag.SINGULAR,
        most=3,
        n_frequencies=9,
    ),
    facts.NoSegmentUsable(
        rank=Rank.INVALIDATES, sensors=A, segment=10.0, reason=Reason.GAP, longest=4.0
    ),
    facts.NotInLiveEstimate(rank=Rank.TO_KNOW, sensors=A, n_all=3),
    facts.SensorLost(
        rank=Rank.DELAYS,
        sensors=A,
        time_utc_ns=(NOON, NOON + 397 * 10**9),
        missing=397.0,
        never_seen=False,
    ),
    facts.BlocksDamaged(rank=Rank.DELAYS, sensors=A, n_blocks=2),
    facts.SpanShortened(rank=Rank.DELAYS, sensors=A, seconds=300.0, at_end=False),
    facts.SamplesMissing(rank=Rank.TO_KNOW, sensors=A, n_gaps=2, n_samples=40),
    facts.SegmentsExcluded(rank=Rank.TO_KNOW, n_segments=3, reasons={Reason.CLIPPED: 3}),
    facts.GapsBridged(rank=Rank.TO_KNOW, n_segments=4, lost=0.02, leakage=0.01),
    facts.ChannelsAbsent(
        rank=Rank.TO_KNOW,
        channels=("A.X",),
        n_segments=(40,),
        most=60,
        complete_only=("two-channel", "three-channel"),
    ),
    facts.OctaveSegments(
        rank=Rank.TO_KNOW, longest=80.0, n_effective=12.0, below=1.0, only_one=False
    ),
    facts.ChannelsClipped(rank=Rank.INVALIDATES, channels=("A.X",), shares=(0.046,)),
    facts.ChannelsWrap(rank=Rank.INVALIDATES, channels=("A.X",), bits=(16,)),
    facts.CodesMissing(
        rank=Rank.DELAYS,
        channels=("A.X", "A.Y"),
        steps=(256, 1),
        n_missing=(0, 0),
        stuck_bits=((), (3,)),
        bits=(11.3, 9.0),
    ),
    facts.ReadingsRepeat(rank=Rank.INVALIDATES, sensors=A, share=0.6, refresh=20.0, polled=50.0),
    facts.ChannelsStoodStill(rank=Rank.INVALIDATES, channels=("A.X",), seconds=(30.0,)),
    facts.ClocksFitted(rank=Rank.TO_KNOW, sensors=A, ppm=(4.5,), error=2e-6),
    facts.StatedTimesDrift(
        rank=Rank.INVALIDATES,
        sensors=("A", "B"),
        corrected={"A": 1e-4},
        uncorrected={"B": 2e-4},
        left=3e-6,
        reference="C",
    ),
    facts.NotLinear(
        rank=Rank.DELAYS,
        sensors=A,
        channels=("A.X",),
        shares=(0.6,),
        evidence=22.0,
        is_subtracted=False,
    ),
    facts.RoundedAlike(rank=Rank.DELAYS, channels=("A.X", "B.X"), share=0.24),
    facts.StatedTimesUnchecked(rank=Rank.DELAYS, sensors=A),
    facts.ClockSet(
        rank=Rank.TO_KNOW,
        sensors=A,
        settings=(ClockSetting(NOON, -0.5),),
        time_utc_ns=(NOON, NOON),
    ),
    facts.SamplesUncounted(
        rank=Rank.DELAYS,
        sensors=A,
        slips=(Uncounted(NOON, 1.0, 1),),
        time_utc_ns=(NOON, NOON),
    ),
    facts.ClockNotUnderstood(rank=Rank.INVALIDATES, sensors=A, ppm=-985.0, error=1e-3),
    facts.RatesNominal(rank=Rank.DELAYS, sensors=A),
    facts.ClocksMayExplain(rank=Rank.DELAYS, sensors=A, error=7e-3),
    facts.NoEstimateAbove(rank=Rank.TO_KNOW, band=(90.0, 100.0)),
    facts.ModelUntested(
        rank=Rank.DELAYS,
        why=Untested.TOO_FEW_AVERAGES,
        n_effective=7.0,
        n_channels=9,
        n_factors=3,
        dims=(3, 3, 3),
    ),
    facts.ModelPasses(rank=Rank.TO_KNOW, n_factors=3, dims=(3, 3, 3)),
    facts.DimensionsChosen(rank=Rank.TO_KNOW, choices=(), usual=3, elsewhere=True),
    facts.DimensionsUnexplained(rank=Rank.INVALIDATES, bands=((1.0, 2.0), (2.0, 4.0))),
    facts.DimensionsUndetermined(rank=Rank.INVALIDATES, bands=((1.0, 2.0),), usual=3, n_sensors=5),
    facts.SharedNoiseNotSearched(rank=Rank.TO_KNOW, n_channels=120, most=96),
    facts.SteadinessNotTested(rank=Rank.TO_KNOW, causes=("archives",)),
    facts.LikeChannelsAssumed(rank=Rank.TO_KNOW, method="two-channel"),
    facts.DirectionsPooled(
        rank=Rank.TO_KNOW, method="three-sensor", band=(10.0, 20.0), n=21, n_frequencies=199
    ),
    facts.ValuesBelowZero(rank=Rank.TO_KNOW, method="three-sensor", n=5, n_values=900),
    facts.IntervalsWidened(rank=Rank.TO_KNOW, method="three-sensor", shares={Source.CLOCKS: 0.05}),
    facts.TargetMissed(rank=Rank.DELAYS, cov=0.2, target=0.1, total=7200.0),
    facts.WrongSensitivity(
        rank=Rank.INVALIDATES,
        sensors=("C",),
        channels=("C.X", "C.Y"),
        gains=(0.101, 0.103),
        errors=(0.001, 0.001),
        against=("A", "B"),
        cause=Cause.GRAVITY,
    ),
    facts.LimitUndecided(
        rank=Rank.DELAYS, channels=("A.X",), obstacle=Obstacle.CLOCKS, limits=("NLNM",)
    ),
    facts.LimitNotJudged(rank=Rank.TO_KNOW, limit="NLNM", covers=(0.1, 100.0), judged=(0.2, 90.0)),
    facts.SensorOverdue(
        rank=Rank.INVALIDATES,
        sensors=A,
        state=SensorState.SILENT,
        overdue=34.0,
        reason="",
        is_closed=False,
    ),
    facts.ChannelsStuck(rank=Rank.INVALIDATES, channels=("A.X",), is_now=True),
    facts.SensorClipping(rank=Rank.DELAYS, sensors=A, are_kept=False),
    facts.RecordingsLeftOut(rank=Rank.DELAYS, sensors=A, recordings=("/archive/night.h5",)),
    facts.SpectraUnreadable(rank=Rank.DELAYS, files=("Damaged.",)),
    facts.ChangesUndecided(rank=Rank.DELAYS, n_days=2, needed=8),
    facts.AbsencesNotUsed(rank=Rank.TO_KNOW, channels=("A.X", "B.Y"), n_segments=(120, 40)),
    facts.StretchesLeftOut(rank=Rank.TO_KNOW, n_stretches=6),
    facts.NightsNotCompared(rank=Rank.TO_KNOW, needed=3),
)


def kinds(base: type[Any] = Fact, *modules: ModuleType) -> set[type[Any]]:
    """Return all kinds; of a class with slots, not the one that it was made from."""
    places = modules or (facts,)
    children: set[type[Any]] = {
        each
        for each in base.__subclasses__()
        if any(getattr(place, each.__name__, None) is each for place in places)
    }
    return children | {each for child in children for each in kinds(child, *modules)}
