"""Numbers in, numbers out: spectra, self-noise, likelihood, diagnostics.

numpy and scipy alone: no files, no devices, no sentences.
"""
