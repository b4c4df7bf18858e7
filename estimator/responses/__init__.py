"""Responses of sensors to the same motion: leakage, equalisation, calibration."""
