"""Tests of tui.studies."""
