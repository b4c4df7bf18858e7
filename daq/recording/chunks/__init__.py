"""Bulk access to the rows of a recording: complete chunks, tables of blocks, checksums, manifest.

Uses datasets and counts; opens and names no file.
"""
