"""Numerical estimation: spectra, self-noise, likelihood, diagnostics.

Uses only numpy and scipy: no files, no devices, no user-visible sentences.
"""
