"""Tests of tui.studies.drawn."""
