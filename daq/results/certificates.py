"""Certificates of the bench file, found for the channels of an estimate."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.bench.model import Bench, Certificate, Channel
    from daq.estimation.snapshot import Snapshot


def certificates_of(snapshot: Snapshot, bench: Bench | None, name: str) -> tuple[Certificate, ...]:
    """Return the certificates of a sensor, in the order of its channels; empty if one has none."""
    channels = [
        channel_of(bench, name, each.channel) for each in snapshot.channels if each.sensor == name
    ]
    found = tuple(
        each.certificate for each in channels if each is not None and each.certificate is not None
    )
    return found if len(found) == len(channels) else ()


def channel_of(bench: Bench | None, sensor: str, channel: str) -> Channel | None:
    """Return a channel of the bench file by its name; None if there is none."""
    return next(
        (
            found
            for each in (() if bench is None else bench.sensors)
            if each.name == sensor
            for found in each.channels
            if found.name == channel
        ),
        None,
    )
