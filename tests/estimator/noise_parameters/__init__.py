"""Tests of estimator.noise_parameters."""
