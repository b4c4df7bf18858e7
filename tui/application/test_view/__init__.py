"""The Test view: the live estimate of one recording."""
