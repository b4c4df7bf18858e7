"""Follows recordings and estimates their noise: settings, segments, methods, snapshot.

With `daq.results` the only part of this room that knows the estimator.
"""
