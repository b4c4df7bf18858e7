"""Diagnosis of a test from its averages: bands, orientation, advice."""
