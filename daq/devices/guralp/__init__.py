"""Güralp digitizers: GCF over a serial line or from a Scream server."""
