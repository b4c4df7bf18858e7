"""Diagnosis of a test from its averaged spectra: bands, orientation, advice."""
