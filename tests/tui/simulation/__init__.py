"""Tests of tui.simulation."""
