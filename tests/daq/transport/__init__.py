"""Tests of daq.transport."""
