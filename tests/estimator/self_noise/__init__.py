"""Tests of estimator.self_noise."""
