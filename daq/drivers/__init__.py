"""Drivers: a thin shell of I/O around each protocol, behind one interface.

A driver opens, identifies, configures and reads. It never retries, keeps indices across sessions
or writes files; acquisition does.
"""
