"""Simulated motion and noise of the paper, and simulated devices with the real protocols.

Uses only `daq.protocols` of daq.
"""
