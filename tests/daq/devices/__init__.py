"""Drivers and what they stand on."""
