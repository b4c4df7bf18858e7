"""Tests of levels and intervals."""
