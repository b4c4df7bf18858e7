"""The recorder: keeps devices connected; validates, indexes and writes their blocks.

Knows drivers and recordings. Knows no alignment and no estimate.
"""
