"""Channels whose noise cannot be told from motion, because a sensor records another motion."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from estimator.checks.advice import NoSharedMotion

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot


class WithoutPartner(enum.StrEnum):
    """Why the noise of a channel cannot be told from motion."""

    ALONE = "alone"
    """Its sensor records none of the motion that the others share."""
    ONE_PARTNER = "one-partner"
    """Only one other sensor records the same motion; it takes two."""


def without_partners(snapshot: Snapshot, band: tuple[float, float]) -> dict[int, WithoutPartner]:
    """Return the channels, by column, whose noise cannot be told from motion somewhere in a band.

    As far as the test has been diagnosed.
    """
    found: dict[int, WithoutPartner] = {}
    sensors = [number for number, n_channels in enumerate(snapshot.dims) for _ in range(n_channels)]
    for advice in snapshot.diagnostics.advice:
        if not isinstance(advice, NoSharedMotion):
            continue
        if advice.band is not None and (advice.band[1] < band[0] or advice.band[0] > band[1]):
            continue
        for column, sensor in enumerate(sensors):
            if sensor in advice.sensors:
                found[column] = WithoutPartner.ALONE
            elif sensor in advice.partners and len(advice.partners) < 3:
                found.setdefault(column, WithoutPartner.ONE_PARTNER)
    return found
