"""The recorder: connections kept alive, blocks checked, indexed and written.

Knows drivers and recordings. Knows no alignment and no estimate.
"""
