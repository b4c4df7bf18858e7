"""Errors of estimation."""

from __future__ import annotations


class EstimatorError(ValueError):
    """Base class of the errors of this package."""

    is_usage_error = False
    """Whether an argument is wrong; otherwise the data are insufficient."""


class InvalidMatrixError(EstimatorError):
    """A cross-spectral matrix has a wrong shape, or is valid at no frequency."""


class InsufficientDataError(EstimatorError):
    """Too few averages or too few sensors."""


class BandError(EstimatorError):
    """A band without frequencies."""

    is_usage_error = True


class UnknownMethodError(EstimatorError):
    """No self-noise method has this name."""

    is_usage_error = True
