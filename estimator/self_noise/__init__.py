"""Closed-form self-noise methods, their bias and uncertainty."""
