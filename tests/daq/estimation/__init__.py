"""Tests of daq.estimation."""
