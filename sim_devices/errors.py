"""Errors of the simulated world."""

from __future__ import annotations


class SimulationError(Exception):
    """Base class of the errors of this package."""

    is_usage_error = False
    """Whether a scenario or a fault script has an error; otherwise a device cannot be served."""


class ScenarioError(SimulationError, ValueError):
    """A scenario or fault script that cannot be simulated.

    Parameters
    ----------
    problems : str
        One per error, with key, value and expectation.
    """

    is_usage_error = True

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class ServeError(SimulationError, RuntimeError):
    """A simulated device cannot be served.

    Parameters
    ----------
    message : str
        Message of the device's process, if the process failed.
    is_usage_error : bool
        Whether a scenario or a fault script is the cause.
    """

    def __init__(self, message: str, *, is_usage_error: bool = False) -> None:
        super().__init__(message)
        self.is_usage_error = is_usage_error
