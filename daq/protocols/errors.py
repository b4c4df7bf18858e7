"""The one error that received bytes may raise."""

from __future__ import annotations


class RemoteProtocolError(ValueError):
    """The other end said something its protocol does not allow, and going on makes no sense.

    Garbage and cut frames do not raise: they are skipped, counted and reported as events.
    """
