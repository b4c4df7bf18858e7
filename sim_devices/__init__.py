"""Simulated motion, noise and devices with known truth."""
