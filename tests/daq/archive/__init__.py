"""Tests of daq.archive."""
