"""Tests of tui.output."""
