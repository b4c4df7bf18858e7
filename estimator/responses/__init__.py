"""How sensors answer the same motion: leakage, equalisation, calibration."""
