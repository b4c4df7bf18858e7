"""Acquisition: wires to files and back."""
