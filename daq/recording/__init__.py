"""The HDF5 recording: writes it, reads it while it grows, locks, repairs and monitors it.

Knows no driver and no estimate; the format is in docs/recording-format.md.
"""
