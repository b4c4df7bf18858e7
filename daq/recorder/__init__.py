"""The recorder: keeps devices connected; validates, indexes and writes their blocks.

Uses drivers and recordings, but no alignment or estimates.
"""
