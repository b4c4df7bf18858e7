"""Checks of a bench before a test: replies of devices, and their latest samples.

Reads devices and writes nothing. `daq.recorder` has the code that runs during a recording; it
does not import this package.
"""
