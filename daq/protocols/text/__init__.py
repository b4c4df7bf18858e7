"""Delimited text: the format of a row, its decoder, packets put in order."""
