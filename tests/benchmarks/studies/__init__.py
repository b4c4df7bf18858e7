"""Tests of the studies outside the wheel."""
