"""Tests of estimator.diagnostics."""
