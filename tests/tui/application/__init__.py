"""Tests of tui.application."""
