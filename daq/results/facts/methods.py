"""What the methods assume, and where they give nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from daq.estimation.contributions import is_untested
from daq.estimation.snapshot import Snapshot
from daq.results.band_summary import known_range
from daq.results.facts.changes import facts_of_changes
from daq.results.facts.fact import Fact
from daq.results.facts.model import _is_young
from daq.results.vocabulary import FLAG_WORDS
from estimator.checks.advice import Rank
from estimator.checks.advice_on_signals import Copies, MissingChannels, NoSharedMotion, NoSignal
from estimator.checks.shared_noise import MAX_CHANNELS
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from estimator.types import BoolArray
from estimator.wording import Words, few, listed

WITHOUT_ESTIMATE = (
    Flag.DEAD_CHANNEL
    | Flag.DUPLICATE
    | Flag.NOT_FINITE
    | Flag.INVALID
    | Flag.SINGULAR
    | Flag.NO_COUNTERPART
)
"""Flags of frequencies that have no estimate."""


_REMEDIES = {
    Flag.DEAD_CHANNEL: "check cable and power",
    Flag.DUPLICATE: "check ports and bench file",
    Flag.SINGULAR: "record with more motion",
    Flag.NO_COUNTERPART: "use --method maximum-likelihood",
    Flag.NOT_CONVERGED: "record longer",
}


_NO_FLAG = Flag(0)


ARCHIVES, FEW = "archives", "so few averages"
TOO_LITTLE = f"{FEW}, or motion so weak"
"""Causes of `SteadinessNotTested`."""


class MethodRefused(Fact):
    """A method gives no result.

    Attributes
    ----------
    reason : str
        A sentence of the estimator's error.
    """

    reason: str

    def _words(self) -> Words:
        return Words(f"{self.method}: {self.reason}", f"{self.method}: {self.reason}")


class WithoutEstimate(Fact):
    """Frequencies of `channels` have no valid estimate by `method`.

    Attributes
    ----------
    flag : Flag
    most, n_frequencies : int
        Frequencies of the worst channel that are concerned, and all frequencies.
    """

    flag: Flag
    most: int
    n_frequencies: int

    def _words(self) -> Words:
        who, words = ", ".join(self.channels), FLAG_WORDS[self.flag]
        whole = self.most == self.n_frequencies
        at = "all frequencies" if whole else f"{self.most} of {self.n_frequencies} frequencies"
        text = f"{self.method}: {who}: {words.long}, at {at}"
        line = f"{self.method}: {few(self.channels)}: {words.short}, at {at}"
        do = _REMEDIES.get(self.flag, "check the recording")
        return Words(f"{line}: {do}", f"{text}.", f"{do[0].upper()}{do[1:]}.")


class NoEstimateAbove(Fact):
    """There is no estimate in `band`, where resampling attenuates."""

    def _words(self) -> Words:
        limit = math.nan if self.band is None else self.band[0]
        text = f"no estimate above {limit:.4g} Hz, where resampling attenuates"
        return Words(text, f"{text[0].upper()}{text[1:]}.")


class FewerFrequencies(Fact):
    """Responses change, and averages within parts of time are kept at `n` of `n_frequencies`."""

    n: int
    n_frequencies: int

    def _words(self) -> Words:
        text = (
            f"averages within parts of time, between which a response changes, are kept at {self.n}"
            f" of {self.n_frequencies} frequencies: curves have gaps"
        )
        return Words(text, f"{text[0].upper()}{text[1:]}.")


class SharedNoiseNotSearched(Fact):
    """Noise that two channels share is not searched for among so many channels."""

    n_channels: int
    most: int

    def _words(self) -> Words:
        text = (
            f"noise that two channels share is not searched for among more than {self.most} "
            f"channels, to limit the memory; these are {self.n_channels}"
        )
        return Words(text, f"{text[0].upper()}{text[1:]}.")


class SteadinessNotTested(Fact):
    """Whether noise and responses change during the recording is not tested; `causes` are why.

    In an archive, which keeps no samples, it is linearity and the rounding that channels share.

    Attributes
    ----------
    causes : tuple of str
    is_open : bool
        Whether intervals have no lower end, as motion is strong and averages are few.
    """

    causes: tuple[str, ...]
    is_open: bool

    def _words(self) -> Words:
        what, bench = "Whether noise or responses change is not tested", "a steady bench"
        if ARCHIVES in self.causes:
            what = "Linearity and shared rounding are not tested"
            bench = "linear sensors and fine counts"
        text = f"{what} with {listed(self.causes)}"
        if self.is_open:
            return Words(
                "The test of steadiness needs more averages: record longer",
                f"{text}: the intervals have no lower end.",
                "Record longer.",
            )
        return Words(text, f"{text}: the intervals hold for {bench}.")


class LikeChannelsAssumed(Fact):
    """The two-channel method assumes parallel like channels with known gains."""

    def _words(self) -> Words:
        text = (
            f"{self.method}: assumes that like channels are parallel and have equal gains, or "
            "those given by --gain"
        )
        return Words(text, f"{text}.")


class DirectionsPooled(Fact):
    """Directions of the motion come from neighbouring frequencies, at `n` of `n_frequencies`."""

    n: int
    n_frequencies: int

    def _words(self) -> Words:
        at = "" if self.band is None else f" ({self.band[0]:.3g} to {self.band[1]:.3g} Hz)"
        text = (
            f"{self.method}: single frequencies do not resolve the motion at {self.n} of"
            f" {self.n_frequencies}{at}"
        )
        return Words(text, f"{text}; its directions are taken from neighbouring frequencies there.")


class ValuesBelowZero(Fact):
    """Values of the noise PSD are at or below zero, `n` of `n_values`."""

    n: int
    n_values: int

    def _words(self) -> Words:
        text = (
            f"{self.method}: {self.n} of {self.n_values} values {'is' if self.n == 1 else 'are'} "
            "at or below zero"
        )
        return Words(text, f"{text}.")


def facts_of_methods(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield what the methods assume, and where they give nothing."""
    advice, found = snapshot.diagnostics.advice, snapshot.diagnostics.diagnosis
    limit, highest = known_range(snapshot)[1], float(snapshot.frequency[-1])
    if 0 < limit < highest:  # 0 before the first segment
        yield NoEstimateAbove(rank=Rank.TO_KNOW, band=(limit, highest))
    if (n := len(snapshot.channels)) > MAX_CHANNELS:
        yield SharedNoiseNotSearched(rank=Rank.TO_KNOW, n_channels=n, most=MAX_CHANNELS)
    causes = (
        ("--octaves", bool(snapshot.octaves)),
        ("--reject", bool(snapshot.left_out.get(Reason.TRANSIENT))),
        ("segments with gaps", snapshot.bridged is not None),
        (ARCHIVES, not snapshot.sensors),  # of which no averages know
    )
    if found is not None and found.stability is None:
        is_open = is_untested(snapshot)
        names = tuple(name for name, holds in causes if holds) or (FEW if is_open else TOO_LITTLE,)
        alone = is_open and snapshot.closed and snapshot.diagnostics.untested is None
        rank = Rank.DELAYS if alone else Rank.TO_KNOW
        yield SteadinessNotTested(rank=rank, causes=names, is_open=is_open)
    yield from facts_of_changes(snapshot)
    kept = _kept_within_parts(snapshot)
    if snapshot.results and not kept.all():
        n = int(kept.sum())
        yield FewerFrequencies(rank=Rank.TO_KNOW, n=n, n_frequencies=len(kept))
    if "two-channel" in snapshot.results:
        yield LikeChannelsAssumed(rank=Rank.TO_KNOW, method="two-channel")
    named = any(isinstance(each, NoSignal | Copies) for each in advice)  # once for all methods
    hidden = Flag.DEAD_CHANNEL | Flag.DUPLICATE if named else Flag(0)
    explained = named and any(isinstance(each, MissingChannels) for each in advice)
    alone = any(isinstance(each, NoSharedMotion) for each in advice)
    for method, noise in snapshot.results.items():
        lacks = Flag.SINGULAR if explained and method == "three-sensor" else Flag(0)
        yield from without_estimate(snapshot, method, besides=hidden | lacks)
        pooled = ((noise.flags[1:-1] & Flag.POOLED) != 0).any(axis=1)
        if pooled.any() and not alone:  # a longer recording would not help sensors alone
            frequency = snapshot.frequency[1:-1][pooled]
            yield DirectionsPooled(
                rank=Rank.TO_KNOW,
                method=method,
                band=(float(frequency[0]), float(frequency[-1])),
                n=int(pooled.sum()),
                n_frequencies=len(pooled),
            )
        values = noise.noise_psd[1:-1]
        if n := int(np.sum(values <= 0)):
            yield ValuesBelowZero(rank=Rank.TO_KNOW, method=method, n=n, n_values=values.size)
    grows = not snapshot.closed  # it may come yet
    rank = Rank.DELAYS if snapshot.results or grows else Rank.INVALIDATES
    if grows and _is_young(snapshot):
        rank = Rank.TO_KNOW
    for method, reason in snapshot.refused.items():
        yield MethodRefused(rank=rank, method=method, reason=reason)


def _kept_within_parts(snapshot: Snapshot) -> BoolArray:
    """Return where there are averages within parts, (n_freqs,); everywhere without such."""
    found = snapshot.diagnostics.diagnosis
    if found is None or found.stability is None or not any(found.stability.steadied):
        return np.ones(len(snapshot.frequency), np.bool_)
    kept = np.asarray(np.isfinite(snapshot.csm).all(axis=(1, 2)))
    kept[[0, -1]] = True
    return kept


def without_estimate(
    snapshot: Snapshot, method: str, *, besides: Flag = _NO_FLAG
) -> Iterator[WithoutEstimate]:
    """Yield channels with frequencies without a valid estimate; flags in ``besides`` are left out.

    Above the highest frequency that is known, that is one fact of its own; below the lowest, the
    trend is removed.
    """
    low, high = known_range(snapshot)
    inside = (snapshot.frequency >= low) & (snapshot.frequency < high)
    inside &= _kept_within_parts(snapshot)
    flags = snapshot.results[method].flags[inside]
    for flag in Flag:
        if not flag & (WITHOUT_ESTIMATE | Flag.NOT_CONVERGED) & ~besides:
            continue
        counts = ((flags & flag) != 0).sum(axis=0)
        if counts.any():
            n_freqs = len(flags)
            whole = bool(counts.max() == n_freqs) and bool(flag & WITHOUT_ESTIMATE)
            yield WithoutEstimate(
                rank=Rank.INVALIDATES if whole else Rank.DELAYS,
                method=method,
                channels=tuple(
                    label.name
                    for label, count in zip(snapshot.channels, counts, strict=True)
                    if count
                ),
                flag=flag,
                most=int(counts.max()),
                n_frequencies=n_freqs,
            )
