"""Bench file templates."""
