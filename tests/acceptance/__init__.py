"""Whole huddle tests with everything going wrong."""
