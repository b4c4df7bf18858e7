"""Every sensor of a recording on one grid in physical units.

Raw counts on disk are never touched. Knows no spectra.
"""
