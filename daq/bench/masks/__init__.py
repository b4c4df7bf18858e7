"""Noise masks: published noise models, and masks of data sheets.

Reads CSV files; knows no table of the bench file, which refers to masks.
"""
