"""Tests of what outputs consist of."""
