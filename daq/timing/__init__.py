"""When samples were taken: clock models from arrival times.

Reads no file; `daq.alignment` does.
"""
