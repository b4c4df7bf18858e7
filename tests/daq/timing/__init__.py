"""Tests of daq.timing."""
