"""Tests of daq.acquisition.before_test."""
