"""Follows recordings and estimates: the only part of this package that knows the estimator.

`settings` says what is wanted, `segments` takes the segments of one recording, `results` makes
noise spectra of their averages, `diagnosis` says what those show of the test itself, `following`
keeps all of it up with recordings as they grow, and `snapshot` is what front ends see.
"""

from daq.estimation.following import Estimation, estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import ChannelLabel, Octave, SensorState, Snapshot

__all__ = [
    "ChannelLabel",
    "Estimation",
    "Octave",
    "SensorState",
    "Settings",
    "Snapshot",
    "estimate",
]
