"""Tests of daq.results."""
