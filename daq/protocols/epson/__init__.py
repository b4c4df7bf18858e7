"""Epson M-A352 and M-A370: register commands and bursts."""
