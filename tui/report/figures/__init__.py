"""The figures of a report: how they look, noise and model test, drift of the clocks.

Loads matplotlib; writes no text around the figures.
"""
