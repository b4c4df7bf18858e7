"""Epson M-A352 and M-A370."""
