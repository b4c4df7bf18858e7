"""Tests of the packages under ``examples/``."""
