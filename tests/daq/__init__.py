"""Tests of daq."""
