"""Tests of daq.results.decision."""
