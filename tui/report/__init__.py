"""The calibration report as HTML or PDF. Loads matplotlib: import it when it is wanted."""
