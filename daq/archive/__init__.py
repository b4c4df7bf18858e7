"""Spectra of months of recordings: kept per hour or day in a store, and what they answer."""
