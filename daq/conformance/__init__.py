"""The driver contract as tests, for packages that add a driver.

Needs pytest (extra ``testing``), and imports it only in
:mod:`daq.conformance.suite`.
"""
