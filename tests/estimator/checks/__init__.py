"""Tests of estimator.checks."""
