"""The segments of one recording, taken in order."""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import datetime
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from daq.bench.durations import stretch
from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.grid import OwnSamples
from daq.clocks.sensor_reader import GrowingRows
from daq.estimation.segments import forked
from daq.estimation.segments.clipping import in_clipped_blocks
from daq.estimation.segments.delay_measurement import DelayMeasurement
from daq.estimation.segments.flatline import FlatlineDetector, stands_still
from daq.estimation.segments.own_spectra import OwnSpectra, need_samples_of_grid
from daq.estimation.segments.stated_times import agree, compare
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Overlap
from daq.recording.interface import ReadableRecording, at_rates, created_at
from estimator.records import dataclass
from estimator.spectra.channel_sets import ChannelSets
from estimator.spectra.equaliser import Equaliser
from estimator.spectra.multiresolution import MultiResolution
from estimator.spectra.parts import MOST, PartEnds, Parts, PieceEnds, by_part, part_bins
from estimator.spectra.segment_rejection import Reason, RejectionSettings, SelectedSpectra
from estimator.spectra.welch import (
    CrossSpectra,
    SegmentSpectra,
    WelchSettings,
    Work,
    kept_bins,
)
from estimator.spectra.windows import (
    WindowLeakage,
    effective_averages,
    gap_window,
    get_window,
    without_trend,
)

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]


def surrounded(usable: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return which samples, `reach` from either end, have usable ones as far as that around."""
    return whole_segments(usable, np.arange(len(usable) - 2 * reach), 2 * reach + 1)


def whole_segments(
    usable: NDArray[np.bool_], starts: NDArray[np.int64], length: int
) -> NDArray[np.bool_]:
    """Return which segments have usable samples only."""
    if usable.all():
        return np.ones(len(starts), dtype=np.bool_)
    missing = np.concatenate([[0], np.cumsum(~usable)])
    return np.asarray(missing[starts + length] == missing[starts])


_Piece = TypeVar("_Piece")
_Span = tuple[int, int]
_NEAR = 0.05  # samples by which a stretch may begin or end later: fitted clocks are off by some µs
_Read = TypeVar("_Read")

_READERS = 2  # pieces being read while one is worked on: no more than that exist, with this one


def read_ahead(read: Callable[[_Piece], _Read], pieces: Sequence[_Piece]) -> Generator[_Read]:
    """Read pieces in order, the next ones while the one before is worked on."""
    if len(pieces) < 2:
        yield from map(read, pieces)
        return
    with ThreadPoolExecutor(_READERS) as pool:
        coming: deque[Future[_Read]] = deque()
        for piece in pieces:
            coming.append(pool.submit(read, piece))
            if len(coming) > _READERS:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


MOST_VALUES = 1 << 19
"""Samples times channels that are kept, or transformed ahead, at most: 4 MB."""


class NewestSamples:
    """Reads a recording's grid without reading twice what overlaps, as long as its clocks stay."""

    def __init__(self, aligned: AlignedRecording) -> None:
        self._aligned = aligned
        self._begin = self._n_settings = 0
        self._samples, self._valid = np.empty((0, 0)), np.empty(0, dtype=np.bool_)

    def read(self, begin: int, end: int) -> tuple[FloatArray, BoolArray]:
        """Return grid samples, and whether each is valid, as `AlignedRecording.read` does."""
        known = self._begin + len(self._samples)
        if self._n_settings == self._aligned.n_settings and self._begin <= begin < known <= end:
            new, new_valid = self._aligned.read(known, end)
            samples = np.concatenate([self._samples[begin - self._begin :], new])
            valid = np.concatenate([self._valid[begin - self._begin :], new_valid])
        else:
            samples, valid = self._aligned.read(begin, end)
        if samples.size <= MOST_VALUES:
            self._begin, self._n_settings = begin, self._aligned.n_settings
            self._samples, self._valid = samples.copy(order="K"), valid
        return samples, valid


class GapBridge:
    """Spectra of segments with gaps, and what their windows bring in.

    Parameters
    ----------
    welch : WelchSettings
    n_channels : int
    most : float
        Share of a segment that gaps may take, with the ramps beside them.
    """

    def __init__(self, welch: WelchSettings, n_channels: int, *, most: float) -> None:
        self._welch, self._most = welch, most
        self.spectra = CrossSpectra(welch, n_channels)
        self.leakage = WindowLeakage(get_window(welch.window, welch.segment_length))

    def take(
        self,
        samples: FloatArray,
        usable: NDArray[np.bool_],
        clipped: NDArray[np.bool_] | None,
        starts: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Take the segments at `starts` that have short gaps and are not clipped; return which."""
        length = self._welch.segment_length
        segments, taken = [np.empty((0, samples.shape[1]))], []
        for start in starts.tolist():
            span = slice(start, start + length)
            weight = gap_window(usable[span], length)
            if np.count_nonzero(weight < 1) > self._most * length:
                continue
            if clipped is not None and (clipped[span] & usable[span]).any():
                continue
            segment = without_trend(samples[span], weight, self._welch.detrend)
            segments.append(segment / np.sqrt(self.leakage.add(weight)))
            taken.append(start)
        self.spectra.add(np.concatenate(segments), np.arange(len(taken)) * length)
        return np.array(taken, dtype=np.int64)


_VALUES_AT_ONCE = 1 << 18  # samples times channels read together: 2 MB
OCTAVES = 12
"""Stages of the multi-resolution mode: those without segments cost nothing."""
_FEWEST_SHARED = 32  # pieces: a third of a second of work
_NEIGHBOURS, _READ_AT_ONCE = 1.5, 8
"""Lengths from which segments are read apart, and how many are read together at most."""
_MOST_PASSES = 4
_FINAL_TOLERANCE = 1e-7  # seconds rms that clocks may move before segments are taken again
_SURVEYS, _SURVEYED = (4, 16), 80
"""Segments of which one is surveyed, at most, and how many are, at least."""
_READ_TOGETHER = 24  # segments of a survey
_GOLDEN = 0.6180339887498949
_SURVEY_TOLERANCE = 0.25
"""By how much two surveys may differ, as a share of the error of one delay.

Synchronisation this good adds to the noise less than half the square of that share where one line
holds all that is known of the delay, and a thousandth of this in broad-band motion.
"""
_SCATTERED = 2.0  # errors of one delay that a surveyed clock may be off
_MOST_SUSPECTS = 0.02  # share of segments, and
_SOME_SUSPECTS = 8
_MATERIAL_CONSTANT = 0.02  # samples of constant delay, of which a window forgives more


class Pass:
    """Segments of one recording, taken in order; other processors read ahead.

    Parameters
    ----------
    recording : ReadableRecording
    settings : Settings
    sensors : collection of str, optional
        Names of the sensors to estimate; default: all.
    jobs : int
        Processes that may take the segments of a long, closed recording (`forked`).
    """

    def __init__(
        self,
        recording: ReadableRecording,
        settings: Settings,
        sensors: Collection[str] | None = None,
        *,
        jobs: int = 1,
    ) -> None:
        self._jobs = jobs
        recording = at_rates(recording, settings.sampling_rates)
        self.recording = recording
        self.aligned = AlignedRecording(
            recording,
            sampling_rate=settings.sampling_rate,
            start_utc_ns=_utc_ns(settings.start),
            end_utc_ns=_utc_ns(settings.end),
            nominal_clocks=settings.clocks == "nominal",
            sensors=sensors,
        )
        names = {sensor for sensor, _ in self.aligned.channels}
        self._sensors = [record for record in recording.sensors if record.name in names]
        self._rates = np.array([record.sampling_rate for record in self._sensors])
        rate = self.aligned.sampling_rate
        self.welch = WelchSettings(
            sampling_rate=rate,
            segment_length=round(settings.segment * rate),
            overlap=settings.overlap,
            window=settings.window,
            detrend=settings.detrend,
        )
        self.n_channels = len(self.aligned.channels)
        self._settings = settings
        created = created_at(recording)
        ends = (stretch(each, created) for each in settings.exclude)
        self._stretches = [(_ns(begin), _ns(end)) for begin, end in ends]
        self._n_chosen = len(self._stretches)
        self.overlaps: list[Overlap] = []
        self.filters: Equaliser | None = None
        self._every = 1  # of which segments delays are measured
        self._tolerance = _FINAL_TOLERANCE
        self.restart()

    def restart(self) -> None:
        """Begin again, with the clocks as they are now."""
        wanted = self._settings
        rejection = RejectionSettings() if wanted.reject else None
        self.octaves: MultiResolution | None = None
        self._undisturbed: SelectedSpectra | None = None
        kept = kept_bins(len(self.welch.frequencies))
        self.single = SegmentSpectra(kept, self.n_channels)
        if wanted.octaves:
            self.octaves = MultiResolution(
                self.welch,
                self.n_channels,
                n_stages=OCTAVES,
                rejection=rejection,
                segments=self.single,
            )
        bins = part_bins(len(self.welch.frequencies), self.n_channels)
        self._ends = None if wanted.octaves else PartEnds(bins)
        if wanted.reject and not wanted.octaves:
            self._undisturbed = SelectedSpectra(
                self.welch, self.n_channels, segments=self.single, ends=self._ends
            )
        self._all = CrossSpectra(self.welch, self.n_channels, segments=self.single, ends=self._ends)
        self._selected: CrossSpectra | None = None
        self._bridge: GapBridge | None = None
        if wanted.bridge > 0 and self._undisturbed is None and self.octaves is None:
            self._bridge = GapBridge(self.welch, self.n_channels, most=wanted.bridge)
        short = 0.0 if wanted.reject else wanted.bridge
        self.sets = ChannelSets(self.welch, short=short, rejection=rejection)
        if self.octaves is not None:
            self.sets = self.octaves.sets
        self.n_seen = self._n_taken = 0
        self._fed = 0  # grid samples that the octaves have had
        self.left_out: Counter[Reason] = Counter()
        self.stillness = FlatlineDetector(self.welch.hop, self.n_channels, self.welch.sampling_rate)
        self._taken_at = GrowingRows(np.float64, len(self.aligned.dims))
        self.aligned.reset_delays()
        refined = wanted.clocks == "refined"
        self._newest = NewestSamples(self.aligned)
        self._delays = DelayMeasurement(self.aligned, self.welch, is_wanted=refined)

    @property
    def spectra(self) -> CrossSpectra:
        """Spectra of the segments that count; none with octaves."""
        if self._undisturbed is None:
            if self._bridge is None or not self.n_bridged:
                return self._all
            return self._all + self._bridge.spectra
        if self._selected is None:
            self._selected = self._undisturbed.spectra()
        return self._selected

    def rejected(self) -> list[tuple[float, float, int]]:
        """Return the segments with transients that are left out for all channels.

        Returns
        -------
        list of (float, float, int)
            Begin and end in s from the first grid sample, and the column of the largest transient.
        """
        hop, length = self.welch.hop, self.welch.segment_length
        found = [] if self.octaves is None else self.octaves.rejected()
        if self._undisturbed is not None:
            found = [
                (each.segment * hop, each.segment * hop + length, each.channel)
                for each in self._undisturbed.all_rejected()
                if each.channel is not None
            ]
        per_s, reach = self.welch.sampling_rate, self.reach
        return [
            ((begin + reach) / per_s, (end + reach) / per_s, column) for begin, end, column in found
        ]

    @property
    def parts(self) -> Parts | None:
        """Averages in parts of time; None where they are not kept, or do not hold all segments."""
        if self._ends is None or self.n_bridged:
            return None
        return Parts(self._ends.bins, self.spectra.parts(self.n_seen))

    @property
    def _at_once(self) -> int:
        """Segments that are read together."""
        return max(1, _VALUES_AT_ONCE // (self.welch.hop * self.n_channels))

    def drain(
        self, *, last: bool, ends: PieceEnds | None = None, segments: SegmentSpectra | None = None
    ) -> CrossSpectra:
        """Return the spectra since the last call; none with octaves.

        Segments held back for judgement are among the next ones, unless these are the last. `ends`
        receives the sums of the next ones at the ends of parts, `segments` their spectra.
        """
        self._ends = None  # the sums begin again: no parts of the recording are kept of them
        if self._undisturbed is None:
            spectra = self._all
            self._all = CrossSpectra(self.welch, self.n_channels, ends=ends, segments=segments)
            return spectra
        self._selected = None
        if last:
            return self._undisturbed.spectra()
        return self._undisturbed.drain(segments=segments, ends=ends)

    def end_part(self, place: int) -> None:
        """End a part before the segment with this number, where one is due."""
        sums = self._all if self._undisturbed is None else self._undisturbed
        if isinstance(sums.ends, PieceEnds) and sums.ends.is_due(place):
            sums.end_part(place)

    @property
    def n_segments(self) -> int:
        """Segments that count; with octaves those of the highest."""
        if self.octaves is not None:
            return self.octaves.n_segments
        if self._undisturbed is not None:
            return self.spectra.n_segments
        return self._n_taken + self.n_bridged

    @property
    def n_bridged(self) -> int:
        """Segments that count though they have gaps: none where half of all need not."""
        if self._bridge is None or 2 * (self._n_taken + self.sets.n_segments) >= self.n_seen:
            return 0
        return self._bridge.spectra.n_segments

    @property
    def leakage(self) -> WindowLeakage | None:
        """What the windows of these segments bring in."""
        return None if self._bridge is None else self._bridge.leakage

    def equalise(self, filters: Equaliser | None) -> None:
        """Begin again, with samples filtered."""
        self.filters = filters
        self.restart()

    @property
    def reach(self) -> int:
        """Samples that filters need before and after each; the lattice begins so many later."""
        return 0 if self.filters is None else self.filters.reach

    @property
    def kept_at(self) -> NDArray[np.int64]:
        """Grid samples at which the segments of `single` begin."""
        return self.reach + self.single.places * self.welch.hop

    @property
    def n_complete(self) -> int:
        """Segments of the lattice that are available now."""
        length = self.welch.segment_length + 2 * self.reach
        return max(0, (self.aligned.n_available - length) // self.welch.hop + 1)

    @property
    def elapsed(self) -> float:
        """Seconds of the grid examined so far."""
        if self.n_seen == 0:
            return 0.0
        length = (self.n_seen - 1) * self.welch.hop + self.welch.segment_length
        return (length + 2 * self.reach) / self.welch.sampling_rate

    def advance(
        self,
        progress: Callable[[int], None] | None = None,
        *,
        most: int | None = None,
        live: bool = False,
    ) -> None:
        """Take every segment that is complete; no more than the first `most` of all.

        `live` segments come one by one: their delays are measured later, a few at a time.
        """
        hop, begin, n_complete = self.welch.hop, self.n_seen, self.n_complete
        total = n_complete if most is None else min(most, n_complete)
        if self._ends is not None and not begin:  # as many as the recording has now
            self._ends.every = max(1, -(-total // MOST))
            while (n_complete - 1) // self._ends.every > MOST:  # as they would be merged later
                self._ends.every *= 2
        bounds = [begin, *self._cuts(begin + max(self._at_once, self._delays.fewest), total), total]
        pieces = [(a, b - a) for a, b in itertools.pairwise(bounds) if a < b]

        source = self._newest if live and len(pieces) == 1 else self.aligned

        on_grid = self._is_on_grid

        def read(
            piece: _Span, out: FloatArray | None = None, work: Work | None = None
        ) -> _Samples | OwnSpectra:
            first, count = piece
            if source is self.aligned and not on_grid:
                found = self._own_spectra((first + np.arange(count)) * hop)
                if found is not None:
                    return replace(found, products=self._products(found.spectra, first, out))
            part = self._read(source, self.filters, first * hop, count)
            is_small = count * self.welch.segment_length * self.n_channels <= MOST_VALUES
            if live or not is_small or self.octaves is not None or self._undisturbed is not None:
                return part
            # in this thread: the one that adds them is waited for
            spectra = self._all.transforms(part.samples, np.arange(count) * hop, work)
            return replace(part, spectra=spectra, products=self._products(spectra, first, out))

        shape = self._all.products_shape if max([n for _, n in pieces], default=1) > 1 else ()
        rooms = [(np.empty(shape) if shape else None, Work()) for _ in range(_READERS + 1)]

        def summed(numbered: tuple[int, _Span]) -> _Samples | OwnSpectra | _Sums:
            number, piece = numbered
            part = read(piece, *rooms[number % len(rooms)])
            return self._summed(part, *piece) or part

        coming: Generator[_Samples | OwnSpectra | _Sums] = read_ahead(summed, [*enumerate(pieces)])
        if not live and self._is_shared(pieces):
            coming = self._read_by_forks(read, pieces)
        with closing(coming):
            for (first, count), part in zip(pieces, coming, strict=True):
                if isinstance(part, _Sums):
                    self._take_sums(part, first, count)
                elif isinstance(part, OwnSpectra):
                    self._take_spectra(part, first)
                else:
                    self._take_samples(part, first, count, together=live)
                self.n_seen += count
                if progress is not None:
                    progress(count)

    def _is_shared(self, pieces: Sequence[_Span]) -> bool:
        """Return whether forks can work out the sums of most of these pieces, and are worth it."""
        every = 0 if self._ends is None else self._ends.every
        is_sum = self.octaves is None and self._undisturbed is None and self._all.products_shape
        by_spectra = not self._delays.measures or not (self._is_on_grid or self._every == 1)
        return bool(
            self._jobs > 1
            and forked.IS_POSSIBLE
            and self.recording.closed
            and len(pieces) >= _FEWEST_SHARED
            and every > self._at_once  # so that pieces end where parts of time do
            and self._at_once * self.welch.segment_length * self.n_channels <= MOST_VALUES
            and is_sum
            and by_spectra
        )

    def _read_by_forks(
        self,
        read: Callable[[_Span, FloatArray | None], _Samples | OwnSpectra],
        pieces: Sequence[_Span],
    ) -> Generator[_Samples | OwnSpectra | _Sums]:
        """Yield the sums of pieces from other processes; what has gaps or is left out is read here.

        One process sums the same pieces in the same order: results are equal to the bit.
        """
        n_segments = max(count for _, count in pieces)
        n_freqs, n_picked = len(self.welch.frequencies), n_segments // self._every + 2
        n_picked = n_picked if self._delays.measures else 0

        def room() -> _Sums:
            return _Sums(
                forked.shared(self._all.products_shape, np.float64),
                forked.shared((n_segments, len(self.single.bins), self.n_channels), np.complex64),
                forked.shared((n_picked, n_freqs, self.n_channels), np.complex128),
                forked.shared(self.stillness.counts.shape, np.int64),
            )

        def work(piece: _Span, room: _Sums) -> bool:
            n_damaged = sum(sensor.n_damaged for sensor in self._sensors)
            sums = self._summed(read(piece, room.products), *piece)
            if sums is None or n_damaged != sum(sensor.n_damaged for sensor in self._sensors):
                return False  # the other process is to count the damage, too
            room.single[: len(sums.single)], room.still[:] = sums.single, sums.still
            room.picked[: len(sums.picked)] = sums.picked
            return True

        for sensor in self._sensors:
            sensor.locate()  # once, for all processes
        rooms = [[room() for _ in range(forked.ROOMS)] for _ in range(self._jobs)]
        found = forked.worked_out(work, pieces, rooms)
        for piece, sums in zip(pieces, found, strict=True):
            yield read(piece, None) if sums is None else sums

    def _summed(self, part: _Samples | OwnSpectra, first: int, count: int) -> _Sums | None:
        """Return what a piece adds, without all its spectra; None where segments may be left out.

        None of an archive, too, which assigns segments to stretches. Threads may call it.
        """
        hop = self.welch.hop
        if part.spectra is None or part.products is None or self._ends is None:
            return None
        picked = part.spectra[:0]
        if isinstance(part, OwnSpectra):
            n_samples = (count - 1) * hop + self.welch.segment_length
            kept = self._kept(first * hop, len(part.raw))
            is_whole = self._unwanted(first * hop, n_samples) is None
            if self._delays.measures:
                numbers = first + np.arange(count)
                picked = part.spectra[_is_picked(numbers, self._every, again=True)]
        else:
            kept = part.raw_kept
            is_whole = part.unwanted is None and bool(part.usable.all())
            is_whole &= not self._delays.measures
        if not is_whole:
            return None
        stillness = FlatlineDetector(hop, self.n_channels, self.welch.sampling_rate)
        stillness.add(part.raw, kept)
        single = part.spectra[:, self.single.bins].astype(np.complex64)
        return _Sums(part.products, single, picked, stillness.counts)

    def _take_sums(self, part: _Sums, first: int, count: int) -> None:
        """Add whole segments by their sums; `first` is the number of the first of them."""
        numbers = first + np.arange(count)
        begins = self.reach + numbers * self.welch.hop
        self.stillness.counts += part.still
        for _ in by_part(self._all, numbers):  # one: the piece lies in one part of time
            self._all.add_products(part.products, part.single[:count], places=numbers)
        self._n_taken += count
        self._taken_at.add(self._positions(numbers))
        if self._delays.measures:
            some = _is_picked(numbers, self._every, again=True)
            self._delays.measure_spectra(part.picked[: some.sum()].copy(), begins[some])

    def _cuts(self, begin: int, total: int) -> list[int]:
        """Return where pieces end, from `begin` on: also where parts of time do, if these are long.

        A piece within one part is added whole, by the sum of its products.
        """
        at_once = self._at_once
        every = at_once if self._ends is None else self._ends.every
        n = -(-every // at_once)  # pieces of a part
        some = range(-(-begin * n // every), total * n // every + 1)
        ends = [each * every // n for each in some] if every > at_once else []
        return [end for end in ends or range(begin, total, at_once) if end < total]

    def _products(
        self, spectra: ComplexArray, first: int, out: FloatArray | None = None
    ) -> FloatArray | None:
        """Return the sum of products of segments from number `first` on, if one part has them."""
        every = 0 if self._ends is None else self._ends.every
        if every and first // every != (first + len(spectra) - 1) // every:
            return None
        return self._all.products(spectra, out)

    def finish(
        self,
        progress: Callable[[int], None] | None = None,
        repeating: Callable[[int], None] | None = None,
    ) -> None:
        """Take every segment by the final clocks.

        `progress` receives the segments of each piece; `repeating`, before they are taken again,
        how many these are.
        """
        self._survey()
        self.advance(progress)
        for _ in range(_MOST_PASSES - 1):
            departs = self._departs()
            self.set_clocks()
            if not (departs or self.is_outdated(self._tolerance)):
                break
            self._every, self._tolerance = 1, _FINAL_TOLERANCE
            if repeating is not None:
                repeating(self.n_seen)
            self.restart()
            self.advance(progress)

    def averages(self, filters: Equaliser | None, begin: int, count: int) -> CrossSpectra:
        """Return spectra of `count` segments from grid sample `begin` on, filtered.

        Gaps, clipped blocks, excluded stretches are left out, and nothing else. It changes nothing
        of the pass.
        """
        reach = 0 if filters is None else filters.reach
        part = self._read(self.aligned, filters, begin - reach, count)
        usable = part.usable if part.unwanted is None else part.usable & ~part.unwanted
        starts = np.arange(count) * self.welch.hop
        spectra = CrossSpectra(self.welch, self.n_channels)
        spectra.add(part.samples, starts[whole_segments(usable, starts, self.welch.segment_length)])
        return spectra

    def _read(
        self,
        source: AlignedRecording | NewestSamples,
        filters: Equaliser | None,
        begin: int,
        count: int,
    ) -> _Samples:
        """Return `count` segments, the first with what filters need before it from `begin` on."""
        reach, n_hops = 0 if filters is None else filters.reach, count * self.welch.hop
        length = n_hops - self.welch.hop + self.welch.segment_length + 2 * reach
        samples, valid = source.read(begin, begin + length)
        usable = valid & self._finite(samples)
        present: BoolArray | None = None
        if not usable.all():
            present = np.isfinite(samples)
            samples = np.where(present, samples, 0.0)
        self._silence(samples)
        unwanted = self._unwanted(begin, len(samples))
        raw = samples[reach : reach + n_hops]
        kept = self._kept(begin + reach, n_hops) & usable[reach : reach + n_hops]
        if filters is not None:
            samples = filters.apply(samples)
            usable = surrounded(usable, reach)
            if present is not None:
                present = np.column_stack([surrounded(column, reach) for column in present.T])
            unwanted = None if unwanted is None else ~surrounded(~unwanted, reach)
        return _Samples(samples, usable, present, unwanted, raw, kept)

    def _survey(self) -> None:
        """Set free clocks from a few segments, before all are taken.

        Where these clocks prove straight between the segments surveyed, the pass that follows
        measures as few others: two independent measurements, of which the one is the check of the
        other. If they differ, delays are measured in every segment after all.
        """
        wanted = self._delays.fewest and not self.n_seen and self.aligned.is_unbroken
        if not wanted or self._is_on_grid:
            return
        for every in sorted({min(most, self.n_complete // _SURVEYED) for most in _SURVEYS})[::-1]:
            if every < 2:
                return
            precision = self._surveyed(every)
            if precision is None:
                return
            tolerance = max(_FINAL_TOLERANCE, _SURVEY_TOLERANCE * precision)
            delays = self._positions(np.arange(0, self.n_complete, every))
            delays -= delays.mean(axis=1, keepdims=True)
            bend = (delays[2:] - 2 * delays[1:-1] + delays[:-2]) / 8  # from a line, half-way
            is_straight = np.sqrt(np.mean(bend**2, axis=0)).max() <= tolerance
            if is_straight and self._follow(_SCATTERED * precision):
                self._every, self._tolerance = every, tolerance
                return

    def _follow(self, residual: float) -> bool:
        """Return whether clocks follow their measured delays, but for this residual in s."""
        refined = [clock for clock in self.aligned.clocks if clock.refined]
        return all(clock.is_understood and clock.residual <= residual for clock in refined)

    def _surveyed(self, every: int) -> float | None:
        """Set clocks from one segment in `every`; return the error of one delay, in s."""
        numbers = np.arange(self.n_complete)
        begins = numbers[_is_picked(numbers, every)] * self.welch.hop
        begins = begins[~self._touch_excluded(begins, self.welch.segment_length)]
        for first in range(0, len(begins), _READ_TOGETHER):
            some = begins[first : first + _READ_TOGETHER]
            whole, spectra = self._spectra_apart(some)
            if spectra is not None:
                self._delays.measure_spectra(spectra, some[whole])
        self.set_clocks(slips=False)  # these are found in all segments, and better dated
        precision = self._delays.precision
        self.restart()
        return precision

    def _departs(self) -> bool:
        """Return whether any segment is off the clocks, though delays are measured in few only."""
        if self._every == 1 or not len(self.single):
            return False
        suspects = self._delays.suspects(self.single)
        if suspects is None or len(suspects) > _SOME_SUSPECTS + _MOST_SUSPECTS * self.n_seen:
            return True
        _, spectra = self._spectra_apart(self.kept_at[suspects])
        return spectra is not None and self._delays.are_off(spectra)

    def _spectra_apart(self, begins: NDArray[np.int64]) -> tuple[BoolArray, ComplexArray | None]:
        """Return which segments, far apart, are whole in each sensor's own samples; their spectra.

        None where there are none.
        """
        length = self.welch.segment_length
        parts = [self.aligned.own_samples(begin, length) for begin in begins[:, None]]
        whole = np.array([part is not None for part in parts], dtype=np.bool_)
        sensors = zip(*(part for part in parts if part is not None), strict=True)
        own = [OwnSamples.joined(each) for each in sensors]
        found = OwnSpectra.of(own, self.welch) if own else None
        return whole, None if found is None else found.spectra

    def _own_spectra(self, begins: NDArray[np.int64]) -> OwnSpectra | None:
        """Return spectra of segments in each sensor's own samples; None where that is not so."""
        own = self.aligned.own_samples(begins, self.welch.segment_length)
        return None if own is None else OwnSpectra.of(own, self.welch)

    @property
    def _is_on_grid(self) -> bool:
        """Whether segments are taken from samples on the grid: filters need these, too."""
        is_filtered = self.filters is not None
        return is_filtered or self.aligned.is_exact or need_samples_of_grid(self._settings)

    def _take(self, samples: FloatArray, starts: NDArray[np.int64], first: int) -> None:
        """Add the segments that begin at rows `starts` of `samples`.

        `first` is the grid sample of row 0.
        """
        sums = self._all if self._undisturbed is None else self._undisturbed
        places = (first + starts - self.reach) // self.welch.hop
        for some in by_part(sums, places):
            sums.add(samples, starts[some], places=places[some])
        self._selected = None

    def _take_whole(
        self,
        spectra: ComplexArray,
        begins: NDArray[np.int64],
        products: FloatArray | None = None,
    ) -> None:
        """Add segments by their spectra and products; they begin at grid samples `begins`."""
        places = (begins - self.reach) // self.welch.hop
        for some in by_part(self._all, places):
            taken, own = spectra[some], products if len(places[some]) == len(places) else None
            self._all.add_spectra(taken, own, places=places[some])

    def _take_samples(self, part: _Samples, first: int, count: int, *, together: bool) -> None:
        """Add segments from samples on the grid; `first` is the number of the first of them."""
        samples, usable, unwanted = part.samples, part.usable, part.unwanted
        hop, length, reach = self.welch.hop, self.welch.segment_length, self.reach
        begin = first * hop
        self.stillness.add(part.raw, part.raw_kept)
        starts = np.arange(count) * hop
        whole = whole_segments(usable, starts, length)
        clean = whole if unwanted is None else whole_segments(usable & ~unwanted, starts, length)
        self.left_out[Reason.GAP] += count - int(whole.sum())
        self._count_left_out(whole, clean, begin + starts, length + 2 * reach)
        starts = starts[clean]
        if self.octaves is not None:
            present = usable if part.present is None else part.present
            if unwanted is not None:
                present = (present.T & ~unwanted).T
            new = self._fed - begin
            self.octaves.add(samples[new:], present[new:])
            self._fed = begin + len(samples)
        elif part.spectra is not None:
            begins = begin + reach + starts
            if clean.all():
                self._take_whole(part.spectra, begins, part.products)
            else:
                self._take_whole(part.spectra[clean], begins)
        else:
            self._take(samples, starts, begin + reach)
        self._n_taken += len(starts)
        self._taken_at.add(self._positions(np.arange(first, first + count)))
        self._delays.measure(samples, starts, begin + reach + starts, together=together)
        touched = np.flatnonzero(~whole) * hop
        if self.octaves is None and part.present is not None and len(touched):
            taken = self.sets.take(samples, part.present, unwanted, touched)
            touched = np.setdiff1d(touched, taken)
        if self._bridge is not None and len(touched):
            taken = self._bridge.take(samples, usable, unwanted, touched)
            begins = begin + reach + taken
            self._delays.measure_with_gaps(
                samples, usable, taken, begins, most=self._settings.bridge, together=together
            )

    def _take_spectra(self, part: OwnSpectra, first: int) -> None:
        """Add whole segments by their spectra; `first` is the number of the first of them."""
        count, length, hop = len(part.spectra), self.welch.segment_length, self.welch.hop
        self.stillness.add(part.raw, self._kept(first * hop, len(part.raw)))
        starts = np.arange(count) * hop
        unwanted = self._unwanted(first * hop, int(starts[-1]) + length)
        spectra = part.spectra
        if unwanted is not None:
            clean = whole_segments(~unwanted, starts, length)
            self._count_left_out(np.ones_like(clean), clean, first * hop + starts, length)
            if not clean.all():
                spectra, starts = spectra[clean], starts[clean]
        begins = first * hop + starts
        self._take_whole(spectra, begins, part.products if spectra is part.spectra else None)
        self._n_taken += len(spectra)
        self._taken_at.add(self._positions(np.arange(first, first + count)))
        some = _is_picked(begins // hop, self._every, again=True)
        self._delays.measure_spectra(spectra[some], begins[some])

    def _silence(self, samples: FloatArray) -> None:
        """Make channels that stand still exactly zero: the rounding of their mean is no signal."""
        if self.welch.detrend == "none":
            return
        rows = samples[:: max(1, len(samples) // 4)]
        for column in np.flatnonzero(stands_still(rows)):
            if stands_still(samples[:, column]):
                samples[:, column] = 0.0

    def _finite(self, samples: FloatArray) -> NDArray[np.bool_]:
        """Return which samples are finite numbers, in every channel."""
        with np.errstate(invalid="ignore"):
            if np.isfinite(samples.sum()):
                return np.ones(len(samples), dtype=np.bool_)
        return np.asarray(np.isfinite(samples).all(axis=1))

    def excluded(self) -> list[tuple[int, int]]:
        """Return the first grid sample of each excluded stretch, and the one after its last."""
        rate, origin = self.welch.sampling_rate, self.aligned.start_utc_ns
        edges = ((np.array(each) - origin) * 1e-9 * rate for each in self._stretches)
        return [(int(first), int(end)) for first, end in (np.ceil(at - _NEAR) for at in edges)]

    def leave_to(self, name: str, begin: int, end: int) -> None:
        """Exclude what another recording covers, in ns of UTC, but for half a segment at its ends.

        So nothing is excluded where one recording continues another.
        """
        margin = round(self.welch.segment_length / self.welch.sampling_rate * 5e8)
        low, high, own = begin + margin, end - margin, self.span_ns
        if own is not None and max(low, own[0]) < min(high, own[1]):
            self._stretches.append((low, high))
            both = max(begin, own[0]), min(end, own[1])
            self.overlaps.append(Overlap(name, self.recording.path.name, *both))

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Begin and end of the grid in ns of UTC; None before all sensors have samples."""
        begin, seconds = (
            self.aligned.start_utc_ns,
            self.aligned.n_available / self.welch.sampling_rate,
        )
        return (begin, begin + round(seconds * 1e9)) if self.aligned.clocks else None

    def _count_left_out(
        self, whole: BoolArray, clean: BoolArray, begins: NDArray[np.int64], length: int
    ) -> None:
        """Count segments without gaps that do not count, by their reasons."""
        excluded = self._touch_excluded(begins, length)
        chosen = self._touch_excluded(begins, length, self._n_chosen)
        self.left_out[Reason.CHOSEN] += int((whole & chosen).sum())
        self.left_out[Reason.REPEATED] += int((whole & excluded & ~chosen).sum())
        self.left_out[Reason.CLIPPED] += int((whole & ~clean & ~excluded).sum())

    def _touch_excluded(
        self, begins: NDArray[np.int64], length: int, most: int | None = None
    ) -> BoolArray:
        """Return which segments that begin at these grid samples touch an excluded stretch."""
        found = np.zeros(len(begins), dtype=np.bool_)
        for first, end in self.excluded()[:most]:
            found |= (begins < end) & (begins + length > first)
        return found

    def _unwanted(self, start: int, n_samples: int) -> NDArray[np.bool_] | None:
        """Return which grid samples are in excluded stretches or clipped blocks; None if none."""
        clipped = self._clipped(start, n_samples)
        if not self._stretches:
            return clipped
        excluded = ~self._kept(start, n_samples)
        found = excluded if clipped is None else clipped | excluded
        return found if found.any() else None

    def _kept(self, start: int, n_samples: int) -> BoolArray:
        """Return which grid samples are in no excluded stretch."""
        kept = np.ones(n_samples, dtype=np.bool_)
        for first, end in self.excluded():
            kept[max(0, first - start) : max(0, end - start)] = False
        return kept

    def unused(self) -> dict[str, FloatArray]:
        """Return the samples of each sensor that the settings leave out, by its name.

        Those of excluded stretches, before the start and after the end. Empty without any, or
        before all sensors have samples.

        Returns
        -------
        dict of str to float64, shape (n, 2)
            First sample, and the one after the last.
        """
        asked = self._settings.start is not None, self._settings.end is not None
        if not self.aligned.clocks or not (self._stretches or any(asked)):
            return {}
        ends = np.array([(0, self.aligned.n_available), *self.excluded()], np.float64)
        spans = (self._seconds_of_sensors(ends.ravel()) * self._rates).reshape(*ends.shape, -1)
        (start, end), excluded = spans[0], spans[1:]
        beside = [(np.full(len(start), -np.inf), start), (end, np.full(len(end), np.inf))]
        found = np.array([*itertools.compress(beside, asked), *excluded])
        names = [record.name for record in self._sensors]
        return {name: found[..., number].reshape(-1, 2) for number, name in enumerate(names)}

    def _seconds_of_sensors(self, at: FloatArray) -> FloatArray:
        """Return the sample of each sensor at grid samples, as seconds since the first."""
        origin = self.aligned.start_utc_ns - self.recording.created_at.utc_ns
        seconds = origin * 1e-9 + at / self.welch.sampling_rate
        return np.asarray(seconds[:, None] - self.aligned.delays(at))

    def _past_samples(self, at: float) -> FloatArray:
        """Return by how many seconds an instant of the grid is past a sample of each sensor."""
        if self.aligned.is_exact:
            return np.zeros(len(self._sensors))
        place = self._seconds_of_sensors(np.array([at]))[0] * self._rates
        past = (place - np.round(place)) / self._rates
        return np.where(self._rates == self.welch.sampling_rate, past, 0.0)

    def _clipped(self, start: int, n_samples: int) -> NDArray[np.bool_] | None:
        """Return which grid samples lie in blocks that are clipped; None if none do."""
        if self._settings.reject is False:
            return None

        def times() -> FloatArray:
            return self._seconds_of_sensors(np.arange(start, start + n_samples, dtype=np.float64))

        return in_clipped_blocks(self._sensors, times)

    def whole_segments(self, starts: NDArray[np.int64]) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield the segments that begin at grid samples; none with gaps, clipped or excluded.

        And by how many seconds their samples are past those of each sensor, between which they
        are interpolated: 0 at another rate. Neighbours are read together.
        """
        length = self.welch.segment_length
        far = np.flatnonzero(np.diff(starts) > _NEIGHBOURS * length) + 1
        every = range(_READ_AT_ONCE, len(starts), _READ_AT_ONCE)
        for some in np.split(starts, sorted({*far.tolist(), *every})):
            if not len(some):
                continue
            first, last = int(some[0]), int(some[-1]) + length
            samples, valid = self.aligned.read(first, last)
            unwanted = self._unwanted(first, len(samples))
            usable = valid if unwanted is None else valid & ~unwanted
            for begin in (some - first).tolist():
                own = slice(begin, begin + length)
                if len(samples[own]) == length and usable[own].all():
                    yield samples[own], self._past_samples(first + begin + length / 2)

    @property
    def awaited(self) -> int:
        """Segments with which delays could be measured first; 0 where they are, or need not be."""
        return self._delays.awaited

    def moved(self) -> FloatArray:
        """Return by how much clocks, as known now, differ from those that segments were taken by.

        In seconds, shape (n_segments, n_sensors); what all sensors have in common is left out.
        """
        before = self._taken_at.values
        if not len(before):
            return before
        moved = self._positions(np.arange(len(before))) - before
        return np.asarray(moved - moved.mean(axis=1, keepdims=True))

    def set_clocks(self, *, slips: bool = True) -> None:
        """Set the clocks by the delays measured in the segments taken.

        `slips`: whether samples that were lost without being counted are looked for in them.
        """
        if self._delays.has_begun:
            self._delays.learn_held()
            self.aligned.set_clocks(slips=slips)

    def doubt_stated_times(self) -> bool:
        """Return whether stated UTC was found to drift only now; then all begins again."""
        sensors = self.aligned.stated
        if len(sensors) > 1 and self._settings.clocks == "refined":
            window = get_window(self.welch.window, self.welch.segment_length)
            n_effective = effective_averages(window, self.welch.hop, max(self.n_segments, 1))
            if agree(self.aligned, self.single, self.kept_at, self.welch, n_effective=n_effective):
                self.aligned.compare_stated(dict.fromkeys(sensors, 0.0), sensors[0])
                return False
        drift = compare(self.aligned, self._settings, self.welch)
        if drift:
            self.restart()
        return drift

    def is_outdated(self, tolerance: float) -> bool:
        """Whether clocks, as known now, differ from those that segments were taken by.

        By more than `tolerance` in seconds rms, that is; or whether delays could be measured now
        and could not yet when segments came one by one.
        """
        if not len(self._taken_at) or self.aligned.is_exact:
            return False
        if self.awaited:
            return self.n_seen >= self.awaited
        moved = self.moved()
        constant = moved.mean(axis=0)
        return float(np.sqrt(np.mean((moved - constant) ** 2))) > tolerance or bool(
            np.max(np.abs(constant)) * self.welch.sampling_rate > _MATERIAL_CONSTANT
        )

    def drift(self) -> FloatArray:
        """Return middles of segments in seconds, and every sensor's delay there."""
        taken = self._taken_at.values
        middle = self._middles(np.arange(len(taken)))
        return np.column_stack([middle / self.welch.sampling_rate, taken])

    def _positions(self, segments: NDArray[np.int64]) -> FloatArray:
        return self.aligned.delays(self._middles(segments))

    def _middles(self, segments: NDArray[np.int64]) -> FloatArray:
        """Return the middles of segments, in samples of the grid."""
        middle = segments * float(self.welch.hop) + self.welch.segment_length / 2 + self.reach
        return np.asarray(middle, dtype=np.float64)


def _is_picked(numbers: NDArray[np.int64], every: int, *, again: bool = False) -> BoolArray:
    """Return which segments are measured: one in `every`, `again` another one, at uneven distances.

    A clock that moves in cycles of the even distance would look straight.
    """
    place = (every * (_GOLDEN * (numbers // every) ** 2 % 1)).astype(np.int64)
    return np.asarray(numbers % every == (place + again * (every // 2)) % every)


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Samples of a piece, filtered where sensors are equalised, and as they were read."""

    samples: FloatArray
    usable: NDArray[np.bool_]
    present: NDArray[np.bool_] | None
    """Which channel has each sample, shape (n_samples, n_channels); None where all have all."""
    unwanted: NDArray[np.bool_] | None
    raw: FloatArray
    raw_kept: NDArray[np.bool_]
    spectra: ComplexArray | None = None
    """Of all segments, also those that are left out."""
    products: FloatArray | None = None
    """Sum over `spectra`, where `CrossSpectra` uses it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """What a piece without gaps adds, in memory that processes share."""

    products: FloatArray
    """As `CrossSpectra.products` returns them."""
    single: NDArray[np.complex64]
    """Spectra of the segments at the kept bins, and room for more."""
    picked: ComplexArray
    """Spectra of the segments whose delays are measured, and room for more."""
    still: NDArray[np.int64]
    """`FlatlineDetector.counts`."""


def still_for_a_while(passes: Sequence[Pass], settings: Settings) -> dict[int, float]:
    """Return for how long channels stood still in segments that count, in seconds, by column.

    Rejection leaves such segments out, but takes what lasts for a change for good.
    """
    welch = passes[0].welch
    lasting = RejectionSettings().start_up * welch.hop / welch.sampling_rate
    least = lasting if settings.reject else 0.0
    seconds = np.atleast_1d(sum(each.stillness.for_a_while() for each in passes))
    return {column: float(still) for column, still in enumerate(seconds) if still > least}


def _utc_ns(at: datetime | None) -> int | None:
    return None if at is None else _ns(at)


def _ns(at: datetime) -> int:
    return math.floor(at.timestamp()) * 10**9 + at.microsecond * 1000
