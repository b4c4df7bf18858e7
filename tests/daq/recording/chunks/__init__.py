"""Rows of a recording in bulk."""
