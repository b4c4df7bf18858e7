"""Errors of estimation."""

from __future__ import annotations


class EstimatorError(ValueError):
    """Root of the errors of this package."""

    is_usage_error = False
    """Whether an argument is wrong; otherwise the data are insufficient."""


class InvalidMatrixError(EstimatorError):
    """A cross-spectral matrix is mis-shaped, or at no frequency finite, Hermitian and possible."""


class InsufficientDataError(EstimatorError):
    """Too few averages or too few sensors."""


class BandError(EstimatorError):
    """A band that holds none of the frequencies."""

    is_usage_error = True


class UnknownMethodError(EstimatorError):
    """No self-noise method of that name."""

    is_usage_error = True
