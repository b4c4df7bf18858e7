"""Noise parameters: white, flicker, random walk and f² terms, and the Allan deviation.

Applies to self-noise estimates of any method.
"""
