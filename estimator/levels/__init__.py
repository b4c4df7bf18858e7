"""Levels of a channel's noise in bins and bands, each with its interval and what widens it."""
