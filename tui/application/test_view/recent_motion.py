"""Sensors that left their place during a test: the averages of the last minute. No Textual here.

The longer a test, the longer its averages take to show that a sensor has been moved. The averages
since an earlier snapshot are the difference of two sums: ``(n2 S2 - n1 S1) / (n2 - n1)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from daq.estimation.snapshot import Snapshot
from estimator.checks.advice import Rank
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.shared_motion import CanonicalCoherence, outsiders, shared_motion
from estimator.types import ComplexArray

SPAN = 60.0
"""Seconds that are looked at, at least."""
SNAPSHOT_INTERVAL = 15.0
"""Seconds from one kept snapshot to the next."""
UPDATE_INTERVAL = 5.0
"""Seconds from one look to the next."""
AVERAGES = 4
"""Averages for each channel of a sensor, at least."""


@dataclass(frozen=True, slots=True)
class _Sum:
    elapsed: float
    n_segments: int
    csm: ComplexArray


class RecentMotion:
    """Compares each snapshot of a growing recording with one of a minute before."""

    def __init__(self) -> None:
        self._kept: list[_Sum] = []
        self._looked = -UPDATE_INTERVAL
        self._found: tuple[NoSharedMotion, ...] = ()

    def strangers(self, snapshot: Snapshot) -> tuple[NoSharedMotion, ...]:
        """Return the sensors that recently recorded none of the motion that others share.

        Parameters
        ----------
        snapshot : Snapshot
            Later than those before. Its diagnosis names the bands that are looked at.
        """
        if snapshot.elapsed - self._looked < UPDATE_INTERVAL:
            return self._found
        self._looked = snapshot.elapsed
        now = _Sum(snapshot.elapsed, snapshot.n_segments, snapshot.csm)
        kept = [each for each in self._kept if each.csm.shape == now.csm.shape]
        while len(kept) > 1 and kept[1].elapsed <= now.elapsed - SPAN:
            del kept[0]
        self._kept = kept
        if not kept or now.elapsed - kept[-1].elapsed >= SNAPSHOT_INTERVAL:
            self._kept = [*kept, now]
        is_long = bool(kept) and kept[0].elapsed <= now.elapsed - SPAN
        self._found = _strangers(snapshot, kept[0], now) if is_long else ()
        return self._found


def with_advice(snapshot: Snapshot, found: tuple[NoSharedMotion, ...]) -> Snapshot:
    """Return a snapshot whose diagnosis has this advice as well: no verdict is given then."""
    diagnosis = snapshot.diagnostics.diagnosis
    if diagnosis is None or not found:
        return snapshot
    diagnosis = replace(diagnosis, advice=(*found, *diagnosis.advice))
    return replace(snapshot, diagnostics=replace(snapshot.diagnostics, diagnosis=diagnosis))


def _strangers(snapshot: Snapshot, before: _Sum, now: _Sum) -> tuple[NoSharedMotion, ...]:
    diagnosis, n_new = snapshot.diagnostics.diagnosis, now.n_segments - before.n_segments
    n_effective = snapshot.n_effective * n_new / max(now.n_segments, 1)
    if diagnosis is None or snapshot.octaves or n_effective < AVERAGES * max(snapshot.dims):
        return ()
    recent = (now.n_segments * now.csm - before.n_segments * before.csm) / n_new
    canonical = CanonicalCoherence(recent)
    found: dict[int, NoSharedMotion] = {}
    lowest: dict[int, float] = {}
    for band in diagnosis.bands:
        inside = (snapshot.frequency >= band.low) & (snapshot.frequency <= band.high)
        share = shared_motion(canonical, snapshot.dims, inside, n_effective)
        for sensor, partners in outsiders(share, n_effective, int(inside.sum())):
            found[sensor] = NoSharedMotion(
                rank=Rank.INVALIDATES,
                sensors=(sensor,),
                band=(lowest.setdefault(sensor, band.low), band.high),
                partners=partners,
                share=max(0.0, *(float(share[sensor, j]) for j in partners)),
                share_of_partners=min(
                    float(share[j, k]) for j in partners for k in partners if j < k
                ),
            )
    known = {
        sensor
        for each in snapshot.diagnostics.advice
        if isinstance(each, NoSharedMotion)
        for sensor in each.sensors
    }
    return tuple(found[sensor] for sensor in sorted(found.keys() - known))
