"""Tests of decisions on arrays."""
