"""Noise as a few numbers: white, flicker, random walk and f² terms, and the Allan deviation.

Works on any self-noise estimate; nothing here knows how it was made.
"""
