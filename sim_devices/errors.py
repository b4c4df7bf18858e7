"""Errors of the simulated world."""

from __future__ import annotations


class ScenarioError(ValueError):
    """A scenario that cannot be simulated: every fault with its key, value and expectation."""


class ServeError(RuntimeError):
    """A simulated device cannot be served; the message says what its process said."""
