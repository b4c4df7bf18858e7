"""The motion and noise of the paper, and devices that speak the real protocols.

Shares `daq.protocols` with daq and nothing else.
"""
