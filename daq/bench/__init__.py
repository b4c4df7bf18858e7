"""The bench file: its tables, their units and durations, and every error in it.

Knows no driver: what it asks of one is in `driver_rules`. Opens no port.
"""
