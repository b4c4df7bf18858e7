"""Aligns all sensors of a recording on one grid, in physical units.

Does not change raw counts on disk, and computes no spectra for results.
"""
