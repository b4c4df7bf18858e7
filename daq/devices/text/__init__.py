"""Delimited text: formats, decoder, guessed formats, order of packets."""
