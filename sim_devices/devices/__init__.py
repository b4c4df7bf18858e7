"""Simulated devices: each answers as its real counterpart would."""
