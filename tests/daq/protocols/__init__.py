"""Codecs: golden vectors, fuzzing, any split."""
