"""The HDF5 recording: written, read while it grows, locked, repaired, monitored.

Knows no driver and no estimate; the format is in docs/recording-format.md.
"""
