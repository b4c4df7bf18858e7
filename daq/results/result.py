"""What an estimate says: the one object that every front end holds.

A front end that derived a band mean, a fact or a verdict for itself could leave out what another
one states. So each is derived here, when it is first asked for, and kept.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from daq.results.band_summary import Estimate
from daq.results.clock_effect import effect_by_sensor
from daq.results.decision.end import remaining
from daq.results.decision.verdict import facts_of_verdict
from daq.results.facts.all_facts import facts_of, ranked
from estimator.records import dataclass

if TYPE_CHECKING:
    from pathlib import Path

    from daq.bench.end_condition import EndCondition
    from daq.bench.model import Bench
    from daq.results.decision.end import Remaining
    from daq.results.decision.verdict import TestVerdict
    from daq.results.facts.fact import Fact
    from daq.results.sources import Source
    from daq.results.standing import PairCoherence


@dataclass(frozen=True, eq=False)
class Result(Estimate):
    """An estimate with what it is judged by and made from.

    Attributes
    ----------
    bench : Bench or None
        With the limits.
    recordings : tuple of Path
        It was made from; none for arrays.
    examined : tuple of Source
        The recordings as they were read before; read when first asked for, if not given.
    """

    bench: Bench | None = None
    recordings: tuple[Path, ...] = ()
    examined: tuple[Source, ...] = ()

    @cached_property
    def sources(self) -> tuple[Source, ...]:
        """What the recordings say of themselves, checksums included.

        Raises
        ------
        RecordingError
            If one cannot be read.
        """
        from daq.results.sources import sources  # noqa: PLC0415 - few ask for it

        return self.examined or sources(self.recordings)

    @cached_property
    def verdict(self) -> TestVerdict | None:
        """On the limits of the bench; None without limits."""
        if self.bench is None or not self.bench.limits:
            return None
        from daq.results.decision.limits import judge  # noqa: PLC0415 - most benches have none

        return judge(self.bench, self)

    @cached_property
    def concern(self) -> tuple[float, float] | None:
        """The band asked for, widened to all that limits judge."""
        asked = self.settings.band
        if asked is None or self.bench is None or not self.bench.limits:
            return asked
        points = [each.mask.frequency for each in self.bench.limits]
        return min([asked[0], *(e[0] for e in points)]), max([asked[1], *(e[-1] for e in points)])

    @cached_property
    def facts(self) -> tuple[Fact, ...]:
        """What is known beside the numbers, the worst rank first; not those of the verdict."""
        return ranked(facts_of(self), self)

    @cached_property
    def all_facts(self) -> tuple[Fact, ...]:
        """With those of the verdict."""
        found = self.verdict
        return ranked([*self.facts, *(() if found is None else facts_of_verdict(found))], self)

    @cached_property
    def coherence(self) -> PairCoherence | None:
        """Coherence of all pairs of sensors: `pair_coherence`."""
        from daq.results.standing import pair_coherence  # noqa: PLC0415 - few ask for it

        return pair_coherence(self)

    @cached_property
    def clock_effects(self) -> dict[str, float]:
        """Share of each sensor's noise that comes from clocks: `effect_by_sensor`."""
        return effect_by_sensor(self)

    def remaining(self, end: EndCondition, elapsed: float) -> Remaining:
        """Return how long the recording still takes, `elapsed` seconds after its start."""
        return remaining(end, self.verdict, self, elapsed=elapsed)

    def is_reached(self, end: EndCondition) -> bool:
        """Return whether a test is to end now by its live estimate; its recorder ends by time."""
        if end.cov is not None and self.precision().cov <= end.cov:
            return True
        return end.decided and self.verdict is not None and self.verdict.is_sure
