"""Tests of daq.acquisition."""
