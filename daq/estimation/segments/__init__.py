"""The segments of recordings: which are complete, clipped, flat or bridged, and their windows.

Knows samples and the settings, and accumulates spectra. Takes no estimate of noise, and knows no
snapshot: those are in `daq.estimation`, which imports this package.
"""
