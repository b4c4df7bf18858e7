"""Drivers: a thin layer of I/O around each protocol, with a common interface.

A driver opens a port, identifies and configures the device, and reads. Retries, indices across
sessions and files are the task of :mod:`daq.acquisition`.
"""
