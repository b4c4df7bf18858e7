"""The driver contract as tests, for packages that add a driver.

Needs pytest (``pip install 'huddle-bench[testing]'``), and imports it only in
:mod:`daq.conformance.suite`.
"""
