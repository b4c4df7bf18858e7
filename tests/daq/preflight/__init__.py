"""Tests of daq.preflight."""
