"""Rows of a recording in bulk: whole chunks written and read, blocks kept and checked.

Knows datasets and counts; opens and names no file.
"""
