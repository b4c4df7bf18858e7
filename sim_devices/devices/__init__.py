"""Simulated devices, with the replies and timing of their real counterparts."""
