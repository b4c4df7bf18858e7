"""Tests of daq.recorder."""
