"""A slowly varying clock from what is observed of it, however irregularly.

Theory of operation
-------------------
A clock is its *lateness* (time of a sample minus its index over the nominal rate), whose rate
does a random walk. Two kinds of observations inform it: the lower envelope of block arrival
times, and, where the sensors share a motion, the delay against a reference sensor measured from
the samples. The latter know the lateness up to one constant (latencies differ), so the state is
(lateness, rate, constant).

A Kalman filter runs for a grid of strengths of the random walk and of arrival noise at once. Few
observations leave many pairs possible, so all those are smoothed backwards (Rauch, Tung, Striebel
1965) and averaged by their likelihood, times what is known of oscillators and of arrivals
beforehand. What is stated is the variance of that mixture about its mean over the recording: a
constant is no concern of the method. An innovation beyond four standard deviations counts as four:
an outlier cannot pull, a change that stays is followed. A restart of the device's clock forgets the
lateness and keeps the rate.

Arrivals alone do not tell a clock that wanders from a host whose shortest latency does. So the
clock is smoothed once more, with the likeliest walk that oscillators have at a steady temperature.
By how much both differ is part of what is stated.

Why a filter, and not a line or pieces of lines: docs/decisions/0006-clock-model.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_WALKS = 10.0 ** np.arange(-10.0, -4.4, 0.5)  # random walk of the rate, s/s per √s
_NOISES = 10.0 ** np.arange(-6.0, -2.4, 0.5)  # of arrival observations, s
_STEADY = 1.1e-8  # at most, of an oscillator that is left in peace: 0.25 ppm in ten minutes
_START = np.array([1e-2, 1e-4, 1.0])  # what is not known at first: s, s/s, s
_RESTART_RATE = 1e-6
_HUBER = 4.0
_USUAL = 5e-9  # walk that is expected, within
_USUALLY = 0.75  # decades
_HARDLY_MORE = 0.35  # decades by which arrivals scatter more than those of their group say
_UNLIKELY = 0.01  # of the greatest likelihood: too little to count
_GROWS = 9  # covariances of three numbers
_AT_ONCE = 128  # observations that are prepared, and whose gains are found, together


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Lateness observed, in order of time.

    Attributes
    ----------
    seconds : float64, shape (n,)
        When, on the sensor's own count, increasing.
    lateness : float64, shape (n,)
        In seconds, within some 10 ms of zero.
    variance : float64, shape (n,)
        Of observations from the samples, in s²; that of arrivals is estimated.
    from_samples : bool, shape (n,)
        Whether the observation is from the samples, and so up to a constant.
    restarts : bool, shape (n,)
        Whether the clock has started anew between the one before and this one.
    counts : bool, shape (n,)
        Where the error of the clock counts: some at least.
    """

    seconds: FloatArray
    lateness: FloatArray
    variance: FloatArray
    from_samples: BoolArray
    restarts: BoolArray
    counts: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The clock at the instants of the observations.

    Attributes
    ----------
    lateness, rate : float64, shape (n,)
        Lateness in s, and its rate in s/s.
    std : float64, shape (n,)
        Standard deviation in s of the lateness; of that with the constant where samples were
        observed.
    varying : float
        The same in s rms, of what is not constant, where it counts.
    wander : float
        What may be wander of the arrivals and not of the clock, in s rms; 0 where samples were
        observed.
    noise : float
        Likely standard deviation of an arrival, in s.
    constant : float
        By how much observations from the samples lie above those from arrivals, in s.
    """

    lateness: FloatArray
    rate: FloatArray
    std: FloatArray
    varying: float
    wander: float
    noise: float
    constant: float


def smooth(observations: Observations, *, least_noise: float = 0.0) -> Smoothed:
    """Return the clock to be expected.

    Parameters
    ----------
    observations : Observations
        At least one.
    least_noise : float
        Standard deviation of arrivals, in s, that they have at least.
    """
    strengths = _WALKS, np.array(sorted(set(np.maximum(_NOISES, least_noise).tolist())))
    walks, noises = (grid.ravel() for grid in np.meshgrid(*strengths, indexing="ij"))
    likelihood = _filter(observations, walks, noises, None)
    likelihood -= (np.log10(walks / _USUAL) / _USUALLY) ** 2 / 2
    likelihood -= (np.log10(noises / noises[0]) / _HARDLY_MORE) ** 2 / 2
    relative = np.exp(likelihood - likelihood.max())
    steady = int(np.argmax(np.where(walks < _STEADY, likelihood, -np.inf)))
    taken = np.append(np.flatnonzero(relative > _UNLIKELY), steady)
    track = _Track.empty(len(observations.seconds), len(taken))
    _filter(observations, walks[taken], noises[taken], track)
    sees = np.array([1.0, 0.0, float(observations.from_samples.any())])
    counts = observations.counts
    states, covariances, of_means = _backwards(track, sees, counts)
    weight = np.append(relative[taken[:-1]], 0.0)
    weight /= weight.sum()
    state = np.einsum("npk,p->nk", states, weight)
    apart = (states - state[:, None]) @ sees
    variance = (sees @ covariances @ sees + apart**2) @ weight
    of_mean = (of_means + apart[counts].mean(axis=0) ** 2) @ weight
    return Smoothed(
        lateness=state[:, 0],
        rate=state[:, 1],
        std=np.sqrt(np.maximum(variance, 0.0)),
        varying=math.sqrt(max(float(variance[counts].mean() - of_mean), 0.0)),
        wander=0.0 if sees[2] else float(np.std(apart[:, -1])),
        noise=float(weight @ noises[taken] ** -2.0) ** -0.5,
        constant=float(state[-1, 2]),
    )


@dataclass(slots=True, eq=False)
class _Track:
    """Predicted and filtered states, shape (n, n_pairs, 3), of runs of the filter."""

    predicted: FloatArray
    predicted_covariance: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    transition: FloatArray

    @classmethod
    def empty(cls, n: int, n_pairs: int) -> _Track:
        line, square = (n, n_pairs, 3), (n, n_pairs, 3, 3)
        return cls(
            np.empty(line), np.empty(square), np.empty(line), np.empty(square), np.empty((n, 3, 3))
        )


def _filter(
    observations: Observations, walks: FloatArray, noises: FloatArray, track: _Track | None
) -> FloatArray:
    """Return the log-likelihood of every pair; `track` takes their states."""
    arrival = noises**2
    x = np.zeros((3, len(walks)))
    # The covariance, row after row, above what it grows by: the walks, and one.
    p, grown = np.zeros((2, _GROWS + 2, len(walks)))
    p[_GROWS:] = grown[_GROWS:] = walks**2, np.ones_like(walks)
    p[:_GROWS:4] = _START[:, None] ** 2
    covariance, after = (each[:_GROWS].reshape(3, 3, -1) for each in (p, grown))
    likelihood = np.zeros(len(walks))
    steps = np.diff(observations.seconds, prepend=observations.seconds[0])
    for first in range(0, len(steps), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        transitions, growths = _predictions(steps[rows], observations.restarts[rows])
        spreads, innovations = np.empty((2, len(transitions), len(walks)))
        each = zip(
            observations.lateness[rows].tolist(),
            observations.variance[rows].tolist(),
            observations.from_samples[rows].tolist(),
            strict=True,
        )
        for number, (lateness, variance, from_samples) in enumerate(each):
            x = transitions[number] @ x
            np.matmul(growths[number], p, out=grown[:_GROWS])
            p, grown, covariance, after = grown, p, after, covariance
            if track is not None:
                track.predicted[first + number] = x.T
                track.predicted_covariance[first + number] = covariance.T
            innovation, spread = innovations[number], spreads[number]
            if from_samples:
                gain = covariance[0] + covariance[2]
                np.add(gain[0] + gain[2], variance, out=spread)
                np.subtract(lateness - x[0], x[2], out=innovation)
            else:
                gain = covariance[0]
                np.add(gain[0], arrival, out=spread)
                np.subtract(lateness, x[0], out=innovation)
            np.maximum(spread, (innovation / _HUBER) ** 2, out=spread)
            weight = gain / spread
            x += weight * innovation
            covariance -= weight[:, None] * gain
            if track is not None:
                track.filtered[first + number] = x.T
                track.filtered_covariance[first + number] = covariance.T
        if track is not None:
            track.transition[rows] = transitions
        likelihood -= 0.5 * (np.log(spreads) + innovations**2 / spreads).sum(axis=0)
    return likelihood


def _predictions(steps: FloatArray, restarts: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the transition of each state, (n, 3, 3), and how its covariance grows.

    Lateness grows by its rate, and the rate walks; a restart forgets the lateness, and the rate is
    a little less certain. The second, (n, 9, 11), acts on the nine covariances, the power of the
    walk and one.
    """
    n, goes_on = len(steps), np.where(restarts, 0.0, 1.0)
    transitions = np.zeros((n, 3, 3))
    transitions[:, 0, 0], transitions[:, 0, 1] = goes_on, goes_on * steps
    transitions[:, 1, 1] = transitions[:, 2, 2] = 1.0
    both = transitions[:, :, None, :, None] * transitions[:, None, :, None, :]
    growths = np.zeros((n, _GROWS, _GROWS + 2))
    growths[:, :, :_GROWS] = both.reshape(n, _GROWS, _GROWS)
    growths[:, 0, _GROWS] = goes_on * steps**3 / 3
    growths[:, 1, _GROWS] = growths[:, 3, _GROWS] = goes_on * steps**2 / 2
    growths[:, 4, _GROWS] = steps
    growths[:, 0, -1] = (1 - goes_on) * _START[0] ** 2
    growths[:, 4, -1] = (1 - goes_on) * _RESTART_RATE**2
    return transitions, growths


def _backwards(
    track: _Track, sees: FloatArray, counts: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rauch-Tung-Striebel: what later observations say about earlier states.

    Returns states, their covariances, and of every pair the variance that the mean of all
    ``sees @ state`` that count has. States take the place of the filtered ones in `track`: after a
    day copies of them would take 40 MB.
    """
    state, covariance = track.filtered, track.filtered_covariance
    # Of each state with the sum of all later ones; smoothed states are a Markov chain too.
    later = np.zeros(state.shape[1:])
    share = counts / np.count_nonzero(counts)
    of_mean = share[-1] ** 2 * (sees @ covariance[-1] @ sees)
    for end in range(len(state) - 1, 0, -_AT_ONCE):
        begin = max(0, end - _AT_ONCE)
        predicted = track.predicted_covariance[begin + 1 : end + 1]
        crossed = track.transition[begin + 1 : end + 1, None] @ covariance[begin:end]
        gains = np.linalg.solve(predicted, crossed).swapaxes(-1, -2)
        after = np.empty((end - begin, *later.shape))
        for number in range(end - 1, begin - 1, -1):
            gain, next_one = gains[number - begin], number + 1
            weighted = share[next_one] * (covariance[next_one] @ sees) + later
            after[number - begin] = later = (gain @ weighted[:, :, None])[:, :, 0]
            ahead = state[next_one] - track.predicted[next_one]
            state[number] += (gain @ ahead[:, :, None])[:, :, 0]
            known = covariance[next_one] - track.predicted_covariance[next_one]
            covariance[number] += gain @ known @ gain.swapaxes(-1, -2)
        mine = share[begin:end]
        own = sees @ covariance[begin:end] @ sees
        of_mean = of_mean + mine @ (mine[:, None] * own + 2 * after @ sees)
    return state, covariance, np.asarray(of_mean)
