"""Looks at a bench before a test: which devices answer, and what their latest samples show.

Reads devices and writes nothing. What runs during a recording is in `daq.acquisition`, which does
not import this package.
"""
