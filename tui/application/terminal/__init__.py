"""Terminals that can do less: slow lines, and those without Unicode."""
