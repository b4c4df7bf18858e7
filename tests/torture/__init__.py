"""Recordings under torture: kills, power cuts, disk errors, damaged files.

``make torture`` does all of it and writes the counts; the tests do a part that takes seconds.
"""
