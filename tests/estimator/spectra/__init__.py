"""Tests of estimator.spectra."""
