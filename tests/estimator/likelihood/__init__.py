"""Tests of estimator.likelihood."""
