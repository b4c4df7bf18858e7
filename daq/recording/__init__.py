"""The HDF5 recording: writing, reading while it grows, locking, repair, monitoring.

Uses no drivers and no estimates; docs/recording-format.md describes the format.
"""
