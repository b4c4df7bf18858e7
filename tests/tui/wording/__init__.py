"""Advice as words."""
