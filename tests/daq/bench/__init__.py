"""Tests of daq.bench."""
