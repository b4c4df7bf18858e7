"""What is estimated, and how."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import datetime

    from daq.bench.model import Bench


@dataclass(frozen=True, slots=True)
class Settings:
    """What is estimated, and how.

    Attributes
    ----------
    segment : float
        Length of a segment in seconds.
    overlap, window, detrend
        As `estimator.spectra.welch.WelchSettings` takes them.
    methods : tuple of str
        Names in `estimator.methods.METHODS`; ``("all",)`` for every method that applies.
    correct : bool
        Whether the small-sample bias is removed.
    unit : str or None
        Of the result; that of the first channel where not given.
    start, end : datetime or None
        Only what lies between; with time zone.
    band : (float, float) or None
        Frequencies in Hz in which `target_cov` is wanted; 0.05 to 0.45 of the rate if not given.
    target_cov : float or None
        Wanted coefficient of variation.
    sampling_rate : float or None
        Of the common grid in Hz; the lowest of the sensors' where not given.
    clocks : str
        How it is known when samples were taken: "refined", by arrival times and the motion that the
        sensors share; "arrivals", by arrival times alone; "nominal", samples at face value.
    reject : bool or None
        Which segments are left out, besides those with gaps: True for those that are clipped or
        have a transient in any channel (`estimator.spectra.segment_rejection`), None for those that
        are clipped, False for none.
    octaves : bool
        Whether each octave has segments of its own length (`estimator.spectra.multiresolution`):
        `segment` in the highest one, twice as long in each one below. With `reject` each octave's
        segments are judged by those before them in the same octave.
    dimension : int, "auto" or None
        Factors of the common motion that maximum likelihood allows: that many, as many as the model
        test of each band demands (`estimator.likelihood.dimension`), or as many as the largest
        sensor has channels.
    gains : mapping of str to float
        What a sensor ("A") or a channel ("A.X") makes of the motion, relative to the others: known
        beforehand, for the two-channel method. 1 where not given.
    """

    segment: float = 10.0
    overlap: float = 0.5
    window: str = "hann"
    detrend: Literal["none", "constant", "linear"] = "constant"
    methods: tuple[str, ...] = ("three-sensor",)
    correct: bool = True
    unit: str | None = None
    start: datetime | None = None
    end: datetime | None = None
    band: tuple[float, float] | None = None
    target_cov: float | None = None
    sampling_rate: float | None = None
    clocks: Literal["refined", "arrivals", "nominal"] = "refined"
    reject: bool | None = None
    octaves: bool = False
    dimension: int | Literal["auto"] | None = None
    gains: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, bench: Bench | None) -> Settings:
        """Return what a bench file says, or what holds where there is none."""
        if bench is None:
            return cls()
        wanted = bench.estimate
        return cls(
            segment=wanted.segment,
            overlap=wanted.overlap,
            window=wanted.window,
            detrend=wanted.detrend,
            methods=(wanted.method,),
            correct=wanted.correct,
            band=wanted.band,
            target_cov=wanted.target_cov,
            reject=wanted.reject,
            octaves=wanted.octaves,
            dimension=wanted.dimension,
            gains=wanted.gains,
        )
