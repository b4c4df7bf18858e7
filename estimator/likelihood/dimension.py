"""Dimension of the common motion by band: the smallest that the model test accepts.

It is smaller than the number of channels of a sensor if the motion lacks a dimension. It is larger
if a sufficient number of sensors measure slightly different motions: rotation and gradients are
then further factors of the same model.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import field, replace

import numpy as np

from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.levels.noise_matrices import together
from estimator.levels.pooled import DIMENSIONS_OF_MOTION, blocks_of, most_pooled
from estimator.likelihood import goodness_of_fit
from estimator.likelihood.factor_analysis import Maxima, max_factors, maximise, n_noise
from estimator.likelihood.maximum_likelihood import standard_error
from estimator.likelihood.prior import expected_noise, kinds, maximise_expecting
from estimator.likelihood.shared_by_two import SHARING, PairSearch
from estimator.median import median, median_of_columns
from estimator.records import Hertz, dataclass
from estimator.self_noise.coherency import (
    PresentSensors,
    check_averages,
    check_dims,
    check_frequency,
    coherency,
    presence,
    testable,
)
from estimator.types import ComplexArray, FloatArray, IntArray

ROOM, ROOM_OF_ONE_CHANNEL = 4, 6
"""Sensors from which ``auto`` looks for more dimensions of motion than a sensor has channels."""
MAX_CHANNELS = 96
"""Channels up to which ``auto`` is maximum likelihood, to limit its cost."""
MISFIT_LEVEL = goodness_of_fit.REJECT
"""Probability that a dimension is rejected in any of the bands although it is right: in each band,
this over their number. With 5 % for each band, four sensors had a rejected one in every second
recording without fault."""
MIN_DETERMINED_SENSORS = 5
"""Number of sensors from which further dimensions still determine the noise of each sensor."""
EQUATIONS = 1.5
"""Minimum number of equations, ``(p - q)**2``, per channel, with more factors than usual.
With 16 for 15 channels, wrong noise also explains the averages: waves seen by five triaxial sensors
biased it by up to 57 %."""
MIN_BINS = 8
MAX_BINS = 64
"""Maximum number of tested frequencies per band: of more, every second, third, …"""
SENSOR_BINS, SENSOR_STEPS = 16, 30
"""The same where the noise of a sensor is a matrix, whose fit takes longer; steps of that fit."""
FIRST_LOOK = 8
"""Dimensions are tried at every so many frequencies first; there the test often rejects them."""
HOPELESS = 1e-12
"""p value of the first look that all other frequencies would hardly outweigh."""
LOOK_STEPS, BEYOND_DOUBT = 4, 2.0
"""Steps of its fits of fewer dimensions than usual, of which a wrong model needs ten times more;
and by what the statistic is divided that is then hopeless. It is up to 1.3 times the last one."""
LOOK_CHANNELS = 15
"""Channels whose sensors alone are looked at before all: what they reject, all reject."""


OVERFIT = 1.15
"""What a factor that is not there takes from the statistic of one frequency, beyond its degrees of
freedom, for each channel. Of 9 to 24 channels and 40 to 600 averages, the first one takes 0.7 to
1.25, the second one less."""


def has_room(dims: tuple[int, ...]) -> bool:
    """Whether sensors leave room for more dimensions of motion than one has channels."""
    least = ROOM_OF_ONE_CHANNEL if 1 in dims else ROOM
    return len(dims) >= least and len(set(dims)) == 1 and sum(dims) <= MAX_CHANNELS


@dataclass(frozen=True, slots=True)
class BandDimension:
    """The dimension chosen for one band, and its cost in precision.

    Attributes
    ----------
    low, high : float
        Lowest and highest frequency of the band, Hz.
    n_factors : int
        Dimension of the common motion.
    usual : int
        Number of channels of the largest sensor: the default dimension.
    accepted : bool
        False if even the maximum number of identifiable factors does not explain the band, and if
        the band is undetermined.
    test : BandTest
        Test of the chosen dimension.
    tried : tuple of BandTest
        Tests of 0, 1, … `n_factors` factors; where a first look rejects them clearly, of fewer
        frequencies and steps.
    cov : float
        Median c.o.v. of the noise at one frequency with `n_factors`; infinite if they leave the
        noise undetermined.
    usual_cov : float
        The same with the usual dimension; NaN if it could not be fitted.
    n_sensors : int
        Number of sensors with a signal of their own.
    gradients : bool
        Whether the further dimensions are the motion's gradients, see
        `estimator.likelihood.gradients`.
    pairs : tuple of (int, int)
        Sensors, from 0, that share noise, or a motion that no other feels: it is left in the noise.
    alternatives : tuple of (int, int)
        Pairs of sensors one of which may share noise instead.
    least, most : tuple of float
        Noise of each channel over its estimate, if all that two sensors share is motion, and by the
        alternatives; empty without `pairs`.
    """

    low: Hertz
    high: Hertz
    n_factors: int = field(metadata={"key": "dimensions"})
    usual: int = field(metadata={"key": "usual_dimensions"})
    accepted: bool = field(metadata={"key": "is_accepted"})
    test: goodness_of_fit.BandTest
    tried: tuple[goodness_of_fit.BandTest, ...]
    cov: float
    usual_cov: float
    n_sensors: int = field(default=MIN_DETERMINED_SENSORS, metadata={"key": "sensors"})
    gradients: bool = field(default=False, metadata={"key": "are_gradients"})
    pairs: tuple[tuple[int, int], ...] = ()
    alternatives: tuple[tuple[int, int], ...] = ()
    least: tuple[float, ...] = ()
    most: tuple[float, ...] = ()

    @property
    def is_undetermined(self) -> bool:
        """Whether the averages are explained by more dimensions than these few sensors can resolve.

        With further dimensions, four sensors have too few directions without motion to determine
        the noise of each: the model then also fits wrong noise.
        """
        return self.n_factors > self.usual and self.n_sensors < MIN_DETERMINED_SENSORS

    def unseen(self, n_channels: int, n_effective: float, *, quantile: float) -> float:
        """Return the motion that may be in the dimensions left out, as a share of the noise.

        Motion of that share at every channel, alike in all `usual` dimensions, raises the statistic
        of one frequency by ``n p (p / d - 1)`` times its square; where q dimensions are fitted, by
        ``(d - q) / d`` of this. The test may not see it, be it by chance, for `quantile` standard
        deviations, or since the factors took it up at each frequency anew.
        """
        left = self.usual - self.n_factors
        if left <= 0 or n_channels <= self.usual:
            return 0.0
        scatter = quantile * np.sqrt(2 * self.test.degrees * self.test.spread)
        overfit = OVERFIT * n_channels * self.n_factors * self.test.n_frequencies
        excess = max(0.0, self.test.statistic - self.test.degrees + overfit + scatter)
        raised = n_effective * n_channels * (n_channels / self.usual - 1) * left / self.usual
        return float(np.sqrt(excess / max(1, self.test.n_frequencies) / raised))

    def of_all(
        self, sensors: Sequence[int], channels: Sequence[int], n_channels: int
    ) -> BandDimension:
        """Return the choice for these sensors and channels, by the numbers of all."""
        if not self.pairs:
            return self
        pairs, alternatives = (
            tuple((sensors[i], sensors[j]) for i, j in each)
            for each in (self.pairs, self.alternatives)
        )
        over = np.ones((2, n_channels))
        over[:, list(channels)] = self.least, self.most
        least, most = (tuple(each) for each in over.tolist())
        return replace(self, pairs=pairs, alternatives=alternatives, least=least, most=most)

    def beside(self, inflation: float, level: float) -> BandDimension:
        """Return the choice for noise whose scores have `inflation` times the variance.

        The smallest dimension, from the usual one on, that its test accepts at a level, if that is
        fewer or none was; itself otherwise.
        """
        if inflation == 1 or (self.accepted and self.n_factors <= self.usual):
            return self
        for q, test in enumerate(self.tried[self.usual :], self.usual):
            by_chance = goodness_of_fit.deflated(test, inflation)
            if by_chance.p_value > level:
                return replace(
                    self,
                    n_factors=q,
                    accepted=q == self.usual or self.n_sensors >= MIN_DETERMINED_SENSORS,
                    test=by_chance,
                    tried=(*self.tried[:q], by_chance),
                    cov=self.usual_cov if q == self.usual else self.cov,
                    gradients=False,
                    pairs=(),
                    alternatives=(),
                    least=(),
                    most=(),
                )
        return self

    @property
    def is_biased(self) -> bool:
        """Whether tests reject all dimensions, in the band or with others; not without a test."""
        few = self.n_sensors < MIN_DETERMINED_SENSORS
        fails = self.test.p_value < (MISFIT_LEVEL if few else 1.0)
        return not self.accepted and fails


def noise_groups(
    choices: Iterable[BandDimension], frequency: FloatArray, n_sensors: int
) -> IntArray:
    """Return the group of every sensor at every frequency, shape (n_freqs, n_sensors).

    Sensors of one group may share noise.
    """
    group = np.broadcast_to(np.arange(n_sensors), (len(frequency), n_sensors)).copy()
    for choice in choices:
        inside = (frequency >= choice.low) & (frequency <= choice.high)
        for one, other in choice.pairs:
            group[inside, other] = one
    return group


def bands(frequency: FloatArray) -> IntArray:
    """Return the band of every frequency: a third of an octave, `MIN_BINS` frequencies at least."""
    return blocks_of(frequency, least=MIN_BINS)


def _check_enough(there: PresentSensors, dims: tuple[int, ...], n_effective: float) -> None:
    few = len(there.sensors) < 3  # so few averages make channels copies of each other
    needed = sum(dims) if few else len(there.channels)
    if n_effective <= needed:
        raise InsufficientDataError(
            f"{n_effective:.1f} averages of {needed} channels: more averages than channels "
            "are needed"
        )
    if few:
        raise InsufficientDataError(
            f"{len(there.sensors)} sensors have a signal of their own; expected at least 3"
        )


def choose_dimension(
    csm: ComplexArray,
    frequency: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    band: IntArray | None = None,
    neighbours: FloatArray | None = None,
    maxima: Maxima | None = None,
) -> tuple[IntArray, tuple[BandDimension, ...]]:
    """Choose the dimension of the common motion in every band.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, channels grouped by sensor.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Number of channels of each sensor.
    n_effective : float
        Number of independent averages; must exceed the number of channels.
    band : int64, shape (n_freqs,), optional
        Index of the band of each frequency, non-decreasing; default: `bands`.
    neighbours : float64, shape (n_lags,), optional
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.
    maxima : Maxima, optional
        Fits of the same matrices, to share.

    Returns
    -------
    n_factors : int64, shape (n_freqs,)
        For ``maximum_likelihood(…, n_factors=n_factors)``.
    choices : tuple of BandDimension
        One per band.

    Raises
    ------
    InvalidMatrixError
        As `estimator.self_noise.coherency.coherency`, or if `frequency` or `band` do not fit.
    InsufficientDataError
        If fewer than three sensors have signal, or the averages are not finite or do not exceed
        the number of channels.

    Notes
    -----
    What only the channels of one sensor share is noise. Where the noise of each channel by itself
    leaves the usual dimensions rejected, they are tested with a matrix of noise for each sensor
    (`estimator.levels.noise_matrices`), before further dimensions.

    Beyond ``max(dims)`` factors the likelihood includes the weak prior of
    `estimator.likelihood.prior`, in the test as in the estimate. Three sensors get at most
    ``max(dims)`` factors: motion that only one of them measures is indistinguishable from its
    noise, so that further factors would remove noise; the test can only warn. Dead channels and
    copies of earlier ones do not count: a sensor with only such channels does not count either.
    """
    check_dims(dims)
    check_averages(n_effective)
    given = coherency(csm, dims)
    frequency = check_frequency(frequency, len(csm))
    there = presence(given, dims)
    kind = kinds(given, dims)[list(there.channels)]
    given, n_channels = given.part(list(there.channels)), len(there.channels)
    _check_enough(there, dims, n_effective)
    number = bands(frequency) if band is None else np.asarray(band)
    if number.shape != frequency.shape or np.any(np.diff(number) < 0):
        raise InvalidMatrixError("band: expected one number per frequency, non-decreasing")
    usual = max(dims)
    most = _most_testable(n_channels, usual)
    most = most if len(there.sensors) > 3 else min(usual, most)
    stride = {int(b): -(-int(np.sum(number == b)) // MAX_BINS) for b in np.unique(number)}
    taken = np.concatenate([np.flatnonzero(number == b)[::step] for b, step in stride.items()])
    part = given.block(taken)
    del given  # as large as all averages
    search = _Search(
        testable(part, frequency[taken]),
        part.psd,
        number=number[taken],
        usual=usual,
        kind=kind,
        n_effective=n_effective,
        maxima=maxima or Maxima(),
        dims=there.dims,
        stride=stride,
    )
    r = goodness_of_fit.HANN_HALF if neighbours is None else neighbours
    open_bands = list(stride)
    level = MISFIT_LEVEL / len(open_bands)
    tried: dict[int, list[goodness_of_fit.BandTest]] = {b: [] for b in open_bands}
    cov: dict[tuple[int, int], float] = {}
    for q in range(most + 1):
        hopeless = {} if q in {usual, most} else search.hopeless(q, open_bands, stride, r)
        for b, test in hopeless.items():
            tried[b].append(test)
        some = [b for b in open_bands if b not in hopeless]
        if not some and q != usual:
            continue
        fit = search.try_in(q, some, tried, cov, r)
        open_bands = [b for b in open_bands if not tried[b][-1].p_value > level]
        if q == usual:
            cov |= {(b, q): fit.median_cov(b) for b in tried}
            search.expect(fit, open_bands)
            for b in list(open_bands) if usual > 1 else ():
                found = search.sensor_test(q, b, np.arange(len(there.sensors)), r)
                if found is not None and found[0].p_value > level:
                    tried[b][-1] = found[0]
                    open_bands.remove(b)
        if not open_bands and q >= usual:
            break
    sharers = PairSearch(
        lambda q, b, group: search.sensor_test(q, b, group, r),
        search.axes,
        search.noise,
        dims=there.dims,
        usual=usual,
        level=level,
    )
    open_bands += search.together(tried, open_bands, cov, most=most, neighbours=r)
    shared = sharers.found(tried, open_bands) if len(there.sensors) >= SHARING else {}
    for b, sharing in shared.items():
        tried[b][sharing.n_factors :] = [sharing.test]
    choices = tuple(
        BandDimension(
            low=float(frequency[number == b][0]),
            high=float(frequency[number == b][-1]),
            n_factors=len(tests) - 1,
            usual=usual,
            accepted=(b in shared or b not in open_bands)
            and not (len(tests) - 1 > usual and len(there.sensors) < MIN_DETERMINED_SENSORS),
            n_sensors=len(there.sensors),
            test=tests[-1],
            tried=tuple(tests),
            cov=cov.get((b, len(tests) - 1), float("nan")),
            usual_cov=cov.get((b, usual), float("nan")),
            **(shared[b].fields() if b in shared else {}),
        ).of_all(there.sensors, there.channels, sum(dims))
        for b, tests in tried.items()
    )
    chosen = {b: len(tests) - 1 for b, tests in tried.items()}
    return np.array([chosen[int(b)] for b in number]), choices


def _are_rejected(tests: list[goodness_of_fit.BandTest]) -> bool:
    """Whether the tests of bands fail together.

    What a band alone hardly shows, such as weak gradients, biases the noise of all.
    """
    statistic = sum(test.statistic / test.spread for test in tests)
    degrees = sum(test.degrees / test.spread for test in tests)
    return bool(tests) and goodness_of_fit.upper_tail(degrees, statistic) < MISFIT_LEVEL


def most_testable(dims: tuple[int, ...]) -> int:
    """Return the largest dimension that sensors of so many channels can tell from noise."""
    return _most_testable(sum(dims), max(dims))


def _most_testable(n_channels: int, usual: int) -> int:
    """Return the maximum number of factors that the test can tell from noise.

    The usual ones need one degree of freedom, further ones more equations than unknowns.
    """
    identifiable = int(max_factors(n_channels))
    left = (n_channels - identifiable) ** 2 > n_channels
    most = int(n_channels - np.ceil(np.sqrt(EQUATIONS * n_channels)))
    return max(most, min(usual, identifiable if left else identifiable - 1))


@dataclass(frozen=True, slots=True)
class _Fit:
    """Fit of one dimension in some bands; one row per frequency."""

    number: IntArray
    psi: FloatArray
    cov: FloatArray
    test: goodness_of_fit.ModelTest

    def median_cov(self, band: int) -> float:
        """Return the median c.o.v. in a band; infinite if the noise is undetermined."""
        known = self.cov[(self.number == band) & np.isfinite(self.psi).all(axis=1)]
        return (
            float(median(np.nan_to_num(known, nan=np.inf).ravel())) if len(known) else float("nan")
        )


class _Search:
    """The averages in their bands, and the fits of one dimension in some bands."""

    def __init__(
        self,
        matrix: ComplexArray,
        psd: FloatArray,
        *,
        number: IntArray,
        usual: int,
        kind: IntArray,
        n_effective: float,
        maxima: Maxima,
        dims: tuple[int, ...],
        stride: dict[int, int],
    ) -> None:
        self._maxima, self._dims, self._stride = maxima, dims, stride
        self.axes: dict[int, ComplexArray] = {}
        self.noise: dict[int, FloatArray] = {}
        self._matrix = matrix
        self._psd = psd
        self._number = number
        self._usual = usual
        self._kind = kind
        self._n_effective = n_effective
        self._expected = 1 / psd  # in units of the coherency matrix

    def fit(
        self, q: int, some: list[int], *, every: int = 1, channels: IntArray | None = None
    ) -> _Fit:
        """Maximise the likelihood of q factors in these bands, at every so many frequencies.

        Of some channels alone, where these are stated, in few steps.
        """
        rows = np.flatnonzero(np.isin(self._number, some))[every // 2 :: every]
        if channels is not None:
            few = self._matrix[rows[:, None, None], channels[:, None], channels]
            maximum = maximise(few, q, most=LOOK_STEPS)
        elif q <= self._usual:
            whole = len(rows) == len(self._matrix)
            maximum = self._maxima.maximise(self._matrix if whole else self._matrix[rows], q)
        else:
            maximum = maximise_expecting(
                self._matrix[rows],
                q,
                self._expected[rows],
                kind=self._kind,
                n_effective=self._n_effective,
            )
        if channels is None and q <= self._usual + 1:
            for b in some:
                here = self._number[rows] == b
                self.axes[b] = maximum.eigenvectors[here]
                self.noise[b] = median_of_columns(maximum.psi[here] * self._psd[rows[here]])
        error = standard_error(maximum, n_effective=self._n_effective)
        return _Fit(
            number=self._number[rows],
            psi=maximum.psi,
            cov=error / maximum.psi,
            test=goodness_of_fit.model_test(maximum, n_effective=self._n_effective),
        )

    def together(
        self,
        tried: dict[int, list[goodness_of_fit.BandTest]],
        rejected: list[int],
        cov: dict[tuple[int, int], float],
        *,
        most: int,
        neighbours: FloatArray,
    ) -> list[int]:
        """Try one more dimension where tests of bands fail together only.

        What a band alone hardly shows, such as weak gradients, biases the noise of all. Not where
        neighbouring frequencies give it (`estimator.levels.pooled`). Returns the bands that fail
        together with as many dimensions as can be tested.
        """
        found = [b for b in tried if b not in rejected]
        few = self._usual < DIMENSIONS_OF_MOTION and len(self._dims) >= MIN_DETERMINED_SENSORS
        for q in range(max(self._usual, most_pooled(self._dims)), most if few else 0):
            some = [b for b in found if len(tried[b]) == q + 1]
            if _are_rejected([tried[b][-1] for b in some]):
                self.try_in(q + 1, some, tried, cov, neighbours)
        further = [b for b in found if len(tried[b]) - 1 > self._usual]
        if all(len(tried[b]) <= most for b in further):
            return []
        return further if _are_rejected([tried[b][-1] for b in further]) else []

    def try_in(
        self,
        q: int,
        some: list[int],
        tried: dict[int, list[goodness_of_fit.BandTest]],
        cov: dict[tuple[int, int], float],
        neighbours: FloatArray,
    ) -> _Fit:
        """Fit q factors, and add tests and c.o.v. of some bands."""
        fit = self.fit(q, some if q != self._usual else list(tried))
        for b in some:
            distant = neighbours[self._stride[b] - 1 :: self._stride[b]]
            tried[b].append(goodness_of_fit.pool(fit.test, fit.number == b, neighbours=distant))
            cov[b, q] = fit.median_cov(b)
        return fit

    def hopeless(
        self, q: int, some: list[int], stride: dict[int, int], neighbours: FloatArray
    ) -> dict[int, goodness_of_fit.BandTest]:
        """Return the tests of bands that few of their frequencies reject beyond doubt."""
        found: dict[int, goodness_of_fit.BandTest] = {}
        sensor = np.repeat(np.arange(len(self._dims)), self._dims)
        few = np.flatnonzero(sensor % -(-len(sensor) // LOOK_CHANNELS) == 0)
        if (len(few) - q) ** 2 <= EQUATIONS * len(few):
            few = np.arange(len(sensor))
        looks = ((few, BEYOND_DOUBT),) if q < self._usual else ()
        for channels, beyond in (*looks, (None, 1.0)):
            left = [b for b in some if b not in found]
            if not left:
                break
            look = self.fit(q, left, every=FIRST_LOOK, channels=channels)
            for b in left:
                distant = neighbours[FIRST_LOOK * stride[b] - 1 :: FIRST_LOOK * stride[b]]
                test = goodness_of_fit.pool(look.test, look.number == b, neighbours=distant)
                if goodness_of_fit.deflated(test, beyond).p_value < HOPELESS:
                    found[b] = test
        return found

    def sensor_test(
        self, q: int, band: int, group: IntArray, neighbours: FloatArray
    ) -> tuple[goodness_of_fit.BandTest, ComplexArray] | None:
        """Test q factors beside a matrix of noise for each group of sensors, in a band.

        With the noise, shape (n_rows, n_channels, n_channels); None where nothing is left to test.
        """
        order, dims = together(self._dims, group)
        if (len(order) - q) ** 2 <= n_noise(dims):
            return None
        rows = np.flatnonzero(self._number == band)
        every = -(-len(rows) // SENSOR_BINS)
        rows = rows[every // 2 :: every]
        matrix = self._matrix[rows[:, None, None], order[:, None], order]
        fit = maximise(matrix, q, dims=dims, most=SENSOR_STEPS)
        test = goodness_of_fit.model_test(fit, n_effective=self._n_effective)
        step = every * self._stride[band]
        back = np.argsort(order)
        return (
            goodness_of_fit.pool(test, ~fit.singular, neighbours=neighbours[step - 1 :: step]),
            fit.noise[~fit.singular][:, back[:, None], back],
        )

    def expect(self, fit: _Fit, open_bands: list[int]) -> None:
        """Set the expected noise of the open bands from the noise of the explained bands."""
        usual = ~np.isin(self._number, open_bands)
        self._expected = expected_noise(fit.psi * self._psd, usual, self._kind) / self._psd
