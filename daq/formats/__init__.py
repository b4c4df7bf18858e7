"""Recordings from files of other programs.

Only reads what it is named; nothing in a file is executed or followed.
"""
